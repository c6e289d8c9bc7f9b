//! What is wrong with a recording, and where: one line each.

use core::fmt;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use twin::limits::Exceeded;

/// Why a folder is not a recording of the machine; prints as one line.
#[non_exhaustive]
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RecordingError {
    /// There is no such file.
    #[error("{}: file not found", .0.display())]
    NotFound(PathBuf),
    /// The file is closed to us or not text.
    #[error("{}: {}", .0.display(), .1)]
    Unreadable(PathBuf, String),
    /// The header is not TOML, lacks a key, has one too many, or a value cannot be; with what TOML expected and found.
    #[error("{0}: {1}")]
    Header(Place, String),
    /// The header says that the recording is of another machine.
    #[error("{0}: the recording is of another machine")]
    Machine(Mismatch),
    /// A column is nowhere in the line.
    #[error("{0}, so a column is missing")]
    MissingColumn(Mismatch),
    /// A column stood further left already.
    #[error("{0}, which is there already")]
    DuplicateColumn(Mismatch),
    /// A column belongs to another place.
    #[error("{0}, which is in the wrong place")]
    MisplacedColumn(Mismatch),
    /// A column's quantity is right, its unit is not.
    #[error("{0}, which has the wrong unit")]
    ColumnUnit(Mismatch),
    /// The machine has no such column.
    #[error("{0}, which the machine does not have")]
    UnknownColumn(Mismatch),
    /// A line has too many or too few cells.
    #[error("{0}")]
    CellCount(Mismatch),
    /// A cell is empty, not a number, out of range, or names what the machine does not have.
    #[error("{0}")]
    Cell(Mismatch),
    /// Sequence or time does not rise from one row to the next.
    #[error("{0}")]
    Order(Mismatch),
    /// There is nothing below the line of columns.
    #[error("{0}")]
    NoFrames(Mismatch),
    /// It holds more than fits.
    #[error("{0}: {1}")]
    TooLarge(Place, Exceeded),
    /// A file cannot be written.
    #[error("{}: cannot be written: {}", .0.display(), .1)]
    Unwritable(PathBuf, ErrorKind),
}

impl RecordingError {
    pub(super) fn reading(file: &Path, error: &std::io::Error) -> Self {
        match error.kind() {
            ErrorKind::NotFound => Self::NotFound(file.into()),
            _ => Self::Unreadable(file.into(), twin::unreadable(error)),
        }
    }
}

/// What should stand at a place, and what does.
#[derive(Debug, Clone, PartialEq)]
pub struct Mismatch {
    /// The place.
    pub at: Place,
    /// What may stand there.
    pub expected: String,
    /// What does; text of the file is quoted, so that it stays on one line.
    pub found: String,
}

/// Where in a recording something is wrong.
#[derive(Debug, Clone, PartialEq)]
pub struct Place {
    /// Path of the file.
    pub file: PathBuf,
    /// Line in the file, from 1.
    pub line: usize,
    /// Part of that line.
    pub part: Part,
}

/// A part of a line.
#[derive(Debug, Clone, PartialEq)]
pub enum Part {
    /// All of it.
    Whole,
    /// A header key.
    Key(String),
    /// A column, by name; by number where the names disagree.
    Column(String),
}

impl Place {
    pub(crate) fn new(file: &Path, line: usize, part: Part) -> Self {
        Self { file: file.into(), line, part }
    }

    /// Every disagreement between a file and the format is put into words here.
    pub(crate) fn mismatch(self, expected: impl fmt::Display, found: impl fmt::Display) -> Mismatch {
        Mismatch { at: self, expected: expected.to_string(), found: found.to_string() }
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}, line {}", self.file.display(), self.line)?;
        match &self.part {
            Part::Whole => Ok(()),
            Part::Key(key) => write!(f, ", key {key}"),
            Part::Column(column) => write!(f, ", column {column}"),
        }
    }
}

impl fmt::Display for Mismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: expected {}, found {}", self.at, self.expected, self.found)
    }
}
