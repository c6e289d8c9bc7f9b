//! Exact closed orbits of single machine cycles, nothing linearised: what simulated campaigns are made of.
//!
//! The ring is as misaligned as its elements say. Kicks, supplies, drift and what the machine holds constant enter the exact
//! maps, and what the monitors make of the orbit comes last. An RF offset is relative to the frequency at which this ring
//! closes without kicks.

use super::machine::{Instrument, Machine};
use crate::lattice::{Kind, Plane, Ring};
use crate::orbit::{Hold, OrbitError};
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
            let dispersion = |place: usize| optics.dispersion(&optics.observe(machine.ring.monitors[place], Plane::X));
            [mean(&machine.ring, pair, &optics), 0.5 * (dispersion(pair[0]) + dispersion(pair[1]))]
        });
        let (frequency, gradients) = (optics.frequency_offset(), machine.ring.gradients());
        Ok(Self { gradients, nominal_kick, frequency, radial, machine })
    }

    /// What the read monitors make of the orbit of one cycle [m], offsets and noise left out, and the tunes.
    ///
    /// # Errors
    /// [`OrbitError`] if the ring keeps no beam in this cycle.
    pub fn cycle(&self, cycle: &Cycle) -> Result<(Vec<f64>, Tunes), OrbitError> {
        let ring = self.driven(cycle);
        let delta = self.momentum(&ring, cycle)?;
        let optics = Optics::of(&ring, Hold::Momentum { delta })?;
        let mut at: Vec<[f64; 2]> = ring.monitors.iter().map(|&i| [optics.orbit(i)[0], optics.orbit(i)[2]]).collect();
        self.machine.instruments.iter().for_each(|instrument| instrument.read_orbit(&mut at));
        let read = |(plane, place): (Plane, usize)| at[place][usize::from(plane == Plane::Y)];
        Ok((ring.read_places().into_iter().map(read).collect(), optics.tunes()?))
    }

    /// The ring with the kicks and gradients of a cycle.
    fn driven(&self, cycle: &Cycle) -> Ring {
        let mut ring = self.machine.ring.clone();
        let drift = 1.0 + self.machine.drift * cycle.time;
        for ((&at, k1), strength) in self.machine.ring.quadrupoles.iter().zip(&self.gradients).zip(&cycle.strength) {
            ring.elements[at].kind = Kind::Quadrupole { k1: k1 * strength.exp() * drift };
        }
        for (c, (&at, &believed)) in self.machine.ring.correctors.iter().zip(&cycle.kick).enumerate() {
            let given = self.machine.instruments.iter().fold(believed, |kick, instrument| match *instrument {
                Instrument::Kick { corrector, factor } if corrector == c => kick * factor,
                Instrument::Even { corrector, share } if corrector == c => kick + share * kick * kick / self.nominal_kick,
                _ => kick,
            });
            if let Kind::Corrector { plane, kick } = &mut ring.elements[at].kind {
                *kick = if *plane == Plane::X { [given, 0.0] } else { [0.0, given] };
            }
        }
        ring
    }

    /// Momentum at which the beam runs in a cycle.
    fn momentum(&self, ring: &Ring, cycle: &Cycle) -> Result<f64, OrbitError> {
        let held = self.machine.delta;
        let at = |offset: f64| -> Result<f64, OrbitError> {
            let optics = Optics::of(ring, Hold::Frequency { offset: self.frequency + offset })?;
            Ok(optics.orbit(0)[crate::map::DELTA])
        };
        if cycle.rf_offset != 0.0 {
            return at(cycle.rf_offset);
        }
        if self.machine.frequency_share != 0.0 {
            return Ok(held + self.machine.frequency_share * (at(0.0)? - held));
        }
        if let Some((pair, share)) = self.machine.radial_loop {
            let optics = Optics::of(ring, Hold::Momentum { delta: held })?;
            return Ok(held - share * (mean(ring, pair, &optics) - self.radial[0]) / self.radial[1]);
        }
        Ok(held)
    }
}

/// Mean horizontal orbit of two monitors.
fn mean(ring: &Ring, pair: [usize; 2], optics: &Optics) -> f64 {
    0.5 * pair.map(|place| optics.orbit(ring.monitors[place])[0]).iter().sum::<f64>()
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
