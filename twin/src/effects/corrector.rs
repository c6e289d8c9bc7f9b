//! Errors of correctors: gain, roll, coupling, reversed polarity, no kick, exchanged cables, even part, a share of the kick that goes to another one or stays.
//!
//! Of a gain, a polarity, a dead one and an even part the actual kick is one function of the nominal kick and of an amplitude,
//! [`CorrectorEffect::kick`]; a rolled magnet kicks in both planes, as an element of the ring. Crosstalk adds `a` times the kick of one to that of the next, a coupling to the
//! one of the same magnet in the other plane; a
//! corrector with hysteresis kicks `k + a k_before`, `k_before` what it had before its present setting; one that settles lacks `a` of each change in the frame
//! after it, `a^2` in the next: in frame i it kicks `j_i = k_i + a (j_(i-1) - k_i)`.

use nalgebra::{DMatrix, DVector, DVectorView};
use num_dual::first_derivative;

use super::mechanism::{Measured, Mechanism, Unit};
use super::monitor::{coming, mix};
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
    /// A magnet of both planes gives a share of its kick in one to the other plane as well, as where its coils are not at right angles.
    Coupling,
    /// Its sign is reversed.
    Polarity,
    /// It does not kick, whatever its read-back says.
    Dead,
    /// Its cable and another one's are exchanged: each gives the kick that is believed of the other.
    Swap,
    /// Its kick differs between its signs by twice this share of the nominal one; cancels in the difference that a response is.
    Even,
    /// A share of its kick goes to the next one of its plane as well, of the last one to the first.
    Crosstalk,
    /// A share of the kick that it had before its present setting stays.
    Hysteresis,
    /// A share of each change is missing in the frame after it, and the same share of that in the next.
    Settling,
}

/// What a corrector does in a machine.
#[derive(Debug, Clone)]
pub(super) enum Kick {
    Changed { how: CorrectorEffect, corrector: usize, amplitude: f64 },
    Exchanged { correctors: [usize; 2] },
    Shared { corrector: usize, with: usize, share: f64 },
    Kept { corrector: usize, share: f64 },
    Lagging { corrector: usize, share: f64 },
}

/// Change of a kick, in nominal ones, that is another setting: read-backs fluctuate by per mille.
const ANOTHER: f64 = 0.25;

impl CorrectorEffect {
    /// The actual kick for a nominal one [rad].
    fn kick<T: Scalar>(self, amplitude: T, believed: T, nominal: f64) -> T {
        match self {
            Self::Gain => believed * (amplitude + 1.0),
            Self::Polarity => -believed,
            Self::Dead => believed * 0.0,
            Self::Even => believed + amplitude * believed * believed / nominal,
            Self::Roll | Self::Coupling | Self::Swap | Self::Crosstalk | Self::Hysteresis | Self::Settling => believed,
        }
    }

    /// The corrector that a share of the kick goes to as well.
    fn with(self, ring: &Ring, corrector: usize) -> Option<usize> {
        match self {
            Self::Coupling => other_plane(ring, corrector),
            Self::Crosstalk => next(ring, corrector),
            _ => None,
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
            Self::Coupling => "corrector_coupling",
            Self::Polarity => "corrector_polarity",
            Self::Dead => "corrector_dead",
            Self::Swap => "corrector_swap",
            Self::Even => "corrector_even",
            Self::Crosstalk => "corrector_crosstalk",
            Self::Hysteresis => "corrector_hysteresis",
            Self::Settling => "corrector_settling",
        }
    }

    /// Gains found by LOCO scatter by 2 to 5 %, faulty ones by 10 %; a bracket's play turns a magnet by 50 mrad, and coils are wound to some per cent of a right angle;
    /// a return that two supplies
    /// share, or a controller's channels, leak some per cent; iron keeps some per mille of its field, a magnet with closed gaps some
    /// per cent. A slow regulator or eddy currents in a thick chamber leave some per cent of a change to the next cycle, a wrong time constant tens.
    ///
    /// Source: J. Safranek, NIM A 388 (1997) 27.
    fn prior_scale(&self) -> Option<f64> {
        match self {
            Self::Gain => Some(0.08),
            Self::Roll => Some(0.06),
            Self::Coupling | Self::Even | Self::Crosstalk => Some(0.05),
            Self::Hysteresis => Some(0.03),
            Self::Settling => Some(0.1),
            Self::Polarity | Self::Dead | Self::Swap => None,
        }
    }

    fn unit(&self) -> Unit {
        match self {
            Self::Gain | Self::Coupling | Self::Even | Self::Crosstalk | Self::Hysteresis | Self::Settling => {
                Unit::PERCENT
            }
            Self::Roll => Unit::ANGLE,
            Self::Polarity | Self::Dead | Self::Swap => Unit::NONE,
        }
    }

    fn sites(&self, ring: &Ring) -> Vec<Site> {
        if *self == Self::Swap {
            return pairs(ring);
        }
        let is_one = |&at: &usize| match self {
            Self::Gain | Self::Polarity | Self::Dead | Self::Even | Self::Hysteresis | Self::Settling => true,
            Self::Roll => rolled(ring, at) == at,
            Self::Coupling | Self::Crosstalk => self.with(ring, at).is_some(),
            Self::Swap => false,
        };
        (0..ring.correctors.len()).filter(is_one).map(Site::Corrector).collect()
    }

    fn expected(&self) -> &'static str {
        match self {
            Self::Gain | Self::Roll | Self::Polarity | Self::Dead | Self::Even | Self::Hysteresis | Self::Settling => {
                "a corrector"
            }
            Self::Coupling => "a corrector that kicks in both planes",
            Self::Crosstalk => "a corrector with another one in its plane",
            Self::Swap => "two correctors of one plane",
        }
    }

    fn site(&self, ring: &Ring, name: &str) -> Option<Site> {
        let one = || Site::corrector(ring, name);
        match self {
            Self::Gain | Self::Polarity | Self::Dead | Self::Even | Self::Hysteresis | Self::Settling => {
                one().map(Site::Corrector)
            }
            Self::Roll => one().map(|at| Site::Corrector(rolled(ring, at))),
            Self::Coupling | Self::Crosstalk => one().filter(|&at| self.with(ring, at).is_some()).map(Site::Corrector),
            Self::Swap => {
                let [one, other] = Site::correctors(ring, name)?;
                of_a_plane(ring, one, other).then(|| Site::corrector_pair(one, other))
            }
        }
    }

    fn apply(&self, machine: &mut Machine, site: Site, amplitude: f64) -> Result<(), EffectError> {
        let ring = &mut machine.ring;
        let corrector = match (self, site) {
            (Self::Swap, Site::CorrectorPair(one, other)) => {
                machine.correctors.push(Kick::Exchanged { correctors: [one, other] });
                return Ok(());
            }
            (_, Site::Corrector(corrector)) => corrector,
            _ => return Err(self.misplaced(ring, site.name(ring))),
        };
        match self {
            Self::Swap => return Err(self.misplaced(ring, site.name(ring))),
            Self::Roll => ring.elements[ring.correctors[corrector].element].misalignment.roll += amplitude,
            Self::Gain | Self::Polarity | Self::Dead | Self::Even => {
                machine.correctors.push(Kick::Changed { how: *self, corrector, amplitude });
            }
            Self::Coupling | Self::Crosstalk => {
                let with = self.with(ring, corrector).ok_or_else(|| self.misplaced(ring, site.name(ring)))?;
                machine.correctors.push(Kick::Shared { corrector, with, share: amplitude });
            }
            Self::Hysteresis => machine.correctors.push(Kick::Kept { corrector, share: amplitude }),
            Self::Settling => machine.correctors.push(Kick::Lagging { corrector, share: amplitude }),
        }
        Ok(())
    }

    fn signature(&self, about: &Signatures, site: Site) -> Result<Signature, EffectError> {
        let ring = &about.machine.ring;
        let mut signature = about.nothing();
        let corrector = match (self, site) {
            (Self::Swap, Site::CorrectorPair(one, other)) => {
                let more = about.kick.column(other) - about.kick.column(one);
                let seen = about.response.column(one) - about.response.column(other);
                signature.readings = more * seen.transpose();
                return Ok(signature);
            }
            (_, Site::Corrector(corrector)) => corrector,
            _ => return Err(self.misplaced(ring, site.name(ring))),
        };
        match self {
            Self::Swap => return Err(self.misplaced(ring, site.name(ring))),
            Self::Roll => {
                for at in of_element(ring, ring.correctors[corrector].element) {
                    signature.readings.ger(1.0, &about.kick.column(at), &turned(about, at), 1.0);
                }
            }
            Self::Gain | Self::Polarity | Self::Dead | Self::Even => {
                let nominal = about.drives.nominal_kick;
                let change = about.kick.column(corrector).map(|kick| self.change(kick, nominal));
                signature.readings = change * about.response.column(corrector).transpose();
            }
            Self::Coupling | Self::Crosstalk => {
                let with = self.with(ring, corrector).ok_or_else(|| self.misplaced(ring, site.name(ring)))?;
                signature.readings = about.kick.column(corrector) * about.response.column(with).transpose();
            }
            Self::Hysteresis => {
                let before = before(&about.kick.column(corrector), about.drives.nominal_kick);
                signature.readings = before * about.response.column(corrector).transpose();
            }
            Self::Settling => {
                let lacking = coming(&about.kick.column(corrector));
                signature.readings = lacking * about.response.column(corrector).transpose();
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
            Self::Dead => format!("corrector {name} does not kick"),
            Self::Swap => format!("the cables of correctors {} are exchanged", site.names(ring).join(" and ")),
            Self::Even => {
                let more = amplitude.by_sign("more", "less");
                format!("corrector {name} kicks {} % {more} at + than at -", amplitude.size(2.0 * 100.0))
            }
            Self::Coupling | Self::Crosstalk => {
                let Site::Corrector(at) = site else { unreachable!("it acts on correctors") };
                let other = self.with(ring, at).map_or_else(String::new, |other| ring.corrector_name(other));
                format!("{} % of the kick of corrector {name} goes to {other} as well", amplitude.signed(100.0))
            }
            Self::Hysteresis => {
                format!("corrector {name} keeps {} % of the kick that it had before", amplitude.signed(100.0))
            }
            Self::Settling => {
                format!("corrector {name} is late: the frame after a change lacks {} % of it", amplitude.signed(100.0))
            }
        }
    }
}

impl Kick {
    /// The kicks in place of those that were, rows frames in the order of time, columns correctors [rad].
    pub fn of_frames(&self, kick: &mut DMatrix<f64>, nominal: f64) {
        match self {
            Self::Changed { how, corrector, amplitude } => {
                kick.column_mut(*corrector).apply(|kick| *kick = how.kick(*amplitude, *kick, nominal));
            }
            Self::Exchanged { correctors: [one, other] } => kick.swap_columns(*one, *other),
            Self::Shared { corrector, with, share } => mix(kick, *with, *corrector, *share),
            Self::Kept { corrector, share } => {
                let kept = before(&kick.column(*corrector), nominal) * *share;
                let mut column = kick.column_mut(*corrector);
                column += kept;
            }
            Self::Lagging { corrector, share } => {
                let mut column = kick.column_mut(*corrector);
                let mut given = column[0];
                for kick in &mut column {
                    given = *kick + share * (given - *kick);
                    *kick = given;
                }
            }
        }
    }

    /// The same of a response, columns correctors: in the limit of small kicks, so that any nominal one will do and none was before.
    pub fn of_response(&self, response: &mut [DMatrix<f64>; 2]) {
        match self {
            Self::Changed { how, corrector, amplitude } => {
                let slope = first_derivative(|kick| how.kick((*amplitude).into(), kick, 1.0), 0.0).1;
                response.iter_mut().for_each(|plane| plane.column_mut(*corrector).scale_mut(slope));
            }
            Self::Exchanged { correctors: [one, other] } => {
                response.iter_mut().for_each(|plane| plane.swap_columns(*one, *other));
            }
            Self::Shared { corrector, with, share } => {
                response.iter_mut().for_each(|plane| mix(plane, *corrector, *with, *share));
            }
            Self::Kept { .. } | Self::Lagging { .. } => {}
        }
    }

    /// True for one that depends on the frames before.
    pub fn remembers(&self) -> bool {
        matches!(self, Self::Kept { .. } | Self::Lagging { .. })
    }
}

/// The kick that a corrector had before its present setting in each frame, 0 before the first one [rad].
fn before(kick: &DVectorView<f64>, nominal: f64) -> DVector<f64> {
    let (mut before, mut now) = (0.0, kick.iter().next().copied().unwrap_or(0.0));
    kick.map(|kick| {
        if (kick - now).abs() > ANOTHER * nominal.abs() {
            (before, now) = (now, kick);
        }
        before
    })
}

/// The corrector of the same element in the other plane.
fn other_plane(ring: &Ring, corrector: usize) -> Option<usize> {
    let crate::lattice::Corrector { element, plane } = ring.correctors[corrector];
    of_element(ring, element).find(|&other| ring.correctors[other].plane != plane)
}

/// The next corrector in the plane of one; after the last the first.
fn next(ring: &Ring, corrector: usize) -> Option<usize> {
    let others = || {
        let is_other =
            |&other: &usize| other != corrector && ring.correctors[other].plane == ring.correctors[corrector].plane;
        (0..ring.correctors.len()).filter(is_other)
    };
    others().find(|&other| other > corrector).or_else(|| others().next())
}

/// All pairs of correctors of one plane.
fn pairs(ring: &Ring) -> Vec<Site> {
    let n = ring.correctors.len();
    let all = (0..n).flat_map(|one| (one + 1..n).map(move |other| (one, other)));
    all.filter(|&(one, other)| of_a_plane(ring, one, other))
        .map(|(one, other)| Site::CorrectorPair(one, other))
        .collect()
}

fn of_a_plane(ring: &Ring, one: usize, other: usize) -> bool {
    ring.correctors[one].plane == ring.correctors[other].plane
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

#[cfg(test)]
mod tests {
    use super::*;

    /// Read-backs fluctuate; back at an old setting the corrector remembers where it comes from.
    #[test]
    fn a_corrector_remembers_its_last_setting() {
        let kick = DMatrix::from_column_slice(7, 1, &[0.01, 0.0, 1.0, 1.01, -1.0, 0.0, -0.01]);
        let mut given = kick.clone();
        Kick::Kept { corrector: 0, share: 0.1 }.of_frames(&mut given, 1.0);
        let kept = DMatrix::from_column_slice(7, 1, &[0.0, 0.0, 0.001, 0.001, 0.1, -0.1, -0.1]);
        assert!((given - kick - kept).abs().max() < 1e-12);
    }

    #[test]
    fn a_corrector_that_settles_lacks_a_falling_share_of_a_change() {
        let mut given = DMatrix::from_column_slice(5, 1, &[1.0, 1.0, 0.0, 0.0, 2.0]);
        Kick::Lagging { corrector: 0, share: 0.2 }.of_frames(&mut given, 1.0);
        let lagging = DMatrix::from_column_slice(5, 1, &[1.0, 1.0, 0.2, 0.04, 1.608]);
        assert!((given - lagging).abs().max() < 1e-12);
    }

    /// Exchanged twice they are as they were; a pair is the same in either order.
    #[test]
    fn exchanged_correctors_give_each_others_kicks() {
        let kick = DMatrix::from_fn(5, 3, |frame, c| (1.0 + c as f64) * (frame as f64).sin());
        let mut given = kick.clone();
        let swap = Kick::Exchanged { correctors: [0, 2] };
        swap.of_frames(&mut given, 1.0);
        assert_eq!([0, 1, 2].map(|c| given.column(c)), [2, 1, 0].map(|c| kick.column(c)));
        swap.of_frames(&mut given, 1.0);
        assert_eq!(given, kick);
        let ring = Ring::booster();
        // of 24 in each plane
        assert_eq!(pairs(&ring).len(), 2 * 24 * 23 / 2);
    }

    #[test]
    fn the_last_of_a_plane_shares_its_kick_with_the_first() {
        let ring = Ring::booster();
        let name = |name: &str| ring.corrector_name(next(&ring, Site::corrector(&ring, name).unwrap()).unwrap());
        assert_eq!([name("H_A2"), name("H_F8"), name("V_F7")], ["H_A4", "H_A2", "V_A1"]);
    }
}
