//! Lattices of other codes and plain tables of a response matrix, or a LOCO file, made into the folder that [`measured::Folder`] reads;
//! docs/your-own-ring.md.
//!
//! A lattice is read by the format that its content shows ([`Lattice::read`]), its monitors and correctors are chosen ([`Instruments::choose`]), the
//! matrix is read by their names or in a stated order ([`Table`]) and brought to millimetres and to kicks above 0 outwards and upwards
//! ([`Conventions`]). Nothing that a file does not say is guessed.

mod agreement;
mod assemble;
mod at;
mod at_mat;
mod conventions;
mod element;
mod fields;
mod hdf5;
mod input;
mod instruments;
mod loco;
mod madx;
mod mat;
mod mml;
mod pals;
mod pattern;
mod pyaml;
mod read;
mod sdds;
mod source;
mod stated;
mod table;
mod write;
mod xsuite;

pub use agreement::{Agreement, agreement};
pub use assemble::{Measurement, assemble, bare};
pub use conventions::{Conventions, Missing, PerInstrument, Signs};
pub use element::{Element, Format, Lattice, Role};
pub use input::Input;
pub use instruments::{Instrument, Instruments, Order, table_names};
pub use loco::{Lacking, Loco};
pub use pattern::Pattern;
pub use stated::{KickIs, OrbitUnit, Stated};
pub use table::Table;
pub use write::write;
