//! Exact closed orbits of single machine cycles, nothing linearised: what simulated campaigns are made of.
//!
//! The ring is as misaligned as its elements say. Kicks, supplies, drift and what the machine holds constant enter the exact
//! maps; the monitors' errors are applied last. An RF offset is relative to the frequency at which this ring
//! closes without kicks.

use super::drift;
use super::hold::Closing;
use super::machine::Machine;
use crate::lattice::Ring;
use crate::map::{DELTA, X, Y};
use crate::orbit::{ClosedOrbit, Hold, OrbitError};
use crate::response::Optics;
use crate::tune::Tunes;

/// What drives one machine cycle.
#[derive(Debug, Clone)]
pub struct Cycle {
    /// Kick that each corrector of the ring is believed to give [rad].
    pub kick: Vec<f64>,
    /// `ln` of the factor on each quadrupole's gradient.
    pub strength: Vec<f64>,
    /// Relative RF frequency offset [1].
    pub rf_offset: f64,
    /// Time within the campaign, -1 to 1.
    pub time: f64,
}

/// A machine that is evaluated cycle by cycle.
#[derive(Debug, Clone)]
pub struct Tracked {
    machine: Machine,
    nominal_kick: f64,
    closing: Closing,
}

impl Tracked {
    /// A machine whose correctors have a nominal setting of `nominal_kick` [rad].
    ///
    /// # Errors
    /// [`OrbitError`] if it has no closed orbit.
    pub fn of(machine: Machine, nominal_kick: f64) -> Result<Self, OrbitError> {
        let closing = Closing::of(&machine.ring, machine.hold)?;
        Ok(Self { machine, nominal_kick, closing })
    }

    /// What the read monitors make of the orbit of one cycle [m], offsets and noise left out, and the tunes.
    ///
    /// # Errors
    /// [`OrbitError`] if the ring keeps no beam in this cycle.
    pub fn cycle(&self, cycle: &Cycle) -> Result<(Vec<f64>, Tunes), OrbitError> {
        let (ring, orbit) = self.orbit(cycle)?;
        let readings = self.read(&ring, &orbit);
        let hold = Hold::Momentum { delta: orbit.at[0][DELTA] };
        Ok((readings, Optics::about(&ring, hold, orbit)?.tunes()?))
    }

    /// The same without the tunes, which next to a sum resonance a kicked orbit need not have.
    ///
    /// # Errors
    /// [`OrbitError`] without a closed orbit in this cycle.
    pub fn readings(&self, cycle: &Cycle) -> Result<Vec<f64>, OrbitError> {
        self.orbit(cycle).map(|(ring, orbit)| self.read(&ring, &orbit))
    }

    /// The ring of a cycle, and its closed orbit.
    fn orbit(&self, cycle: &Cycle) -> Result<(Ring, ClosedOrbit), OrbitError> {
        let ring = self.driven(cycle);
        let orbit = self.closing.orbit(&ring, cycle.rf_offset)?;
        Ok((ring, orbit))
    }

    /// What the read monitors make of an orbit [m].
    fn read(&self, ring: &Ring, orbit: &ClosedOrbit) -> Vec<f64> {
        let position = |monitor: &crate::Monitor| [X, Y].map(|at| orbit.at[monitor.element][at]);
        let mut at: Vec<[f64; 2]> = ring.monitors.iter().map(position).collect();
        self.machine.monitors.iter().for_each(|reading| reading.of_orbit(ring, &mut at));
        ring.read_monitors.iter().map(|&i| at[i][ring.monitors[i].plane.index()]).collect()
    }

    /// The ring with the kicks and gradients of a cycle.
    fn driven(&self, cycle: &Cycle) -> Ring {
        let machine = &self.machine;
        let drift = drift::factor(machine.drift, cycle.time);
        let factors: Vec<f64> = cycle.strength.iter().map(|strength| strength.exp() * drift).collect();
        let mut ring = machine.ring.with_strengths(&factors);
        for (corrector, &believed) in cycle.kick.iter().enumerate() {
            let given = |kick, one: &super::corrector::Kick| one.given(corrector, kick, self.nominal_kick);
            ring.set_kick(corrector, machine.correctors.iter().fold(believed, given));
        }
        ring
    }
}
