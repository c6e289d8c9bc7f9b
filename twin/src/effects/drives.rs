//! What drove the beam in the frames of a campaign, and where linear optics put it.

use nalgebra::{DMatrix, DVector};

use crate::lattice::Ring;
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
