//! A machine with the ordinary imperfections that the base model allows for, drawn as it takes them for granted.
//!
//! Of a family whose width is learnt the width itself is drawn, half-normal about its tolerance, and then each member; of another each member by the tolerance. Gradients and edge
//! angles of single dipoles, which no fit holds, have theirs too. The noise is off the header's by as much as that is quoted. As of the vars, those are drawn whose machine
//! has tunes near the design's.

use core::iter;

use inference::simulate::are_near_design;
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use twin::{Effect, Machine, Rf, Ring};

use crate::data::Data;
use crate::hypothesis::Member;
use crate::ordinary::Family;
use crate::scale::QUOTED;

/// Every family of imperfections.
#[derive(Debug, Clone)]
pub struct Families(Vec<Drawn>);

#[derive(Debug, Clone)]
struct Drawn {
    members: Vec<Member>,
    width: f64,
    /// Whether each machine has a width of its own.
    scatters: bool,
}

/// The imperfections of one machine.
#[derive(Debug, Clone)]
pub struct Imperfections {
    /// Those of instruments and magnets.
    pub effects: Vec<Effect>,
    /// Noise over the header's [1].
    pub noise: f64,
}

/// Machines that are drawn before a case has an ideal one.
const TRIES: usize = 200;

impl Families {
    /// Those of a machine with such recordings.
    pub fn of(data: &Data) -> Self {
        let drawn = |family: Family, scatters| Drawn { members: family.members(data), width: family.width, scatters };
        let ordinary = Family::all().into_iter().map(|family| drawn(family, family.is_learnt()));
        let hidden = Family::hidden(data).into_iter().map(|family| drawn(family, false));
        Self(ordinary.chain(hidden).collect())
    }

    /// Draw those of a machine of a ring with some vars; `None` if hardly any has tunes near the design's.
    pub fn draw(&self, ring: &Ring, vars: &[f64], random: &mut impl Rng) -> Option<Imperfections> {
        let made = ring.with_vars(vars);
        let is_near_design = |drawn: &Imperfections| {
            let machine = Machine::new(made.clone(), Rf::FixedMomentum, &drawn.effects);
            let tunes = machine.ok().and_then(|machine| machine.optics().ok()?.tunes().ok());
            tunes.is_some_and(|tunes| are_near_design(ring, tunes).is_ok_and(|are_near| are_near))
        };
        iter::repeat_with(|| self.draw_any(random)).take(TRIES).find(is_near_design)
    }

    fn draw_any(&self, random: &mut impl Rng) -> Imperfections {
        let mut normal = || -> f64 { StandardNormal.sample(random) };
        let mut effects = Vec::new();
        for Drawn { members, width, scatters } in &self.0 {
            let width = width * if *scatters { normal().abs() } else { 1.0 };
            for member in members {
                let amplitude = width * normal();
                effects.extend(member.terms.iter().map(|term| term.effect(amplitude)));
            }
        }
        Imperfections { effects, noise: (QUOTED * normal()).exp() }
    }
}

#[cfg(test)]
mod tests {
    use twin::EffectKind;

    use crate::Diagnosis;
    use crate::testing::template;
    use crate::validation::{Cases, Class};

    /// Both widen the gains of all until they are among them. One of these was named a gain of -94.8 ± 3.7 %, and dead not weighed; beside another, crosstalk of
    /// -0.7 ± 1.5 % was named, since gains were not of first order about a gain, and fits that were poor without what is ordinary stayed without it.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn dead_and_reversed_correctors_among_ordinary_imperfections_are_named() {
        let (ring, template) = template();
        let cases = Cases::of(&ring, &template).unwrap();
        for kind in [EffectKind::CorrectorDead, EffectKind::CorrectorPolarity] {
            let drawn = (0..).map(|i| cases.draw(Class::Single, Class::Single.number(i), 1));
            let some = drawn.filter(|case| case.imperfections.is_some() && case.effects[0].kind == kind);
            for case in some.take(3) {
                let recording = case.recording(&ring, &template, case.imperfections.as_ref()).unwrap();
                let found = Diagnosis::of(&ring, &recording, |_| ()).unwrap();
                let named: Vec<_> = found.findings.iter().filter_map(|finding| finding.term().copied()).collect();
                assert_eq!(named, [case.effects[0].into()], "{}: {}", case.index, found.sentence);
            }
        }
    }
}
