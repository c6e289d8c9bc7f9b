//! A machine with the ordinary imperfections that the base model allows for, drawn as it takes them for granted.
//!
//! Of a family whose width is learnt the width itself is drawn, half-normal about its tolerance, and then each member; of another each member by the tolerance. Gradients and edge
//! angles of single dipoles, which no fit holds, have theirs too. The noise is off the header's by as much as that is quoted.

use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use twin::Effect;

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

impl Families {
    /// Those of a machine with such recordings.
    pub fn of(data: &Data) -> Self {
        let drawn = |family: Family, scatters| Drawn { members: family.members(data), width: family.width, scatters };
        let ordinary = Family::all().into_iter().map(|family| drawn(family, family.is_learnt()));
        let hidden = Family::hidden(data).into_iter().map(|family| drawn(family, false));
        Self(ordinary.chain(hidden).collect())
    }

    /// Draw a machine.
    pub fn draw(&self, random: &mut impl Rng) -> Imperfections {
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
