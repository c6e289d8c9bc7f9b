//! What can go wrong between a source tree and a running image.

use std::io;
use std::path::PathBuf;
use std::process::Output;

/// Why the image could not be built, run or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A program is not installed.
    #[error("{0} is not installed; `make setup` installs it")]
    Missing(&'static str),
    /// A program failed; what it wrote to standard error follows.
    #[error("{program} failed; if it misses the target or a tool, `make setup` installs it\n{stderr}")]
    Failed {
        /// Its name.
        program: &'static str,
        /// Its standard error.
        stderr: String,
    },
    /// A file could not be read or written.
    #[error("{}: {source}", path.display())]
    File {
        /// Which one.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// The emulator could not be talked to.
    #[error("the emulator: {0}")]
    Emulator(#[from] io::Error),
    /// The emulator did not come to its end in time.
    #[error("the emulator still runs after {0} s")]
    Running(f32),
    /// The image is not what is expected: not an ELF file, or without what defmt needs.
    #[error("the image: {0}")]
    Image(String),
    /// No function, or several, by a name.
    #[error("need one function {name}, the image has {found:?}; one that is inlined everywhere has none")]
    Function {
        /// What was asked for.
        name: String,
        /// All that match.
        found: Vec<String>,
    },
    /// The report of the plugin has a line that cannot be read.
    #[error("the report of instruction counts: {0:?}")]
    Report(String),
    /// A region was entered without a call just before, by a tail call: its counts are incomplete.
    #[error("{region} was entered {entries} times without a call, so its counts are incomplete")]
    Entered {
        /// The region.
        region: String,
        /// How often.
        entries: u64,
    },
}

impl Error {
    /// Why a program did not start: most likely, it is not installed.
    pub(super) fn starting(program: &'static str) -> impl Fn(io::Error) -> Self {
        move |error| match error.kind() {
            io::ErrorKind::NotFound => Self::Missing(program),
            _ => Self::Emulator(error),
        }
    }

    /// What became of a program that ran to its end.
    pub(super) fn unless_successful(program: &'static str, output: &Output) -> Result<(), Self> {
        let failed = || Self::Failed { program, stderr: String::from_utf8_lossy(&output.stderr).into_owned() };
        output.status.success().then_some(()).ok_or_else(failed)
    }

    /// Why a file was of no use.
    pub(super) fn file(path: impl Into<PathBuf>) -> impl FnOnce(io::Error) -> Self {
        let path = path.into();
        move |source| Self::File { path, source }
    }
}
