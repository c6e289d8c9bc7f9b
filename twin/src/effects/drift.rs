//! Unrecorded drifts during a campaign.
//!
//! Every gradient is `k1 (1 + a t)` in a cycle at time t, from -1 to 1; per frame that is the parabola in t through the machines at the start, in
//! the middle and at the end, and its derivative at none is `t (dR/dln k1) k`. A response, which is the machine in mid-campaign, does not move.

use nalgebra::{DMatrix, RowVector2};

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

/// Change of the positions by a drift of all quadrupoles, rows frames [m], from those without, and of the tunes from mid-campaign to its end.
pub(super) fn of_frames(
    machine: &Machine,
    ring: &Ring,
    drives: &Drives,
    kick: &DMatrix<f64>,
    without: &[DMatrix<f64>; 2],
) -> Result<([DMatrix<f64>; 2], [f64; 2]), OrbitError> {
    let scaled = |factor: f64| machine.seen(&ring.with_strengths(&vec![factor; ring.quadrupoles.len()]));
    let (end, start) = (scaled(factor(machine.drift, 1.0))?, scaled(factor(machine.drift, -1.0))?);
    let tunes = [end.tunes.x - start.tunes.x, end.tunes.y - start.tunes.y].map(|change| 0.5 * change);
    let positions = |seen: &Seen| drives.positions(seen, kick);
    let (end, start) = (positions(&end), positions(&start));
    let of_plane = |plane: usize| {
        let (odd, even) = ((&end[plane] - &start[plane]) * 0.5, (&end[plane] + &start[plane]) * 0.5 - &without[plane]);
        in_time(odd + in_time(even, drives), drives)
    };
    Ok(([of_plane(0), of_plane(1)], tunes))
}

/// All gradients in proportion to the time.
fn of_gradients(about: &Signatures) -> Signature {
    let mut sum = about.nothing();
    (0..about.machine.ring.quadrupoles.len()).for_each(|at| sum += about.of_quadrupole(at));
    let tune_changes = &about.drives.time * RowVector2::from(sum.tunes);
    Signature { readings: in_time(sum.readings, about.drives), tunes: [0.0; 2], tune_changes }
}

/// Rows times the time of their frame.
fn in_time(mut change: DMatrix<f64>, drives: &Drives) -> DMatrix<f64> {
    change.row_iter_mut().zip(drives.time.iter()).for_each(|(mut row, time)| row *= *time);
    change
}
