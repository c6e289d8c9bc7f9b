//! Spurious dispersion: what misaligned quadrupoles add to the dispersion of a ring.

use crate::lattice::{Plane, Ring};
use crate::map::{DELTA, X, Y};
use crate::orbit::{ClosedOrbit, Hold, OrbitError};
use crate::response::Optics;

/// Misaligned machines from which it is taken, and the rms shift of their quadrupoles [m]; the ratio to the orbit does not
/// depend on the shift.
const MACHINES: u32 = 40;
const SHIFT: f64 = 0.2e-3;
/// RF offset on either side.
const RF_STEP: f64 = 2e-4;
/// Dimensions of one Sobol sequence.
const DIMENSIONS: u32 = 256;

/// Rms change of a misaligned ring's orbit per unit of RF offset and of rms orbit, beyond the design dispersion, in x and y.
///
/// The orbit that shifted quadrupoles make changes with the momentum, as every orbit does; which way, only the unknown
/// shifts could tell. An offset and its opposite share the change with opposite signs; whoever takes them for independent
/// needs twice the variance for each, which is what this gives.
///
/// # Errors
/// [`OrbitError`] if the ring has no closed orbit.
pub fn spurious_dispersion(ring: &Ring) -> Result<[f64; 2], OrbitError> {
    let optics = Optics::of(ring, Hold::Momentum { delta: 0.0 })?;
    let places: Vec<(usize, f64)> = (ring.monitors_read())
        .map(|monitor| (monitor.element, optics.dispersion(&optics.observe(monitor.element, Plane::X))))
        .collect();
    let (mut change, mut orbit) = ([0.0; 2], [0.0; 2]);
    for machine in 0..MACHINES {
        let shifted = misaligned(ring, machine);
        let at = |offset| ClosedOrbit::find(&shifted, Hold::Frequency { offset });
        let (up, down, rest) = (at(RF_STEP)?, at(-RF_STEP)?, at(0.0)?);
        for &(place, dispersion) in &places {
            let slope = |i: usize| (up.at[place][i] - down.at[place][i]) / (2.0 * RF_STEP);
            for (plane, coordinate, design) in [(0, X, dispersion), (1, Y, 0.0)] {
                change[plane] += (slope(coordinate) - design * slope(DELTA)).powi(2);
                orbit[plane] += rest.at[place][coordinate].powi(2);
            }
        }
    }
    Ok([0, 1].map(|plane| if orbit[plane] > 0.0 { (2.0 * change[plane] / orbit[plane]).sqrt() } else { 0.0 }))
}

/// The ring with its quadrupoles shifted at random, uniformly, seeded.
fn misaligned(ring: &Ring, machine: u32) -> Ring {
    let mut ring = ring.clone();
    let uniform = |n: u32| f64::from(sobol_burley::sample(machine, n % DIMENSIONS, 1 + n / DIMENSIONS)) - 0.5;
    let elements: Vec<usize> = ring.quadrupoles.iter().map(|quadrupole| quadrupole.element).collect();
    for (q, element) in (0..).zip(elements) {
        let shift = &mut ring.elements[element].misalignment;
        (shift.dx, shift.dy) = (uniform(2 * q) * SHIFT * 12f64.sqrt(), uniform(2 * q + 1) * SHIFT * 12f64.sqrt());
    }
    ring
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Any number of quadrupoles: more than half the dimensions of a Sobol sequence.
    #[test]
    fn it_does_not_depend_on_the_size_of_the_shifts_or_of_the_ring() {
        let [x, y] = spurious_dispersion(&Ring::booster()).unwrap();
        assert!((x - 373.0).abs() < 4.0 && (y - 184.0).abs() < 2.0, "{x} {y}"); // as measured, to 1 %
        let mut ring = Ring::booster();
        let twice = ring.quadrupoles.clone();
        (0..2).for_each(|_| ring.quadrupoles.extend(twice.iter().copied()));
        assert!(spurious_dispersion(&ring).is_ok());
    }
}
