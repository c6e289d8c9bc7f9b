//! Measured orbit response matrices of any ring: read, fitted, compared.
//!
//! A measurement is a folder of tables ([`Folder`]); [`lattice`] makes the ring of the twin from it, [`Model`] predicts its matrix, and
//! [`fit`] finds the magnets and the instruments that explain it, as LOCO does, with an error of the model whose size is learnt. [`Diagnosis`] adds what an
//! ordinary ring has besides, family by family, and names what stands out of its family.
//! [`compare`] says what changed from one measurement to the next, [`against`] what a measurement says against a model that is believed.
//!
//! Source: J. Safranek, Nucl. Instrum. Methods A 388 (1997) 27 (LOCO).

pub mod alignment;
mod arrow;
pub mod believed;
pub mod calibrated;
mod chance;
pub mod compare;
pub mod conceal;
pub mod data;
pub mod departure;
pub mod derivative;
pub mod descent;
pub mod diagnose;
pub mod error;
pub mod family;
pub mod fit;
pub mod folder;
pub mod held_out;
pub mod hierarchy;
pub mod hold;
pub mod lattice;
mod likeness;
pub mod linear;
pub mod missed;
pub mod model;
pub mod named;
pub mod noise;
pub mod normal;
pub mod optics;
pub mod raw;
mod released;
pub mod search;
pub mod straight;
#[cfg(test)]
mod testing;
pub mod uncertainty;
pub mod unknowns;
pub mod wiring;

pub use believed::{Against, Believed, against};
pub use calibrated::Calibrated;
pub use compare::{Before, Change, Changes, compare};
pub use conceal::{Concealed, conceal};
pub use diagnose::Diagnosis;
pub use error::MeasuredError;
pub use fit::{Fit, Settings, fit};
pub use folder::Folder;
pub use likeness::Likeness;
pub use model::{Model, Prediction};
pub use optics::{Fitted, FittedOptics, FittedRing};
pub use raw::RawOrbits;
pub use straight::{Straightened, expect_fit};
pub use unknowns::{Kind, Unknown};
pub use wiring::{Wiring, straightened};
