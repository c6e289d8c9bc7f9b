//! What a ring was made of, so that it can be made again elsewhere.

use std::path::Path;
use std::sync::Arc;

use lattices::import::{Instruments, Lattice, Pattern, bare};
use measured::lattice::machine;
use measured::{Folder, MeasuredError};
use pyo3::prelude::*;

use crate::error::input;

/// The text of a file.
#[derive(Debug, Clone)]
pub enum Source {
    /// A machine file.
    Machine {
        /// What it says.
        text: String,
        /// Its name, for errors.
        file: String,
    },
    /// A lattice of another code.
    Lattice(Imported),
}

/// A lattice of another code, and which of its elements are monitors and correctors.
#[derive(Debug, Clone)]
pub struct Imported {
    /// What the file says.
    pub text: String,
    /// Its name, for errors.
    pub file: String,
    /// Patterns of names, as of `--monitors`; none where the types of the elements tell.
    pub monitors: Vec<String>,
    /// The same of `--correctors`.
    pub correctors: Vec<String>,
    /// The lattice and its instruments.
    pub of: Arc<(Lattice, Instruments)>,
}

impl Imported {
    /// Read a lattice.
    ///
    /// # Errors
    /// `InputError`.
    pub fn parse(text: String, file: String, monitors: Vec<String>, correctors: Vec<String>) -> PyResult<Self> {
        let lattice = Lattice::parse(&file, &text).map_err(input)?;
        lattice.expect_ring().map_err(input)?;
        let instruments =
            Instruments::choose(&lattice, &patterns(&monitors)?, &patterns(&correctors)?).map_err(input)?;
        Ok(Self { text, file, monitors, correctors, of: Arc::new((lattice, instruments)) })
    }

    /// The ring as a measurement of which nothing is measured.
    fn folder(&self) -> Result<Folder, MeasuredError> {
        let (lattice, instruments) = &*self.of;
        bare(lattice, instruments)
    }
}

impl Source {
    /// The ring.
    ///
    /// # Errors
    /// `InputError`.
    pub fn ring(&self) -> PyResult<twin::Ring> {
        match self {
            Self::Machine { text, file } => twin::Ring::parse(text, file).map_err(input),
            Self::Lattice(imported) => {
                let name = Path::new(&imported.file).file_name().unwrap_or_default().to_string_lossy().into_owned();
                let folder = Folder { name, ..imported.folder().map_err(input)? };
                twin::Ring::parse(&machine(&folder, &[], &[]).to_string(), &folder.name).map_err(input)
            }
        }
    }
}

fn patterns(texts: &[String]) -> PyResult<Vec<Pattern>> {
    texts.iter().map(|text| text.parse().map_err(|error| input(format!("{text}: {error}")))).collect()
}
