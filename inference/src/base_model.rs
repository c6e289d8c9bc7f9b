//! What the design may be wrong in throughout the ring: two decks of one machine differ so, and chi-square does not tell, since vars imitate it.
//!
//! Each term has one amplitude, normal about 0 with the width by which decks, codes and magnetic measurements of one machine differ. An exact design has no
//! terms.
//!
//! Source of the widths: two decks of the AGS Booster, whose dipoles differ by a body gradient of 0.7 mrad/m, whose energies by 4 % and whose kick constants by 28 %.

use nalgebra::DVector;
use twin::{Effect, EffectKind, Machine, Measured, Plane, Rf, Ring, Site};

use crate::imperfection::{Imperfection, Measure};
use crate::prior::Prior;

/// One property of the whole ring.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BaseTerm {
    /// A gradient in every dipole, K1L [1/m].
    DipoleGradient,
    /// Edge angle of every dipole [rad].
    DipoleEdge,
    /// Momentum off the one that the quadrupoles are powered for, as a fraction.
    Momentum,
    /// Momentum per step of the RF frequency, `1/eta` with the kinetic energy, as a fraction.
    RfStep,
    /// Kick per ampere of all correctors of a plane, as a fraction.
    Kick(Plane),
}

/// An amplitude as fitted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FittedTerm {
    /// Of which property.
    pub term: BaseTerm,
    /// Value and standard deviation, in the unit of [`BaseTerm::kind`].
    pub measured: Measured,
}

impl FittedTerm {
    /// As a row of the table of imperfections.
    pub fn imperfection(&self) -> Imperfection {
        let Self { term, measured } = *self;
        Imperfection {
            name: term.name(),
            kind: term.kind().word(),
            at: term.place().into(),
            measure: Measure::Mean,
            measured,
            unit: term.kind().unit(),
            ordinary: term.ordinary(),
        }
    }
}

/// The properties that a fit takes for uncertain.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BaseModel {
    terms: &'static [BaseTerm],
}

/// Least factor of a kick constant: a fit does not reverse all correctors.
const LEAST: f64 = 0.2;
/// Step of a derivative by differences, in widths: the response changes by a hundred-thousandth.
const STEP: f64 = 1e-3;

impl BaseTerm {
    /// All of them.
    pub const ALL: [Self; 6] = [
        Self::DipoleGradient,
        Self::DipoleEdge,
        Self::Momentum,
        Self::RfStep,
        Self::Kick(Plane::X),
        Self::Kick(Plane::Y),
    ];

    /// What it is.
    pub const fn name(self) -> &'static str {
        match self {
            Self::DipoleGradient => "gradient in all dipoles",
            Self::DipoleEdge => "edge angle of all dipoles",
            Self::Momentum => "momentum",
            Self::RfStep => "momentum per RF step",
            Self::Kick(_) => "kick constant",
        }
    }

    /// The kind of effect that all magnets, or correctors, of the ring have.
    pub const fn kind(self) -> EffectKind {
        match self {
            Self::DipoleGradient => EffectKind::DipoleGradient,
            Self::DipoleEdge => EffectKind::DipoleEdge,
            Self::Momentum => EffectKind::MomentumOffset,
            Self::RfStep => EffectKind::RfStep,
            Self::Kick(_) => EffectKind::CorrectorGain,
        }
    }

    /// Amplitude that is ordinary, in the unit of the kind: of its width, but for a kick constant, which a magnetic measurement tells to some per cent
    /// and which decks state with another length or current all the same.
    pub const fn ordinary(self) -> f64 {
        match self {
            Self::Kick(_) => 0.03,
            _ => self.width(),
        }
    }

    /// Standard deviation of its amplitude, in the unit of the kind.
    pub const fn width(self) -> f64 {
        match self {
            Self::DipoleGradient => 2e-3,
            Self::DipoleEdge => 5e-3,
            Self::Momentum => 1e-3,
            Self::RfStep => 0.03,
            Self::Kick(_) => 0.2,
        }
    }

    /// The correctors that it is of, `H` or `V`; `all` of what has no plane.
    pub const fn place(self) -> &'static str {
        match self {
            Self::Kick(Plane::X) => "H",
            Self::Kick(Plane::Y) => "V",
            _ => "all",
        }
    }

    fn range(self) -> [f64; 2] {
        let least = if let Self::Kick(_) = self { LEAST - 1.0 } else { f64::NEG_INFINITY };
        [least, f64::INFINITY]
    }

    /// Amplitude that a derivative is taken over.
    pub(crate) const fn step(self) -> f64 {
        STEP * self.width()
    }

    fn changed(self, ring: &Ring, amplitude: f64) -> Ring {
        let kind = self.kind();
        let put = |ring: &Ring, sites: Vec<Site>| {
            let effects: Vec<Effect> = sites.into_iter().map(|site| Effect { kind, site, amplitude }).collect();
            let machine = Machine::new(ring.clone(), Rf::FixedMomentum, &effects).expect("sites of the kind");
            machine.ring().clone()
        };
        match self {
            Self::DipoleGradient => put(ring, kind.sites(ring)),
            Self::DipoleEdge => put(ring, vec![Site::Ring]),
            // x'' = -k1 x / (1 + delta)
            Self::Momentum => ring.with_strengths(&vec![1.0 / (1.0 + amplitude); ring.quadrupoles.len()]),
            Self::RfStep | Self::Kick(_) => ring.clone(),
        }
    }
}

impl BaseModel {
    /// A design that is taken for exact.
    pub const EXACT: Self = Self { terms: &[] };
    /// A design with the uncertainty that designs have.
    pub const UNCERTAIN: Self = Self { terms: &BaseTerm::ALL };

    /// What changes the ring itself: vars imitate it.
    pub const MAGNETS: Self = Self { terms: &[BaseTerm::DipoleGradient, BaseTerm::DipoleEdge, BaseTerm::Momentum] };
    /// What scales kicks and RF offsets: vars cannot imitate it.
    pub const SCALES: Self = Self { terms: &[BaseTerm::RfStep, BaseTerm::Kick(Plane::X), BaseTerm::Kick(Plane::Y)] };

    /// Its terms.
    pub fn terms(&self) -> &'static [BaseTerm] {
        self.terms
    }

    /// A ring with amplitudes of the terms.
    pub(crate) fn ring(&self, ring: &Ring, amplitudes: &[f64]) -> Ring {
        let changes = self.terms.iter().zip(amplitudes).filter(|(_, amplitude)| **amplitude != 0.0);
        changes.fold(ring.clone(), |ring, (term, amplitude)| term.changed(&ring, *amplitude))
    }

    /// Factor on the kick of each corrector [C].
    pub(crate) fn kick_factors(&self, ring: &Ring, amplitudes: &[f64]) -> DVector<f64> {
        let factor = |plane: Plane| 1.0 + self.amplitude(BaseTerm::Kick(plane), amplitudes);
        DVector::from_iterator(ring.correctors.len(), ring.correctors.iter().map(|corrector| factor(corrector.plane)))
    }

    /// Factor on the orbit of an RF offset.
    pub(crate) fn rf_factor(&self, amplitudes: &[f64]) -> f64 {
        1.0 + self.amplitude(BaseTerm::RfStep, amplitudes)
    }

    fn amplitude(&self, term: BaseTerm, amplitudes: &[f64]) -> f64 {
        self.terms.iter().position(|own| *own == term).map_or(0.0, |at| amplitudes[at])
    }

    /// A prior of the params, and after them of the terms.
    pub(crate) fn prior(&self, params: &Prior) -> Prior {
        let mut prior = params.clone();
        for term in self.terms {
            prior.mean = prior.mean.push(0.0);
            prior.precision = prior.precision.push(term.width().powi(-2));
            prior.range.push(term.range());
        }
        prior
    }
}
