//! The proof of the diagnosis: blind campaigns whose truth is known, among them some that no effect of the library describes.

pub mod unknown;

pub use unknown::{Unknown, UnknownKind};
