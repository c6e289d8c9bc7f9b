//! Errors of correctors: gain, roll, reversed polarity, even part.
//!
//! The actual kick is one function of the nominal kick and of an amplitude, [`CorrectorEffect::kick`]; a rolled magnet kicks
//! in both planes, as an element of the ring.

use nalgebra::{DMatrix, DVector};
use num_dual::first_derivative;

use super::mechanism::{Measured, Mechanism, Unit};
use super::{EffectError, Machine, Signature, Signatures};
use crate::lattice::Ring;
use crate::map::Scalar;
use crate::site::Site;

/// What is wrong with a corrector.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum CorrectorEffect {
    /// It kicks too much by a fraction.
    Gain,
    /// It is rotated [rad]; a magnet that kicks in both planes is so in both.
    Roll,
    /// Its sign is reversed.
    Polarity,
    /// Its kick differs between its signs by twice this share of the nominal one; cancels in the difference that a response is.
    Even,
}

/// What a corrector does in a machine.
#[derive(Debug, Clone)]
pub(super) struct Kick {
    how: CorrectorEffect,
    corrector: usize,
    amplitude: f64,
}

impl CorrectorEffect {
    /// The actual kick for a nominal one [rad].
    fn kick<T: Scalar>(self, amplitude: T, believed: T, nominal: f64) -> T {
        match self {
            Self::Gain => believed * (amplitude + 1.0),
            Self::Polarity => -believed,
            Self::Even => believed + amplitude * believed * believed / nominal,
            Self::Roll => believed,
        }
    }

    /// Change of the kick per unit of the amplitude; the whole change without one.
    fn change(self, believed: f64, nominal: f64) -> f64 {
        match self.prior_scale() {
            Some(_) => first_derivative(|amplitude| self.kick(amplitude, believed.into(), nominal), 0.0).1,
            None => self.kick(1.0, believed, nominal) - believed,
        }
    }
}

impl Mechanism for CorrectorEffect {
    fn word(&self) -> &'static str {
        match self {
            Self::Gain => "corrector_gain",
            Self::Roll => "corrector_roll",
            Self::Polarity => "corrector_polarity",
            Self::Even => "corrector_even",
        }
    }

    /// Gains found by LOCO scatter by 2 to 5 %, faulty ones by 10 %; a bracket's play turns a magnet by 50 mrad.
    ///
    /// Source: J. Safranek, NIM A 388 (1997) 27.
    fn prior_scale(&self) -> Option<f64> {
        match self {
            Self::Gain => Some(0.08),
            Self::Roll => Some(0.06),
            Self::Even => Some(0.05),
            Self::Polarity => None,
        }
    }

    fn unit(&self) -> Unit {
        match self {
            Self::Gain | Self::Even => Unit::PERCENT,
            Self::Roll => Unit::ANGLE,
            Self::Polarity => Unit::NONE,
        }
    }

    fn sites(&self, ring: &Ring) -> Vec<Site> {
        let is_one = |&at: &usize| match self {
            Self::Gain | Self::Polarity | Self::Even => true,
            Self::Roll => rolled(ring, at) == at,
        };
        (0..ring.correctors.len()).filter(is_one).map(Site::Corrector).collect()
    }

    fn expected(&self) -> &'static str {
        "a corrector"
    }

    fn site(&self, ring: &Ring, name: &str) -> Option<Site> {
        let at = Site::corrector(ring, name)?;
        Some(Site::Corrector(match self {
            Self::Gain | Self::Polarity | Self::Even => at,
            Self::Roll => rolled(ring, at),
        }))
    }

    fn apply(&self, machine: &mut Machine, site: Site, amplitude: f64) -> Result<(), EffectError> {
        let ring = &mut machine.ring;
        let Site::Corrector(corrector) = site else { return Err(self.misplaced(ring, site.name(ring))) };
        match self {
            Self::Roll => ring.elements[ring.correctors[corrector].element].misalignment.roll += amplitude,
            Self::Gain | Self::Polarity | Self::Even => {
                machine.correctors.push(Kick { how: *self, corrector, amplitude });
            }
        }
        Ok(())
    }

    fn signature(&self, about: &Signatures, site: Site) -> Result<Signature, EffectError> {
        let ring = &about.machine.ring;
        let Site::Corrector(corrector) = site else { return Err(self.misplaced(ring, site.name(ring))) };
        let mut signature = about.nothing();
        match self {
            Self::Roll => {
                for at in of_element(ring, ring.correctors[corrector].element) {
                    signature.readings.ger(1.0, &about.kick.column(at), &turned(about, at), 1.0);
                }
            }
            Self::Gain | Self::Polarity | Self::Even => {
                let nominal = about.drives.nominal_kick;
                let change = about.kick.column(corrector).map(|kick| self.change(kick, nominal));
                signature.readings = change * about.response.column(corrector).transpose();
            }
        }
        Ok(signature)
    }

    fn phrase(&self, ring: &Ring, site: Site, amplitude: Measured) -> String {
        let name = site.name(ring);
        match self {
            Self::Gain => {
                format!(
                    "corrector {name} kicks {} % too {}",
                    amplitude.size(100.0),
                    amplitude.by_sign("much", "little")
                )
            }
            Self::Roll => format!("corrector {name} is rolled by {} mrad", amplitude.signed(1e3)),
            Self::Polarity => format!("corrector {name} has the wrong polarity"),
            Self::Even => {
                let more = amplitude.by_sign("more", "less");
                format!("corrector {name} kicks {} % {more} at + than at -", amplitude.size(2.0 * 100.0))
            }
        }
    }
}

impl Kick {
    /// The kick of a corrector in place of the one that it had [rad].
    pub fn given(&self, corrector: usize, kick: f64, nominal: f64) -> f64 {
        if corrector == self.corrector { self.how.kick(self.amplitude, kick, nominal) } else { kick }
    }

    /// The same in all frames, rows frames, columns correctors.
    pub fn of_frames(&self, kick: &mut DMatrix<f64>, nominal: f64) {
        kick.column_mut(self.corrector).apply(|kick| *kick = self.given(self.corrector, *kick, nominal));
    }

    /// The same of a response, columns correctors: in the limit of small kicks, so that any nominal one will do.
    pub fn of_response(&self, response: &mut [DMatrix<f64>; 2]) {
        let slope = first_derivative(|kick| self.how.kick(self.amplitude.into(), kick, 1.0), 0.0).1;
        response.iter_mut().for_each(|plane| plane.column_mut(self.corrector).scale_mut(slope));
    }
}

/// What the read monitors see of a corrector's kick, turned by a right angle [m/rad].
fn turned(about: &Signatures, corrector: usize) -> DVector<f64> {
    let corrector = &about.machine.ring.correctors[corrector];
    let [x, y] = about.optics.axis(corrector);
    let source = about.optics.kick(corrector.element, [-y, x]);
    about.held.response(&about.optics, &about.observers, &[source]).column(0).into_owned()
}

/// The correctors of an element.
fn of_element(ring: &Ring, element: usize) -> impl Iterator<Item = usize> {
    (0..ring.correctors.len()).filter(move |&at| ring.correctors[at].element == element)
}

/// The corrector that a rolled one is named after: the first of its element.
fn rolled(ring: &Ring, corrector: usize) -> usize {
    of_element(ring, ring.correctors[corrector].element).next().unwrap_or(corrector)
}
