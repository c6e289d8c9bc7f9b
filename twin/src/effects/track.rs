//! Exact closed orbits of machine cycles, nothing linearised: what simulated campaigns are made of.
//!
//! The ring is as misaligned as its elements say. Kicks, supplies, drift and what the machine holds constant enter the exact
//! maps; the monitors' errors are applied last, in the order of the cycles where they hold something of the one before. An RF offset is relative to the frequency at which this ring
//! closes without kicks.

use nalgebra::DMatrix;

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

    /// What the read monitors make of the orbits of a campaign's cycles, in the order of time [m], offsets and noise left out, rows cycles,
    /// and the tunes.
    ///
    /// # Errors
    /// [`OrbitError`] if the ring keeps no beam in one of the cycles.
    pub fn cycles(&self, cycles: &[Cycle]) -> Result<(DMatrix<f64>, Vec<Tunes>), OrbitError> {
        let tunes = |ring: &Ring, orbit: ClosedOrbit| {
            let hold = Hold::Momentum { delta: orbit.at[0][DELTA] };
            Optics::about(ring, hold, orbit)?.tunes()
        };
        self.read(cycles, tunes)
    }

    /// The same of one cycle, nothing before it.
    ///
    /// # Errors
    /// [`OrbitError`] if the ring keeps no beam in this cycle.
    pub fn cycle(&self, cycle: &Cycle) -> Result<(Vec<f64>, Tunes), OrbitError> {
        let (readings, tunes) = self.cycles(core::slice::from_ref(cycle))?;
        Ok((readings.iter().copied().collect(), tunes[0]))
    }

    /// The same without the tunes, which next to a sum resonance a kicked orbit need not have.
    ///
    /// # Errors
    /// [`OrbitError`] without a closed orbit in this cycle.
    pub fn readings(&self, cycle: &Cycle) -> Result<Vec<f64>, OrbitError> {
        let (readings, _) = self.read(core::slice::from_ref(cycle), |_, _| Ok(()))?;
        Ok(readings.iter().copied().collect())
    }

    /// What the read monitors make of the orbits of some cycles, and something of each of them.
    fn read<T>(
        &self,
        cycles: &[Cycle],
        of: impl Fn(&Ring, ClosedOrbit) -> Result<T, OrbitError>,
    ) -> Result<(DMatrix<f64>, Vec<T>), OrbitError> {
        let ring = &self.machine.ring;
        let mut positions = [X, Y].map(|_| DMatrix::zeros(cycles.len(), ring.monitors.len()));
        let mut each = Vec::with_capacity(cycles.len());
        for (i, (cycle, kick)) in cycles.iter().zip(self.kicks(cycles).row_iter()).enumerate() {
            let driven = self.driven(cycle, kick.iter().copied());
            let orbit = self.closing.orbit(&driven, cycle.rf_offset)?;
            for (plane, at) in [X, Y].into_iter().enumerate() {
                let position = |monitor: &crate::Monitor| orbit.at[monitor.element][at];
                positions[plane].row_mut(i).iter_mut().zip(&ring.monitors).for_each(|(to, b)| *to = position(b));
            }
            each.push(of(&driven, orbit)?);
        }
        let mut zero = vec![[0.0; 2]; ring.monitors.len()];
        self.machine.monitors.iter().for_each(|reading| reading.of_changes(ring, &mut zero, &mut positions));
        Ok((ring.own_planes(&positions), each))
    }

    /// The kicks that some cycles really had, rows cycles [rad].
    fn kicks(&self, cycles: &[Cycle]) -> DMatrix<f64> {
        let correctors = self.machine.ring.correctors.len();
        let mut kick = DMatrix::from_fn(cycles.len(), correctors, |i, c| cycles[i].kick[c]);
        self.machine.correctors.iter().for_each(|one| one.of_frames(&mut kick, self.nominal_kick));
        kick
    }

    /// The ring with the gradients of a cycle and some kicks.
    fn driven(&self, cycle: &Cycle, kick: impl Iterator<Item = f64>) -> Ring {
        let machine = &self.machine;
        let drift = drift::factor(machine.drift, cycle.time);
        let factors: Vec<f64> = cycle.strength.iter().map(|strength| strength.exp() * drift).collect();
        let mut ring = machine.ring.with_strengths(&factors);
        kick.enumerate().for_each(|(corrector, kick)| ring.set_kick(corrector, kick));
        ring
    }
}
