//! The file that an import begins with: a lattice, or a LOCO file with everything.

use std::path::Path;

use super::element::Lattice;
use super::loco::{self, Lacking, Loco};
use super::mat::MatFile;
use super::source::{Source, bytes};
use measured::MeasuredError;

/// What was read.
#[derive(Debug, Clone)]
pub enum Input {
    /// A lattice alone.
    Lattice(Lattice),
    /// A whole measurement.
    Loco(Box<Loco>),
}

impl Input {
    /// Read a file of any format; `lacking` is what a LOCO file may not state.
    ///
    /// # Errors
    /// [`MeasuredError`]; [`Lattice::expect_ring`].
    pub fn read(path: &Path, lacking: &Lacking) -> Result<Self, MeasuredError> {
        let Source { path: file, name } = Source::of(path);
        let words = file.display().to_string();
        let bytes = bytes(&file)?;
        if name.is_none() && MatFile::is_one(&bytes) {
            let file = MatFile::of(&words, bytes)?;
            if loco::is_one(&file) {
                let loco = loco::read(&file, lacking)?;
                loco.lattice.expect_ring()?;
                return Ok(Self::Loco(Box::new(loco)));
            }
        }
        let lattice = Lattice::read(path)?;
        lattice.expect_ring()?;
        Ok(Self::Lattice(lattice))
    }
}
