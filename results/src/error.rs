//! Why there is no result.

use core::fmt::Display;

use diagnosis::DataError;
use inference::{BatchError, RecordingError, stream};
use measured::MeasuredError;
use twin::LatticeError;

use crate::model_file::ModelFileError;
use crate::output::OutputError;

/// Why a command ended: bad arguments or input (exit 2), or anything else (exit 1), in one line.
#[derive(Debug)]
pub enum CommandError {
    /// Arguments or input.
    Input(String),
    /// Anything else.
    Other(String),
}

impl CommandError {
    /// Nothing that the arguments or the input could help.
    pub fn other(error: impl Display) -> Self {
        Self::Other(error.to_string())
    }

    /// Somebody has asked for the end.
    pub fn interrupted() -> Self {
        Self::Other("interrupted; nothing was written".into())
    }
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
        Self::Other(error.to_string())
    }
}

impl core::error::Error for CommandError {}

impl core::fmt::Display for CommandError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let (Self::Input(message) | Self::Other(message)) = self;
        f.write_str(message)
    }
}

impl From<twin::OrbitError> for CommandError {
    fn from(error: twin::OrbitError) -> Self {
        Self::Other(format!("no stable ring: {error}"))
    }
}

impl From<MeasuredError> for CommandError {
    fn from(error: MeasuredError) -> Self {
        match error {
            MeasuredError::Orbit(_) | MeasuredError::Singular(_) => Self::Other(error.to_string()),
            _ => Self::Input(error.to_string()),
        }
    }
}

impl From<DataError> for CommandError {
    fn from(error: DataError) -> Self {
        match error {
            error @ (DataError::TooLittle { .. } | DataError::Miswired { .. } | DataError::Apart { .. }) => {
                Self::Input(error.to_string())
            }
            error => Self::Other(error.to_string()),
        }
    }
}
