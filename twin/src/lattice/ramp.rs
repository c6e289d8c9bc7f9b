//! The ramp: energy and nominal currents of a machine at a few times in its cycle.

use std::collections::BTreeMap;

use serde::Deserialize;

use super::{LatticeError, Particle, Ring};

/// The machine at one time in its cycle.
#[derive(Debug, Clone, PartialEq)]
pub struct RampPoint {
    /// Time in the cycle [s].
    pub time: f64,
    /// Kinetic energy of the particle on the reference orbit [GeV].
    pub kinetic_energy: f64,
    /// Current of the dipoles that goes with it [A]; none where it is not recorded.
    pub dipole: Option<f64>,
    /// Current of each supply, by its name, at which its quadrupoles have their design strengths at that energy [A].
    pub supply: BTreeMap<String, f64>,
}

/// A point as the file has it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Listed {
    t_cycle_ms: f64,
    #[serde(rename = "kinetic_energy_GeV")]
    kinetic_energy: f64,
    #[serde(rename = "dipole_A")]
    dipole: Option<f64>,
    #[serde(rename = "supply_A")]
    supply: BTreeMap<String, f64>,
}

/// Fewest and most times in a ramp: a line needs two, and a core has room for eight.
const POINTS: core::ops::RangeInclusive<usize> = 2..=8;

/// Times in the cycle that there may be [ms].
const LONGEST_CYCLE: core::ops::RangeInclusive<f64> = 0.0..=1e6;

impl Ring {
    /// Give the ring the ramp of its file.
    pub(super) fn set_ramp(&mut self, listed: Vec<Listed>) -> Result<(), LatticeError> {
        if !listed.is_empty() && !POINTS.contains(&listed.len()) {
            return refused("ramp", "2 to 8 times in the cycle", listed.len());
        }
        for point in listed {
            let point = point.checked(self)?;
            if let Some(before) = self.ramp.last().filter(|before| milliseconds(before) >= milliseconds(&point)) {
                let found = format!("{} after {}", milliseconds(&point), milliseconds(before));
                return refused("ramp", "times that rise", found);
            }
            let states_dipole = |point: &RampPoint| point.dipole.is_some();
            if self.ramp.first().is_some_and(|first| states_dipole(first) != states_dipole(&point)) {
                let which = if states_dipole(&point) { "one" } else { "none" };
                return refused(&point.place(), "a dipole_A at all times or at none", which);
            }
            self.ramp.push(point);
        }
        Ok(())
    }
}

impl Listed {
    fn checked(self, ring: &Ring) -> Result<RampPoint, LatticeError> {
        let point = RampPoint {
            time: self.t_cycle_ms / 1e3,
            kinetic_energy: self.kinetic_energy,
            dipole: self.dipole,
            supply: self.supply,
        };
        let place = point.place();
        let is_positive = |v: f64| v.is_finite() && v > 0.0;
        if !LONGEST_CYCLE.contains(&self.t_cycle_ms) {
            return refused("ramp", "a t_cycle_ms from 0 to 1000000", self.t_cycle_ms);
        }
        if !is_positive(point.kinetic_energy) {
            return refused(&place, "a kinetic_energy_GeV above 0", point.kinetic_energy);
        }
        if let Some(current) = point.dipole.filter(|current| !is_positive(*current)) {
            return refused(&place, "a dipole_A above 0", current);
        }
        if let Some((name, current)) = point.supply.iter().find(|(_, current)| !is_positive(**current)) {
            return refused(&place, "every supply_A above 0", format!("{current} of {name}"));
        }
        let is_known = |name: &String| ring.supplies.iter().any(|supply| supply.name == *name);
        if let Some(name) = point.supply.keys().find(|name| !is_known(name)) {
            return refused(&place, "the machine's supplies in supply_A", name);
        }
        match ring.supplies.iter().find(|supply| !point.supply.contains_key(&supply.name)) {
            Some(missing) => refused(&place, "every supply of the machine in supply_A", format!("no {}", missing.name)),
            None => Ok(point),
        }
    }
}

impl RampPoint {
    /// Momentum over that of a particle at its reference energy [1].
    pub fn momentum(&self, reference: &Particle) -> f64 {
        Particle { kinetic_energy: self.kinetic_energy, ..*reference }.momentum() / reference.momentum()
    }

    /// In words.
    pub fn place(&self) -> String {
        format!("ramp at {} ms", milliseconds(self))
    }
}

/// Time in the cycle [ms], to the microsecond.
fn milliseconds(point: &RampPoint) -> f64 {
    (point.time * 1e6).round() / 1e3
}

fn refused<T>(name: &str, field: &'static str, found: impl ToString) -> Result<T, LatticeError> {
    Err(LatticeError::Field { name: name.into(), field, found: found.to_string() })
}
