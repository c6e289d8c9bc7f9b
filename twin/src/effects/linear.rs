//! What the monitors of a machine read in the frames of a campaign, by linear optics about its baseline orbit.
//!
//! With `k` the kicks that a frame really had (gains, polarities and even parts applied), `f` its RF offset, `t` its time from
//! -1 to 1 and `R` the response of the ring with all its effects,
//!
//! `position = R k - (D/eta) f + t a (dR/dln k1) k + t^2 a^2 (k1^2 d^2R/dk1^2) k/2 + kicks of stray sextupole and octupole fields`,
//!
//! and the monitors' errors (gain, roll, coupling, cubic term, exchanged names) are applied last. Everything is the change
//! against the orbit without kicks, whose own reading is unknown and constant. Sextupole and octupole fields and a cubic term depend on
//! that orbit: it is part of [`Drives`].

use nalgebra::{DMatrix, MatrixXx2};

use super::drift;
use super::drives::{Drives, Seen};
use super::field::Crossed;
use super::machine::Machine;
use crate::lattice::{Plane, Ring};
use crate::orbit::{Hold, OrbitError};
use crate::response::Optics;
use crate::tune::Tunes;

impl Machine {
    /// Readings of the read monitors, rows frames, columns monitors [m], the tunes on the orbit without kicks in mid-campaign, and how much those
    /// of each frame differ, rows frames: by the drift, and by the orbit that crosses sextupole fields.
    ///
    /// # Errors
    /// [`OrbitError`] if the machine is unstable.
    pub fn readings(&self, drives: &Drives) -> Result<(DMatrix<f64>, Tunes, MatrixXx2<f64>), OrbitError> {
        let ring = self.on_orbit(&drives.orbit).ring;
        let optics = Optics::of(&ring, Hold::Momentum { delta: self.hold.delta })?;
        let seen = self.seen_by(&ring, &optics)?;
        let kick = self.kicks(drives);
        let mut positions = drives.positions(&seen, &kick);
        let mut tune_changes = MatrixXx2::zeros(kick.nrows());
        if self.drift != 0.0 {
            let (change, of_tunes) = drift::of_frames(self, &ring, drives, &kick, &positions, &seen.tunes)?;
            add(&mut positions, change);
            tune_changes += of_tunes;
        }
        if !self.curved.is_empty() {
            let held = self.held_of(&ring, &optics)?;
            let crossed = Crossed::of(&optics, &held, &self.curved, drives, &kick);
            add(&mut positions, crossed.curved());
            tune_changes += crossed.tune_changes();
        }
        let mut base: Vec<[f64; 2]> = self.ring.monitors.iter().map(|monitor| drives.orbit[monitor.element]).collect();
        self.monitors.iter().for_each(|reading| reading.of_changes(&self.ring, &mut base, &mut positions));
        Ok((self.ring.own_planes(&positions), seen.tunes, tune_changes))
    }

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

fn add(positions: &mut [DMatrix<f64>; 2], [x, y]: [DMatrix<f64>; 2]) {
    positions[0] += x;
    positions[1] += y;
}
