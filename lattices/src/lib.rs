//! Lattices and matrices of other codes, in and out: each file format of another code is one file here.
//!
//! [`import`] makes of a lattice, and of a response matrix if there is one, the folder that [`measured::Folder`] reads; [`export`] writes
//! a ring with the strengths and findings of a result as a lattice file.
//!
//! ```
//! use lattices::export::{self, Format};
//! use lattices::import::{Lattice, bare, Instruments};
//! use twin::Ring;
//!
//! // a lattice of pyAT, written as MAD-X takes it
//! let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../recordings/measured/imports/twelve-cells.at.json");
//! let lattice = Lattice::read(file.as_ref())?;
//! let instruments = Instruments::choose(&lattice, &["bpm*".parse()?], &["cor*".parse()?])?;
//! let ring: Ring = measured::lattice::ring(&bare(&lattice, &instruments)?, &[], &[])?;
//! let text = export::text(&export::Lattice::plain(&ring), Format::Madx);
//! assert!(text.contains("use, sequence = ring;"));
//! # Ok::<(), Box<dyn core::error::Error>>(())
//! ```

pub mod export;
pub mod import;
