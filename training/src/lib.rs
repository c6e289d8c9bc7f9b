//! Surrogate tables made from the twin, and their measured errors.

pub mod check;
pub mod extended;
pub mod green;

pub use check::{SurrogateError, check};
pub use extended::Extended;
pub use green::{BoosterGreen, TrainingError};
