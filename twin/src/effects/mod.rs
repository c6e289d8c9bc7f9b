//! Physics that a ring may have beyond its design, in the words of the command line: `KIND[@PLACE][=AMPLITUDE]`.
//!
//! An effect changes the ring itself, what the machine holds constant, or what its monitors and correctors say; a
//! [`Machine`] is a ring with effects applied, and answers with the response that would then be measured.

#[cfg(test)]
mod agreement;
mod drives;
mod held;
mod library;
mod machine;
mod signature;
mod track;

use core::str::FromStr;

use crate::lattice::LatticeError;
use crate::orbit::OrbitError;

pub use drives::Drives;
pub use machine::{Machine, MachineResponse, Rf};
pub use signature::{Signature, Signatures};
pub use track::{Cycle, Tracked};

/// One effect: kind, place and amplitude.
#[derive(Debug, Clone, PartialEq)]
pub struct Effect {
    /// What happens.
    pub kind: EffectKind,
    /// Where, by half-cell or element name; empty where the kind acts on the whole ring.
    pub place: String,
    /// How much; the unit is that of the kind.
    pub amplitude: f64,
}

macro_rules! kinds {
    ($($(#[$doc:meta])* $variant:ident = $word:literal,)*) => {
        /// The kinds of effect.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        pub enum EffectKind { $($(#[$doc])* $variant,)* }
        impl EffectKind {
            /// Every kind, in the order of the list.
            pub const ALL: &[Self] = &[$(Self::$variant,)*];
            /// The word for it.
            pub fn word(self) -> &'static str {
                match self { $(Self::$variant => $word,)* }
            }
        }
    };
}

kinds! {
    /// A monitor reads too much by this fraction.
    BpmGain = "bpm_gain",
    /// A corrector kicks too much by this fraction.
    CorrectorGain = "corrector_gain",
    /// A monitor is rotated [rad].
    BpmRoll = "bpm_roll",
    /// A corrector is rotated [rad].
    CorrectorRoll = "corrector_roll",
    /// A quadrupole is rotated [rad].
    QuadRoll = "quad_roll",
    /// A monitor reads x (1 + a x^2), a in [1/mm^2]; a response, the limit of small kicks, shows it on a displaced orbit.
    BpmCubic = "bpm_cubic",
    /// Two monitors' names are exchanged.
    BpmSwap = "bpm_swap",
    /// A corrector's sign is reversed.
    CorrectorPolarity = "corrector_polarity",
    /// A corrector's strength differs between its signs; cancels in the difference that a response is.
    CorrectorEven = "corrector_even",
    /// A gradient where the model has none, K1L [1/m].
    StrayGradient = "stray_gradient",
    /// A skew gradient where the model has none, K1sL [1/m].
    StraySkewGradient = "stray_skew_gradient",
    /// A gradient in a dipole's body, K1L [1/m].
    DipoleGradient = "dipole_gradient",
    /// Edge angle of one dipole, or of all without a place [rad].
    DipoleEdge = "dipole_edge",
    /// A sextupole field, K2L [1/m^2]; a response shows it on a displaced orbit.
    SextupoleError = "sextupole_error",
    /// The beam is off momentum.
    MomentumOffset = "momentum_offset",
    /// The RF frequency is held instead of the momentum, as a fraction.
    FixedRfFrequency = "fixed_rf_frequency",
    /// The mean of two monitors is held instead of the momentum, as a fraction; `@x_D8,x_E6`.
    RadialLoop = "radial_loop",
    /// All quadrupoles drift from -a to +a during a run; its mean, which a response is, does not move.
    QuadDrift = "quad_drift",
}

/// Why an effect cannot be applied.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EffectError {
    /// An unknown kind.
    #[error("unknown effect {found:?}; known: {}", EffectKind::ALL.iter().map(|k| k.word()).collect::<Vec<_>>().join(", "))]
    Kind {
        /// What was written.
        found: String,
    },
    /// An amplitude that is not a finite number.
    #[error("effect {effect}: expected a finite amplitude, found {found:?}")]
    Amplitude {
        /// The effect.
        effect: String,
        /// What was written.
        found: String,
    },
    /// A place that the kind cannot act on.
    #[error("effect {kind}: expected {expected}, found {found:?}")]
    Place {
        /// The kind.
        kind: &'static str,
        /// What the kind acts on.
        expected: &'static str,
        /// What was written.
        found: String,
    },
    /// No stable motion with it.
    #[error("effect {effect}: {error}")]
    Orbit {
        /// The kind.
        effect: &'static str,
        /// Why.
        error: OrbitError,
    },
    /// A place that the ring lacks.
    #[error(transparent)]
    Lattice(#[from] LatticeError),
}

impl FromStr for Effect {
    type Err = EffectError;

    fn from_str(text: &str) -> Result<Self, EffectError> {
        let (head, amplitude) = text.split_once('=').unwrap_or((text, "1"));
        let (word, place) = head.split_once('@').unwrap_or((head, ""));
        let kind = EffectKind::ALL.iter().copied().find(|k| k.word() == word);
        let kind = kind.ok_or_else(|| EffectError::Kind { found: word.into() })?;
        let amplitude: Option<f64> = amplitude.parse().ok().filter(|a: &f64| a.is_finite());
        let amplitude = amplitude.ok_or_else(|| EffectError::Amplitude {
            effect: word.into(),
            found: text.split_once('=').map_or("", |p| p.1).into(),
        })?;
        Ok(Self { kind, place: place.into(), amplitude })
    }
}

impl Effect {
    /// An effect on the whole ring takes no place.
    pub(super) fn everywhere(&self) -> Result<(), EffectError> {
        if self.place.is_empty() { Ok(()) } else { Err(self.wrong("no place")) }
    }

    pub(super) fn wrong(&self, expected: &'static str) -> EffectError {
        EffectError::Place { kind: self.kind.word(), expected, found: self.place.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Ring;

    #[test]
    fn words_parse_and_unknown_ones_are_refused() {
        let effect: Effect = "bpm_swap@x_E4,x_E6".parse().unwrap();
        assert_eq!((effect.kind, effect.place.as_str(), effect.amplitude), (EffectKind::BpmSwap, "x_E4,x_E6", 1.0));
        assert!(
            "bpm_gian@x_E4"
                .parse::<Effect>()
                .unwrap_err()
                .to_string()
                .starts_with("unknown effect \"bpm_gian\"; known: bpm_gain,")
        );
        assert_eq!(
            "bpm_gain@x_E4=nan".parse::<Effect>().unwrap_err().to_string(),
            "effect bpm_gain: expected a finite amplitude, found \"nan\""
        );
        let astray = Machine::new(Ring::booster(), Rf::FixedMomentum, &["stray_gradient@QH_A2".parse().unwrap()]);
        assert_eq!(
            astray.unwrap_err().to_string(),
            "effect stray_gradient: expected a free straight such as SLOT_F6, found \"QH_A2\""
        );
    }
}
