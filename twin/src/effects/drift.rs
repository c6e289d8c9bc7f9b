//! Unrecorded drifts during a campaign.
//!
//! Every gradient is `k1 (1 + a t)` in a cycle at time t, from -1 to 1; per frame that is `t a (dR/dln k1) k`, and the derivative is the
//! same without a. A response, which is the machine in mid-campaign, does not move.

use nalgebra::DMatrix;

use super::drives::{Drives, Seen};
use super::mechanism::{Measured, Mechanism, Unit};
use super::{EffectError, Machine, Signature, Signatures};
use crate::lattice::Ring;
use crate::orbit::OrbitError;
use crate::site::Site;

/// What drifts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum DriftEffect {
    /// The gradients of all quadrupoles, from `-a` to `a`.
    Quadrupoles,
}

/// Relative step of all gradients for the derivative that a drift needs; its truncation is 1e-6 of the derivative.
const STEP: f64 = 1e-4;

impl Mechanism for DriftEffect {
    fn word(&self) -> &'static str {
        match self {
            Self::Quadrupoles => "quad_drift",
        }
    }

    /// Supplies warm up by per mille.
    fn prior_scale(&self) -> Option<f64> {
        match self {
            Self::Quadrupoles => Some(2e-3),
        }
    }

    fn unit(&self) -> Unit {
        match self {
            Self::Quadrupoles => Unit::PER_MILLE,
        }
    }

    fn sites(&self, _ring: &Ring) -> Vec<Site> {
        vec![Site::Ring]
    }

    fn expected(&self) -> &'static str {
        "no place"
    }

    fn site(&self, _ring: &Ring, name: &str) -> Option<Site> {
        name.is_empty().then_some(Site::Ring)
    }

    fn apply(&self, machine: &mut Machine, site: Site, amplitude: f64) -> Result<(), EffectError> {
        match (self, site) {
            (Self::Quadrupoles, Site::Ring) => machine.drift += amplitude,
            _ => return Err(self.misplaced(&machine.ring, site.name(&machine.ring))),
        }
        Ok(())
    }

    fn signature(&self, about: &Signatures, site: Site) -> Result<Signature, EffectError> {
        match (self, site) {
            (Self::Quadrupoles, Site::Ring) => Ok(of_gradients(about)),
            _ => Err(self.misplaced(&about.machine.ring, site.name(&about.machine.ring))),
        }
    }

    fn phrase(&self, _ring: &Ring, _site: Site, amplitude: Measured) -> String {
        match self {
            Self::Quadrupoles => {
                format!("all quadrupoles drifted by {} per mille from start to end", amplitude.signed(2.0 * 1e3))
            }
        }
    }
}

/// Factor on all gradients in a cycle.
pub(super) fn factor(drift: f64, time: f64) -> f64 {
    1.0 + drift * time
}

/// Change of the positions by a drift of all quadrupoles, rows frames [m], and of the tunes.
pub(super) fn of_frames(
    machine: &Machine,
    ring: &Ring,
    drives: &Drives,
    kick: &DMatrix<f64>,
) -> Result<([DMatrix<f64>; 2], [f64; 2]), OrbitError> {
    let scaled = |factor: f64| machine.seen(&ring.with_strengths(&vec![factor; ring.quadrupoles.len()]));
    let (up, down) = (scaled(1.0 + STEP)?, scaled(1.0 - STEP)?);
    let per_step = machine.drift / (2.0 * STEP);
    let tunes = [up.tunes.x - down.tunes.x, up.tunes.y - down.tunes.y].map(|change| change * per_step);
    let positions = |seen: &Seen| drives.positions(seen, kick);
    let ([up_x, up_y], [down_x, down_y]) = (positions(&up), positions(&down));
    let by_time = |change: DMatrix<f64>| in_time(change * per_step, drives);
    Ok(([by_time(up_x - down_x), by_time(up_y - down_y)], tunes))
}

/// All gradients in proportion to the time.
fn of_gradients(about: &Signatures) -> Signature {
    let mut sum = about.nothing();
    (0..about.machine.ring.quadrupoles.len()).for_each(|at| sum += about.of_quadrupole(at));
    Signature { readings: in_time(sum.readings, about.drives), tunes: [0.0; 2], tune_drift: sum.tunes }
}

/// Rows times the time of their frame.
fn in_time(mut change: DMatrix<f64>, drives: &Drives) -> DMatrix<f64> {
    change.row_iter_mut().zip(drives.time.iter()).for_each(|(mut row, time)| row *= *time);
    change
}
