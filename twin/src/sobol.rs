//! Sobol points of as many dimensions as a ring has numbers.

use sobol_burley::{NUM_DIMENSIONS, sample};

/// A coordinate in 0..1 of a scrambled Sobol point; beyond the dimensions of one sequence that of the next seed goes on.
///
/// Source: B. Burley, Practical Hash-based Owen Scrambling, JCGT 9 (2020).
pub fn sobol(point: u32, dimension: usize, seed: u32) -> f64 {
    let dimension = dimension as u32;
    f64::from(sample(point, dimension % NUM_DIMENSIONS, seed.wrapping_add(dimension / NUM_DIMENSIONS)))
}
