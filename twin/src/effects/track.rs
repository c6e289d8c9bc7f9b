//! Exact closed orbits of single machine cycles, nothing linearised: what simulated campaigns are made of.
//!
//! The ring is as misaligned as its elements say. Kicks, supplies, drift and what the machine holds constant enter the exact
//! maps, and what the monitors make of the orbit comes last. An RF offset is relative to the frequency at which this ring
//! closes without kicks.

use super::machine::{Instrument, Machine};
use crate::lattice::{Kind, Plane, Ring};
use crate::map::{DELTA, X, Y};
use crate::orbit::{ClosedOrbit, Hold, OrbitError};
use crate::response::{Optics, Tunes};

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

/// A machine ready to be asked for one cycle after the other.
#[derive(Debug, Clone)]
pub struct Tracked {
    machine: Machine,
    gradients: Vec<f64>,
    nominal_kick: f64,
    /// The orbit without kicks, from which that of a cycle is sought.
    plain: ClosedOrbit,
    /// Relative frequency at which the ring closes without kicks.
    frequency: f64,
    /// Mean of the pair of a radial loop without kicks [m], and its dispersion [m].
    radial: [f64; 2],
}

impl Tracked {
    /// A machine whose correctors have a nominal setting of `nominal_kick` [rad].
    ///
    /// # Errors
    /// [`OrbitError`] if it has no closed orbit.
    pub fn of(machine: Machine, nominal_kick: f64) -> Result<Self, OrbitError> {
        let optics = Optics::of(&machine.ring, Hold::Momentum { delta: machine.delta })?;
        let radial = machine.radial_loop.map_or([0.0, 1.0], |(pair, _)| {
            let dispersion =
                |place: usize| optics.dispersion(&optics.observe(machine.ring.monitors[place].element, Plane::X));
            let orbit = optics.closed_orbit();
            [mean(&machine.ring, pair, orbit), 0.5 * (dispersion(pair[0]) + dispersion(pair[1]))]
        });
        let (plain, frequency) = (optics.closed_orbit().clone(), optics.frequency_offset());
        Ok(Self { gradients: machine.ring.gradients(), nominal_kick, plain, frequency, radial, machine })
    }

    /// What the read monitors make of the orbit of one cycle [m], offsets and noise left out, and the tunes.
    ///
    /// # Errors
    /// [`OrbitError`] if the ring keeps no beam in this cycle.
    pub fn cycle(&self, cycle: &Cycle) -> Result<(Vec<f64>, Tunes), OrbitError> {
        let ring = self.driven(cycle);
        let orbit = self.closed(&ring, cycle)?;
        let mut at: Vec<[f64; 2]> =
            ring.monitors.iter().map(|m| [orbit.at[m.element][X], orbit.at[m.element][Y]]).collect();
        self.machine.instruments.iter().for_each(|instrument| instrument.read_orbit(&mut at));
        let read = |&place: &usize| at[place][usize::from(ring.monitors[place].plane == Plane::Y)];
        let readings = ring.read_monitors.iter().map(read).collect();
        let hold = Hold::Momentum { delta: orbit.at[0][DELTA] };
        Ok((readings, Optics::about(&ring, hold, orbit)?.tunes()?))
    }

    /// The ring with the kicks and gradients of a cycle.
    fn driven(&self, cycle: &Cycle) -> Ring {
        let mut ring = self.machine.ring.clone();
        let drift = 1.0 + self.machine.drift * cycle.time;
        for ((q, k1), strength) in self.machine.ring.quadrupoles.iter().zip(&self.gradients).zip(&cycle.strength) {
            ring.elements[q.element].kind = Kind::Quadrupole { k1: k1 * strength.exp() * drift };
        }
        for (c, &believed) in cycle.kick.iter().enumerate() {
            let given = self.machine.instruments.iter().fold(believed, |kick, instrument| match *instrument {
                Instrument::Kick { corrector, factor } if corrector == c => kick * factor,
                Instrument::Even { corrector, share } if corrector == c => {
                    kick + share * kick * kick / self.nominal_kick
                }
                _ => kick,
            });
            ring.set_kick(c, given);
        }
        ring
    }

    /// The orbit on which the beam runs in a cycle, with whatever the machine holds.
    fn closed(&self, ring: &Ring, cycle: &Cycle) -> Result<ClosedOrbit, OrbitError> {
        let held = self.machine.delta;
        let at = |hold: Hold| ClosedOrbit::near(ring, hold, &self.plain);
        let at_frequency = |offset: f64| at(Hold::Frequency { offset: self.frequency + offset });
        let at_momentum = |delta: f64| at(Hold::Momentum { delta });
        if cycle.rf_offset != 0.0 {
            return at_frequency(cycle.rf_offset);
        }
        if self.machine.frequency_share != 0.0 {
            let full = at_frequency(0.0)?.at[0][DELTA];
            return at_momentum(held + self.machine.frequency_share * (full - held));
        }
        let orbit = at_momentum(held)?;
        let Some((pair, share)) = self.machine.radial_loop else { return Ok(orbit) };
        at_momentum(held - share * (mean(ring, pair, &orbit) - self.radial[0]) / self.radial[1])
    }
}

/// Mean horizontal orbit of two monitors.
fn mean(ring: &Ring, pair: [usize; 2], orbit: &ClosedOrbit) -> f64 {
    0.5 * pair.map(|place| orbit.at[ring.monitors[place].element][X]).iter().sum::<f64>()
}

impl Instrument {
    /// What a monitor makes of the orbit (x, y) at the places.
    fn read_orbit(&self, at: &mut [[f64; 2]]) {
        match *self {
            Self::Gain { plane, place, error } => at[place][usize::from(plane == Plane::Y)] *= 1.0 + error,
            Self::Cubic { plane, place, per_square_mm } => {
                let position = &mut at[place][usize::from(plane == Plane::Y)];
                *position *= 1.0 + per_square_mm * (*position * 1e3).powi(2);
            }
            Self::Roll { place, angle } => {
                let ([x, y], (sin, cos)) = (at[place], angle.sin_cos());
                at[place] = [x * cos + y * sin, y * cos - x * sin];
            }
            Self::Swap { plane, places: [one, other] } => {
                let plane = usize::from(plane == Plane::Y);
                (at[one][plane], at[other][plane]) = (at[other][plane], at[one][plane]);
            }
            Self::Kick { .. } | Self::Even { .. } => {}
        }
    }
}
