//! What can be wrong with a measurement.

use twin::{LatticeError, OrbitError};

/// Why a measurement cannot be read or fitted.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MeasuredError {
    /// A file could not be read.
    #[error("{file}: {source}")]
    Read {
        /// Which one.
        file: String,
        /// Why.
        source: std::io::Error,
    },
    /// A table is not what is expected.
    #[error("{file}: {problem}")]
    Table {
        /// Which one.
        file: String,
        /// What was expected, what was found, and where.
        problem: String,
    },
    /// A convention of an imported matrix is not stated, or makes no sense.
    #[error("{0}")]
    Convention(String),
    /// The lattice makes no ring.
    #[error(transparent)]
    Lattice(#[from] LatticeError),
    /// The ring of the start values has no closed orbit.
    #[error(transparent)]
    Orbit(#[from] OrbitError),
    /// Two measurements are not of the same machine, or not of the same instruments.
    #[error("{0}")]
    Unlike(String),
    /// No element of the matrix counts.
    #[error(
        "{name}: no element of the matrix counts: of {monitors} monitors {reading} are in use, of {correctors} correctors {kicking}"
    )]
    Empty {
        /// Measurement.
        name: String,
        /// Rows.
        monitors: usize,
        /// Of these in use.
        reading: usize,
        /// Columns.
        correctors: usize,
        /// Of these in use.
        kicking: usize,
    },
    /// Nothing of the machine can be fitted.
    #[error("{0}: nothing to fit: lattice.csv has neither a quadrupole nor a dipole with a gradient (k1_start_1_m2)")]
    NoGradient(String),
    /// The normal equations are singular, though every unknown has a prior: a number is not finite.
    #[error("the normal equations are singular after {0} steps")]
    Singular(usize),
}
