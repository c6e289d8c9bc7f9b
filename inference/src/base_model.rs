//! What the design may be wrong in throughout the ring: two decks of one machine differ so. Chi-square does not tell it of magnets, since vars imitate them.
//!
//! Each term has one amplitude, normal about 0 with the width by which decks, codes and magnetic measurements of one machine differ.
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
    pub(crate) fn imperfection(&self) -> Imperfection {
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

/// The properties that have amplitudes; those of an exact design are none.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BaseModel {
    terms: &'static [BaseTerm],
}

/// Least factor of a kick constant: a fit does not reverse all correctors.
const LEAST: f64 = 0.2;
/// Step of a derivative by differences, in widths: the response changes by a hundred-thousandth.
const STEP: f64 = 1e-3;

impl BaseTerm {
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
            Self::DipoleGradient => 1e-3,
            Self::DipoleEdge => 5e-3,
            Self::Momentum => 1e-3,
            Self::RfStep => 0.03,
            Self::Kick(_) => 0.2,
        }
    }

    /// The correctors that it is of, `H` or `V`; `all` of what has no plane.
    const fn place(self) -> &'static str {
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

    /// True for what changes the ring itself, not how kicks and RF offsets are scaled.
    pub(crate) const fn is_of_magnets(self) -> bool {
        matches!(self, Self::DipoleGradient | Self::DipoleEdge | Self::Momentum)
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

    /// What changes the ring itself: vars imitate it.
    pub(crate) const MAGNETS: Self =
        Self { terms: &[BaseTerm::DipoleGradient, BaseTerm::DipoleEdge, BaseTerm::Momentum] };
    /// What scales kicks and RF offsets: vars cannot imitate it, and a fit knows it.
    pub const SCALES: Self = Self { terms: &[BaseTerm::RfStep, BaseTerm::Kick(Plane::X), BaseTerm::Kick(Plane::Y)] };

    /// Its terms.
    pub(crate) fn terms(&self) -> &'static [BaseTerm] {
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

#[cfg(test)]
mod tests {
    use core::f64::consts::PI;

    use twin::{Hold, Optics};

    use super::*;
    use crate::campaign::Linearised;
    use crate::recording::Drive;

    const TERMS: [BaseTerm; 6] = [
        BaseTerm::DipoleGradient,
        BaseTerm::DipoleEdge,
        BaseTerm::Momentum,
        BaseTerm::RfStep,
        BaseTerm::Kick(Plane::X),
        BaseTerm::Kick(Plane::Y),
    ];
    const ALL: BaseModel = BaseModel { terms: &TERMS };

    fn amplitudes(term: BaseTerm, amplitude: f64) -> [f64; 6] {
        TERMS.map(|own| if own == term { amplitude } else { 0.0 })
    }

    /// `dQ = +-sum of beta K1L/(4 pi)`, beta at the middle of each dipole. Source: S. Y. Lee, Accelerator Physics, ch. 2, effects of gradient errors.
    #[test]
    fn a_gradient_in_all_dipoles_moves_the_tunes_as_the_text_book_says() {
        let (ring, a) = (Ring::booster(), 1e-5);
        let off = ALL.ring(&ring, &amplitudes(BaseTerm::DipoleGradient, a));
        let hold = Hold::Momentum { delta: 0.0 };
        let (optics, changed) = (Optics::of(&ring, hold).unwrap(), Optics::of(&off, hold).unwrap());
        let moved = [
            changed.tunes().unwrap().x - optics.tunes().unwrap().x,
            changed.tunes().unwrap().y - optics.tunes().unwrap().y,
        ];
        for (plane, sign) in [(Plane::X, 1.0), (Plane::Y, -1.0)] {
            let dipoles = EffectKind::DipoleGradient.sites(&ring).into_iter().map(|site| site.elements(&ring)[0]);
            let beta = |element: usize| {
                let [start, middle, end] = [0.0, 0.5, 1.0].map(|share| {
                    optics.beta(twin::Place { element, depth: share * ring.elements[element].length }, plane)
                });
                (start + 4.0 * middle + end) / 6.0
            };
            let known = sign * a / (4.0 * PI) * dipoles.map(beta).sum::<f64>();
            // Simpson's rule over a dipole of 10 degrees
            assert!((moved[plane.index()] / known - 1.0).abs() < 2e-3, "{moved:?} {known}");
        }
    }

    /// The derivative by each term is that of twice the step, and a kick constant's is the response itself.
    #[test]
    fn derivatives_are_those_of_the_orbits() {
        let ring = Ring::booster();
        let machine = Machine::new(ring.clone(), Rf::FixedMomentum, &[]).unwrap();
        let mut kick = DVector::zeros(48);
        (kick[3], kick[30]) = (2e-4, -1e-4);
        let drive = Drive { kick, strength: DVector::zeros(ring.supplies.len()), rf_offset: 2e-4 };
        let supplies = vec![0.0; ring.supplies.len()];
        let at = |amplitudes: [f64; 6]| {
            let params = DVector::from_iterator(54, (0..48).map(|_| 0.0).chain(amplitudes));
            let drives = core::slice::from_ref(&drive);
            let linearised = Linearised::about((&machine, ALL), &params, &supplies, drives).unwrap();
            (linearised.orbits(drives), linearised.slopes(drives))
        };
        let (_, slopes) = at([0.0; 6]);
        for (k, term) in TERMS.into_iter().enumerate() {
            let far = 0.1 * term.width();
            let [above, below] = [far, -far].map(|far| at(amplitudes(term, far)).0);
            let largest = (above.clone() - &below).amax() / (2.0 * far);
            for (b, slope) in slopes.iter().enumerate() {
                let known = (above[(0, b)] - below[(0, b)]) / (2.0 * far);
                assert!((slope[(48 + k, 0)] - known).abs() < 2e-3 * largest, "{term:?} at {b}");
            }
        }
    }
}
