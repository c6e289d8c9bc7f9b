//! A calibrated ring as a lattice file of another code.
//!
//! A result of `fit`, `replay` or `diagnose` and the machine become a [`Lattice`]; each format is one function that writes
//! it. What a format has no words for stands in its comments or metadata.

mod at;
mod attributes;
mod bmad;
mod calibration;
mod lattice;
mod madx;
mod names;
mod pals;
mod xsuite;

pub use calibration::{Calibration, CalibrationError};
pub use lattice::{Channel, ExportError, Lattice};

use crate::cli::Format;

/// The lattice as text of a format.
pub fn text(lattice: &Lattice, format: Format) -> String {
    match format {
        Format::Madx => madx::text(lattice),
        Format::Bmad => bmad::text(lattice),
        Format::At => json(&at::value(lattice)),
        Format::Xsuite => json(&xsuite::value(lattice)),
        Format::Pals => json(&pals::value(lattice)),
    }
}

fn json(value: &serde_json::Value) -> String {
    format!("{value:#}\n")
}
