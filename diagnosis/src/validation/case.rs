//! The cases of the validation: each is fixed by its number and one seed for all.

use rand::rngs::StdRng;
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use serde::{Deserialize, Serialize};
use twin::{Effect, EffectKind, Ring};

use super::unmodelled::{Unmodelled, UnmodelledKind};
use crate::hypothesis::Term;
use crate::score::{TrueCause, TrueEffect, Truth};
use inference::simulate;

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
    /// Seed of the machine's hardware and noise.
    pub seed: u64,
}

/// Amplitudes in prior standard deviations, weak to strong; the logarithm is uniform in between.
const SIZES: [f64; 2] = [0.2, 2.5];

impl Case {
    /// Case `index` of a class; `terms` are all effects that could be seen.
    ///
    /// # Panics
    /// If there is no effect to choose from.
    pub fn draw(ring: &Ring, terms: &[Term], class: Class, index: usize, seed: u64) -> Self {
        let mut streams = simulate::seeds(seed ^ (index as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15));
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
            Class::Single => vec![effect(index)],
            Class::Pair => vec![effect(index), effect(7 * index + 3)],
        };
        let unknown = UnmodelledKind::in_ring(ring);
        let kind = unknown[index % unknown.len()];
        let unmodelled = if class == Class::Unknown { vec![Unmodelled::of(kind, ring, stream())] } else { Vec::new() };
        Self { index, class, vars, effects, unmodelled, seed: stream() }
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
