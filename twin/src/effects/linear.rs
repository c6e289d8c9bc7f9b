//! What the monitors of a machine read in the frames of a campaign, by linear optics about its baseline orbit.
//!
//! With `k` the kicks that a frame really had (gains, polarities and even parts applied), `f` its RF offset, `t` its time from
//! -1 to 1 and `R` the response of the ring with all its effects,
//!
//! `position = R k - (D/eta) f + t a (dR/dln k1) k + t^2 a^2 (d^2R/d(ln k1)^2) k/2 + quadratic terms of sextupole fields`,
//!
//! and the monitors' errors (gain, roll, cubic term, exchanged names) are applied last. Everything is the change
//! against the orbit without kicks, whose own reading is unknown and constant. A sextupole field and a cubic term depend on
//! that orbit: it is part of [`Drives`].

use nalgebra::DMatrix;

use super::drift;
use super::drives::Drives;
use super::field::Crossed;
use super::machine::Machine;
use crate::orbit::{Hold, OrbitError};
use crate::response::Optics;
use crate::tune::Tunes;

impl Machine {
    /// Readings of the read monitors, rows frames, columns monitors [m], the tunes in mid-campaign, and how much they change
    /// from there to the end.
    ///
    /// # Errors
    /// [`OrbitError`] if the machine is unstable.
    pub fn readings(&self, drives: &Drives) -> Result<(DMatrix<f64>, Tunes, [f64; 2]), OrbitError> {
        let ring = self.on_orbit(&drives.orbit).ring;
        let optics = Optics::of(&ring, Hold::Momentum { delta: self.hold.delta })?;
        let seen = self.seen_by(&ring, &optics)?;
        let kick = self.kicks(drives);
        let mut positions = drives.positions(&seen, &kick);
        let mut tune_drift = [0.0; 2];
        if self.drift != 0.0 {
            let (change, of_tunes) = drift::of_frames(self, &ring, drives, &kick, &positions)?;
            add(&mut positions, change);
            tune_drift = of_tunes;
        }
        if !self.sextupoles.is_empty() {
            let held = self.held_of(&ring, &optics)?;
            add(&mut positions, Crossed::of(&optics, &held, &self.sextupoles, drives, &kick).curved());
        }
        let mut base: Vec<[f64; 2]> = self.ring.monitors.iter().map(|monitor| drives.orbit[monitor.element]).collect();
        self.monitors.iter().for_each(|reading| reading.of_changes(&self.ring, &mut base, &mut positions));
        Ok((self.ring.own_planes(&positions), seen.tunes, tune_drift))
    }
}

fn add(positions: &mut [DMatrix<f64>; 2], [x, y]: [DMatrix<f64>; 2]) {
    positions[0] += x;
    positions[1] += y;
}
