//! What drove the beam in the frames of a campaign, and the linear optics of the machine that it drove.

use nalgebra::{DMatrix, DVector};

use super::machine::Machine;
use crate::lattice::{Plane, Ring};
use crate::orbit::{Hold, OrbitError};
use crate::response::Optics;
use crate::tune::Tunes;

/// What drove the beam in the frames of a campaign, in the order of time, and the orbit that the kicks were added to.
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

/// Linear optics of a machine at its monitors.
pub(super) struct Seen {
    /// Response of x and y, rows monitors, columns correctors and, last, the RF frequency offset.
    pub response: [DMatrix<f64>; 2],
    /// Tunes.
    pub tunes: Tunes,
}

impl Machine {
    /// Kicks that the frames really had.
    pub(super) fn kicks(&self, drives: &Drives) -> DMatrix<f64> {
        let mut kick = drives.kick.clone();
        self.correctors.iter().for_each(|one| one.of_frames(&mut kick, drives.nominal_kick));
        kick
    }

    /// Linear optics of a ring that holds what this machine holds.
    pub(super) fn seen(&self, ring: &Ring) -> Result<Seen, OrbitError> {
        self.seen_by(ring, &Optics::of(ring, Hold::Momentum { delta: self.hold.delta })?)
    }

    /// The same, given the ring's optics at this momentum.
    pub(super) fn seen_by(&self, ring: &Ring, optics: &Optics) -> Result<Seen, OrbitError> {
        let held = self.held_of(ring, optics)?;
        let sources = optics.correctors();
        let with_rf = |plane: Plane| {
            let places = optics.monitor_places(plane);
            let response = held.response(optics, &places, &sources);
            let at = response.ncols();
            let mut all = response.insert_column(at, 0.0);
            all.set_column(at, &held.rf_response(optics, &places));
            all
        };
        Ok(Seen { response: [Plane::X, Plane::Y].map(with_rf), tunes: optics.tunes()? })
    }
}

impl Ring {
    /// The columns of the read monitors, each in its own plane, of x and y at all monitors.
    pub(super) fn own_planes(&self, positions: &[DMatrix<f64>; 2]) -> DMatrix<f64> {
        DMatrix::from_fn(positions[0].nrows(), self.read_monitors.len(), |frame, b| {
            let at = self.read_monitors[b];
            positions[self.monitors[at].plane.index()][(frame, at)]
        })
    }
}

impl Drives {
    /// The same frames without kicks and RF offsets.
    #[must_use]
    pub fn still(&self) -> Self {
        let (kick, rf_offset) = (&self.kick * 0.0, &self.rf_offset * 0.0);
        Self { kick, rf_offset, time: self.time.clone(), orbit: self.orbit.clone(), ..*self }
    }

    /// Positions x and y at the monitors, rows frames.
    pub(super) fn positions(&self, seen: &Seen, kick: &DMatrix<f64>) -> [DMatrix<f64>; 2] {
        let correctors = kick.ncols();
        [0, 1].map(|plane| {
            let response = &seen.response[plane];
            let mut positions = kick * response.columns(0, correctors).transpose();
            positions.ger(1.0, &self.rf_offset, &response.column(correctors), 1.0);
            positions
        })
    }
}
