//! Surrogate tables made from the twin, and their measured errors.

pub mod check;
pub mod extended;
pub mod green;
mod instruments;
pub mod network;
mod response;
pub mod rooms;
mod source;
mod tables;
#[cfg(test)]
mod testing;

pub use check::{SurrogateError, check, check_networks};
pub use extended::Extended;
pub use green::TrainingError;
pub use rooms::with_stack;
pub use tables::{AnyParcel, LINE, Tables};
