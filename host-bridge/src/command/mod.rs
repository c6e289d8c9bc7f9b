//! The commands, one file each.

pub mod challenge;
pub mod diagnose;
pub mod fit;
pub mod prove;
pub mod replay;
pub mod response;
pub mod serve;
pub mod study;
pub mod surrogate;
pub mod watch;

use std::borrow::Cow;
use std::path::Path;

use indicatif::{ProgressBar, ProgressStyle};
use inference::readings::ReadingsError;
use inference::{BatchError, Recording, RecordingError, stream};
use training::BoosterGreen;
use twin::{LatticeError, Ring};

use crate::model_file::{self, ModelFileError};
use crate::output::OutputError;

/// Why a command ended: bad arguments or input (exit 2), or anything else (exit 1), in one line.
#[derive(Debug)]
pub enum CommandError {
    /// Arguments or input.
    Input(String),
    /// Anything else.
    Other(String),
}

impl From<LatticeError> for CommandError {
    fn from(error: LatticeError) -> Self {
        Self::Input(error.to_string())
    }
}

impl From<RecordingError> for CommandError {
    fn from(error: RecordingError) -> Self {
        Self::Input(error.to_string())
    }
}

impl From<stream::StreamError> for CommandError {
    fn from(error: stream::StreamError) -> Self {
        Self::Input(error.to_string())
    }
}

impl From<ModelFileError> for CommandError {
    fn from(error: ModelFileError) -> Self {
        Self::Input(error.to_string())
    }
}

impl From<OutputError> for CommandError {
    fn from(error: OutputError) -> Self {
        Self::Other(error.to_string())
    }
}

impl From<BatchError> for CommandError {
    fn from(error: BatchError) -> Self {
        match error {
            BatchError::Stream(error) => error.into(),
            error => Self::Other(error.to_string()),
        }
    }
}

impl From<ReadingsError> for CommandError {
    fn from(error: ReadingsError) -> Self {
        match error {
            ReadingsError::Fit(error) => error.into(),
            error => Self::Other(error.to_string()),
        }
    }
}

/// The machine that was asked for, or the built-in one.
fn machine(path: Option<&Path>) -> Result<Ring, LatticeError> {
    path.map_or_else(|| Ok(Ring::booster()), Ring::read)
}

/// The core's tables: those of a model file, or of the ring as designed.
fn tables(ring: &Ring, file: Option<&Path>) -> Result<Box<BoosterGreen>, CommandError> {
    match file {
        Some(path) => Ok(model_file::read(path)?),
        None => Ok(Box::new(training::green::tables(ring).map_err(stream::StreamError::from)?)),
    }
}

fn recording(path: &Path, ring: &Ring) -> Result<Recording, RecordingError> {
    Recording::read(path, &stream::layout(ring))
}

/// A progress bar; hidden in a pipe by indicatif itself, and when nothing but errors is wanted.
pub fn progress(length: usize, what: impl Into<Cow<'static, str>>, quiet: bool) -> ProgressBar {
    if quiet {
        return ProgressBar::hidden();
    }
    let style =
        ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} {eta}").expect("the template is tested by use");
    ProgressBar::new(length as u64).with_style(style).with_message(what)
}
