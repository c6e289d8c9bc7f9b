//! What the monitors of a machine read in the frames of a campaign, by linear optics about its baseline orbit.
//!
//! With `k` the kicks that a frame really had (gains, polarities and even parts applied), `f` its RF offset, `t` its time from
//! -1 to 1 and `R` the response of the ring with all its effects,
//!
//! `position = R k - (D/eta) f + t a (dR/dln k1) k + quadratic terms of sextupole fields`,
//!
//! and what a monitor makes of a position (gain, roll, cubic term, exchanged names) comes last. Everything is the change
//! against the orbit without kicks, whose own reading is unknown and constant. A sextupole field and a cubic term depend on
//! that orbit: it is part of [`Drives`].

use nalgebra::{DMatrix, DVector, RowVector2};

use super::machine::{Instrument, Machine, planes, rows};
use crate::lattice::{Kind, Plane, Ring};
use crate::orbit::{Hold, OrbitError};
use crate::response::{Optics, Place, Tunes};

/// What drove the beam in the frames of a campaign, and the orbit that the kicks were added to.
#[derive(Debug, Clone)]
pub struct Drives {
    /// Kicks as believed, rows frames, columns correctors of the ring [rad].
    pub kick: DMatrix<f64>,
    /// Relative RF frequency offset of each frame [1].
    pub rf_offset: DVector<f64>,
    /// Time of each frame, from -1 for the first to 1 for the last.
    pub time: DVector<f64>,
    /// Kick of a corrector at its nominal setting [rad].
    pub nominal_kick: f64,
    /// The orbit (x, y) without kicks at the entrance of every element [m].
    pub orbit: Vec<[f64; 2]>,
}

/// Linear optics of a machine at its monitor places: columns are the correctors and, last, the RF frequency offset.
pub(super) struct Seen {
    pub x: DMatrix<f64>,
    pub y: DMatrix<f64>,
    pub tunes: Tunes,
}

/// Relative step of all gradients for the derivative that a drift needs; its truncation is 1e-6 of the derivative.
const STEP: f64 = 1e-4;

impl Machine {
    /// Readings of the read monitors, rows frames, columns monitors [m], the tunes in mid-campaign, and how much they change
    /// from there to the end.
    ///
    /// # Errors
    /// [`OrbitError`] if the machine is unstable.
    pub fn readings(&self, drives: &Drives) -> Result<(DMatrix<f64>, Tunes, [f64; 2]), OrbitError> {
        let ring = self.on_orbit(&drives.orbit);
        let seen = self.seen(&ring)?;
        let kick = self.kicks(drives);
        let (mut x, mut y) = drives.positions(&seen, &kick);
        let mut tune_drift = [0.0; 2];
        if self.drift != 0.0 {
            let ([dx, dy], change) = self.drifting(&ring, drives, &kick)?;
            x += dx;
            y += dy;
            tune_drift = change;
        }
        for &(element, k2l) in &self.sextupoles {
            // seen by the ring without its gradient: what that changes is of third order
            let [dx, dy] = curved(&self.ring, element, k2l, drives, &kick)?;
            x += dx;
            y += dy;
        }
        self.instruments.iter().for_each(|instrument| self.read_frames(instrument, drives, &mut x, &mut y));
        Ok((self.own_planes(&x, &y), seen.tunes, tune_drift))
    }

    /// Kicks that the frames really had.
    pub(super) fn kicks(&self, drives: &Drives) -> DMatrix<f64> {
        let mut kick = drives.kick.clone();
        for instrument in &self.instruments {
            match *instrument {
                Instrument::Kick { corrector, factor } => kick.column_mut(corrector).apply(|k| *k *= factor),
                Instrument::Even { corrector, share } => {
                    kick.column_mut(corrector).apply(|k| *k += share * *k * *k / drives.nominal_kick);
                }
                _ => {}
            }
        }
        kick
    }

    /// The ring with what each stray sextupole is to a small deviation from the orbit (x, y) that passes it: a gradient
    /// `k2 x` and a skew gradient `k2 y`, which together are a rolled quadrupole. Its dipole part is in the orbit already.
    fn on_orbit(&self, orbit: &[[f64; 2]]) -> Ring {
        let mut ring = self.ring.clone();
        for &(at, _) in &self.sextupoles {
            let ([x, y], element) = (orbit[at], &mut ring.elements[at]);
            if let Kind::Sextupole { k2 } = element.kind {
                element.kind = Kind::Quadrupole { k1: k2 * x.hypot(y) };
                element.misalignment.roll = -0.5 * y.atan2(x);
            }
        }
        ring
    }

    pub(super) fn seen(&self, ring: &Ring) -> Result<Seen, OrbitError> {
        let optics = Optics::of(ring, Hold::Momentum { delta: self.delta })?;
        let (x, y) = self.held(ring, &optics)?;
        let eta = optics.slip_factor();
        let rf = |plane| optics.monitor_places(plane).iter().map(|o| -optics.dispersion(o) / eta).collect::<Vec<_>>();
        let with_rf = |response: DMatrix<f64>, plane| {
            let at = response.ncols();
            let mut all = response.insert_column(at, 0.0);
            all.column_mut(at).copy_from_slice(&rf(plane));
            all
        };
        Ok(Seen { x: with_rf(x, Plane::X), y: with_rf(y, Plane::Y), tunes: optics.tunes()? })
    }

    /// Change of the positions by the drift of all quadrupoles, and of the tunes.
    fn drifting(
        &self,
        ring: &Ring,
        drives: &Drives,
        kick: &DMatrix<f64>,
    ) -> Result<([DMatrix<f64>; 2], [f64; 2]), OrbitError> {
        let scaled = |factor: f64| self.seen(&ring.with_strengths(&vec![factor; ring.quadrupoles.len()]));
        let (up, down) = (scaled(1.0 + STEP)?, scaled(1.0 - STEP)?);
        let per_step = self.drift / (2.0 * STEP);
        let tunes = [up.tunes.x - down.tunes.x, up.tunes.y - down.tunes.y].map(|change| change * per_step);
        let (up, down) = (drives.positions(&up, kick), drives.positions(&down, kick));
        let slope = |up: DMatrix<f64>, down: DMatrix<f64>| {
            let mut change = (up - down) * per_step;
            change.row_iter_mut().zip(drives.time.iter()).for_each(|(mut row, time)| row *= *time);
            change
        };
        Ok(([slope(up.0, down.0), slope(up.1, down.1)], tunes))
    }

    /// What one monitor makes of the positions at its place.
    fn read_frames(&self, instrument: &Instrument, drives: &Drives, x: &mut DMatrix<f64>, y: &mut DMatrix<f64>) {
        match *instrument {
            Instrument::Gain { plane, place, error } => {
                rows(plane, x, y).column_mut(place).apply(|p| *p *= 1.0 + error)
            }
            Instrument::Cubic { plane, place, per_square_mm } => {
                let base = drives.orbit[self.ring.monitors[place].element][usize::from(plane == Plane::Y)];
                let cube = |position: f64| position * (position * 1e3).powi(2);
                rows(plane, x, y).column_mut(place).apply(|p| *p += per_square_mm * (cube(base + *p) - cube(base)));
            }
            Instrument::Roll { place, angle } => {
                let (sin, cos) = angle.sin_cos();
                let (mut x, mut y) = (x.column_mut(place), y.column_mut(place));
                for (x, y) in x.iter_mut().zip(y.iter_mut()) {
                    (*x, *y) = (*x * cos + *y * sin, *y * cos - *x * sin);
                }
            }
            Instrument::Swap { plane, places } => rows(plane, x, y).swap_columns(places[0], places[1]),
            Instrument::Kick { .. } | Instrument::Even { .. } => {}
        }
    }

    /// The columns of the read monitors, each in its own plane.
    pub(super) fn own_planes(&self, x: &DMatrix<f64>, y: &DMatrix<f64>) -> DMatrix<f64> {
        let column = |&place: &usize| match self.ring.monitors[place].plane {
            Plane::X => x.column(place),
            Plane::Y => y.column(place),
        };
        let columns: Vec<_> = self.ring.read_monitors.iter().map(column).collect();
        DMatrix::from_columns(&columns)
    }
}

impl Drives {
    /// Positions (x, y) at the monitor places, rows frames.
    pub(super) fn positions(&self, seen: &Seen, kick: &DMatrix<f64>) -> (DMatrix<f64>, DMatrix<f64>) {
        let correctors = kick.ncols();
        let of = |response: &DMatrix<f64>| {
            let mut positions = kick * response.columns(0, correctors).transpose();
            positions.ger(1.0, &self.rf_offset, &response.column(correctors), 1.0);
            positions
        };
        (of(&seen.x), of(&seen.y))
    }
}

/// Orbit that the quadratic terms of a sextupole field make: `dx' = -K2L (dx^2 - dy^2)/2`, `dy' = K2L dx dy`, with (dx, dy) the
/// orbit that the kicks and the RF offset make in its middle.
pub(super) fn curved(
    ring: &Ring,
    element: usize,
    k2l: f64,
    drives: &Drives,
    kick: &DMatrix<f64>,
) -> Result<[DMatrix<f64>; 2], OrbitError> {
    let optics = Optics::of(ring, Hold::Momentum { delta: 0.0 })?;
    let middle = Place { element, depth: 0.5 * ring.elements[element].length };
    let observers = [optics.observe(middle, Plane::X), optics.observe(middle, Plane::Y)];
    let mut orbit = kick * optics.response(&observers, &optics.correctors()).transpose();
    let rf = RowVector2::from(observers.map(|o| -optics.dispersion(&o) / optics.slip_factor()));
    orbit += &drives.rf_offset * rf;
    let from = [[1.0, 0.0], [0.0, 1.0]].map(|direction| optics.kick(middle, direction));
    let strength = |[a, b]: [f64; 2]| [-0.5 * k2l * (a * a - b * b), k2l * a * b];
    let kicks =
        DMatrix::from_fn(orbit.nrows(), 2, |frame, plane| strength([orbit[(frame, 0)], orbit[(frame, 1)]])[plane]);
    let (x, y) = planes(&optics, &from);
    Ok([&kicks * x.transpose(), kicks * y.transpose()])
}
