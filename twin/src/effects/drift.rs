//! Unrecorded drifts during a campaign.
//!
//! Every gradient is `k1 (1 + a t)` in a cycle at time t, from -1 to 1; per frame that is the parabola in t through the machines at the start, in
//! the middle and at the end, of derivatives too. Beside a drift of 4 per mille the tunes of all frames say more of the vars than the orbits do; derivatives
//! of mid-campaign, which at 5 per mille are off by more than a tenth in the first and the last frames, would bias the vars. A response, which is the
//! machine in mid-campaign, does not move.

use nalgebra::{DMatrix, MatrixXx2};

use super::drives::Drives;
use super::mechanism::{Measured, Mechanism, Unit};
use super::{EffectError, Machine, Signature, Signatures};
use crate::lattice::Ring;
use crate::orbit::OrbitError;
use crate::site::Site;
use crate::tune::Tunes;

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

/// Change of the positions by a drift of all quadrupoles, rows frames [m], from those without, and of the tunes from those in mid-campaign.
pub(super) fn of_frames(
    machine: &Machine,
    ring: &Ring,
    drives: &Drives,
    kick: &DMatrix<f64>,
    without: &[DMatrix<f64>; 2],
    tunes: &Tunes,
) -> Result<([DMatrix<f64>; 2], MatrixXx2<f64>), OrbitError> {
    let at = |time: f64| machine.seen(&drifted(ring, machine.drift, time));
    let ends = [at(-1.0)?, at(1.0)?];
    let [start, end] = ends.each_ref().map(|seen| [seen.tunes.x, seen.tunes.y]);
    let of_tunes = MatrixXx2::from_fn(drives.time.len(), |i, plane| {
        change_at(drives.time[i], [start[plane], [tunes.x, tunes.y][plane], end[plane]])
    });
    let [[start_x, start_y], [end_x, end_y]] = ends.map(|seen| drives.positions(&seen, kick));
    let positions = [changes([start_x, end_x], &without[0], drives), changes([start_y, end_y], &without[1], drives)];
    Ok((positions, of_tunes))
}

impl Machine {
    /// The machines at the start and at the end of a drift, without one; none of one that does not drift.
    pub fn ends(&self) -> Option<[Self; 2]> {
        let at = |time: f64| Self { ring: drifted(&self.ring, self.drift, time), drift: 0.0, ..self.clone() };
        (self.drift != 0.0).then(|| [-1.0, 1.0].map(at))
    }
}

/// The signature in every frame, from those in mid-campaign, at the start and at the end.
pub(super) fn signature([start, end]: [Signature; 2], middle: Signature, drives: &Drives) -> Signature {
    let tune_changes = MatrixXx2::from_fn(drives.time.len(), |i, plane| {
        let of_frame = [&start, &middle, &end].map(|one| one.tune(plane, i));
        middle.tune_changes[(i, plane)] + change_at(drives.time[i], of_frame)
    });
    let of_readings = changes([start.readings, end.readings], &middle.readings, drives);
    Signature { readings: middle.readings + of_readings, tune_changes, ..middle }
}

/// All gradients in proportion to the time.
fn of_gradients(about: &Signatures) -> Signature {
    let mut sum = about.nothing();
    (0..about.machine.ring.quadrupoles.len()).for_each(|at| sum += about.of_quadrupole(at));
    let time = &about.drives.time;
    let tune_changes = MatrixXx2::from_fn(time.len(), |i, plane| time[i] * sum.tune(plane, i));
    sum.readings.row_iter_mut().zip(time.iter()).for_each(|(mut row, time)| row *= *time);
    Signature { readings: sum.readings, tunes: [0.0; 2], tune_changes }
}

/// A ring at a time of a drift.
fn drifted(ring: &Ring, drift: f64, time: f64) -> Ring {
    ring.with_strengths(&vec![factor(drift, time); ring.quadrupoles.len()])
}

/// What the frames, which are rows, differ by from mid-campaign.
fn changes([start, end]: [DMatrix<f64>; 2], middle: &DMatrix<f64>, drives: &Drives) -> DMatrix<f64> {
    DMatrix::from_fn(middle.nrows(), middle.ncols(), |i, j| {
        change_at(drives.time[i], [&start, middle, &end].map(|one| one[(i, j)]))
    })
}

/// Change from mid-campaign at a time from -1 to 1, by the parabola through the start, the middle and the end.
pub fn change_at(time: f64, [start, middle, end]: [f64; 3]) -> f64 {
    let (odd, even) = (0.5 * (end - start), 0.5 * (end + start) - middle);
    (odd + even * time) * time
}
