//! The cases of the validation: each is fixed by its number and one seed for all.

use diagnosis::{Data, DataError, Term, candidates, in_order};
use inference::Campaign;
use inference::recording::Recording;
use inference::simulate::{self, Beyond, Hardware};
use rand::rngs::StdRng;
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use serde::{Deserialize, Serialize};
use twin::{Effect, EffectError, EffectKind, Ring};

use super::imperfect::{Families, Imperfections};
use super::unmodelled::{Unmodelled, UnmodelledKind};
use crate::score::{TrueCause, TrueEffect, Truth};

/// Class of a case.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Class {
    /// No effect.
    Empty,
    /// One effect of the library.
    Single,
    /// Two of them.
    Pair,
    /// Physics that the library does not hold.
    Unknown,
}

/// One blind campaign.
#[derive(Debug, Clone)]
pub struct Case {
    /// Its number.
    pub index: usize,
    /// Its class.
    pub class: Class,
    /// Factor on each quadrupole.
    pub vars: Vec<f64>,
    /// Effects of the library.
    pub effects: Vec<Effect>,
    /// Physics that it does not hold.
    pub unmodelled: Vec<Unmodelled>,
    /// Ordinary imperfections of its machine; none of one that is ideal but for its vars.
    pub imperfections: Option<Imperfections>,
    /// Seed of the machine's hardware and noise.
    pub seed: u64,
}

/// What cases are drawn from.
#[derive(Debug, Clone)]
pub struct Cases {
    ring: Ring,
    /// All effects that could be seen.
    terms: Vec<Term>,
    families: Families,
}

/// Amplitudes in prior standard deviations, weak to strong; the logarithm is uniform in between.
const SIZES: [f64; 2] = [0.2, 2.5];

/// Cases of a class are numbered from its place in the list of classes times this.
const OF_CLASS: usize = 1_000_000;

impl Class {
    /// The number of its `index`-th case.
    pub fn number(self, index: usize) -> usize {
        self as usize * OF_CLASS + index
    }
}

impl Cases {
    /// Campaigns with the ring and the settings of one.
    ///
    /// # Errors
    /// [`DataError`] if that cannot be diagnosed.
    pub fn of(template: &Campaign) -> Result<Self, DataError> {
        let data = Data::from_campaign(template)?;
        let terms = candidates(&data, template.recording.header.radial_loop_monitors.as_ref());
        Ok(Self { ring: template.ring.clone(), terms, families: Families::of(&data) })
    }

    /// Case `number` of a class; half of all machines have ordinary imperfections.
    ///
    /// # Panics
    /// If there is no effect to choose from.
    pub fn draw(&self, class: Class, number: usize, seed: u64) -> Case {
        let Self { ring, terms, families } = self;
        let mut streams = simulate::seeds(seed ^ (number as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let mut stream = || streams.next().expect("seeds do not end");
        let vars = simulate::vars(ring, true, stream()).expect("a design has tunes, and rings like it");
        let mut random = StdRng::seed_from_u64(stream());
        let kinds: Vec<EffectKind> =
            EffectKind::ALL.iter().copied().filter(|kind| terms.iter().any(|term| term.kind == *kind)).collect();
        let mut effect = |index: usize| {
            let kind = kinds[index % kinds.len()];
            let of_kind: Vec<&Term> = terms.iter().filter(|term| term.kind == kind).collect();
            let term = of_kind.choose(&mut random).expect("every kind has a place");
            let sign = if random.random_bool(0.5) { -1.0 } else { 1.0 };
            let size = random.random_range(SIZES[0].ln()..SIZES[1].ln()).exp();
            let amplitude = kind.prior_scale().map_or(1.0, |scale| sign * size * scale);
            term.effect(amplitude)
        };
        let effects = match class {
            Class::Empty | Class::Unknown => Vec::new(),
            Class::Single => vec![effect(number)],
            Class::Pair => vec![effect(number), effect(7 * number + 3)],
        };
        let unknown = UnmodelledKind::in_ring(ring);
        let kind = unknown[number % unknown.len()];
        let unmodelled = if class == Class::Unknown { vec![Unmodelled::of(kind, ring, stream())] } else { Vec::new() };
        let seed = stream();
        let mut of_machine = StdRng::seed_from_u64(stream());
        let is_imperfect = of_machine.random_bool(0.5);
        let imperfections = is_imperfect.then(|| families.draw(ring, &vars, &mut of_machine)).flatten();
        Case { index: number, class, vars, effects, unmodelled, imperfections, seed }
    }
}

impl Case {
    /// Its recording.
    ///
    /// # Errors
    /// [`EffectError`] if its machine keeps no beam.
    pub fn recording(&self, ring: &Ring, template: &Recording) -> Result<Recording, EffectError> {
        let mut hardware = Hardware::shipped(ring, template);
        let ordinary = self.imperfections.iter().flat_map(|one| one.effects.iter().copied());
        let effects = in_order(self.effects.clone(), ordinary);
        if let Some(Imperfections { noise, .. }) = &self.imperfections {
            hardware.noise.iter_mut().for_each(|own| *own *= noise);
        }
        let beyond: Vec<&dyn Beyond> = self.unmodelled.iter().map(|one| one as &dyn Beyond).collect();
        let truth = simulate::Truth { vars: &self.vars, effects: &effects, beyond: &beyond };
        simulate::campaign(template, ring, &truth, &hardware, self.seed)
    }

    /// The truth.
    pub fn key(&self, ring: &Ring) -> Truth {
        let library = self.effects.iter().map(|effect| TrueEffect {
            cause: TrueCause::Effect((*effect).into()),
            amplitude: (!effect.kind.is_switch()).then_some(effect.amplitude),
        });
        let unmodelled = self.unmodelled.iter().map(|one| TrueEffect {
            cause: TrueCause::Unmodelled { what: one.kind.word().into(), at: one.site.name(ring) },
            amplitude: Some(one.size),
        });
        Truth {
            effects: library.chain(unmodelled).collect(),
            vars: ring.var_names().into_iter().zip(self.vars.iter().copied()).collect(),
            oracle_gain: None,
        }
    }
}
