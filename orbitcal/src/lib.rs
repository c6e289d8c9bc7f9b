//! The program `orbitcal`: its command line, its commands and what they draw on a terminal; all else is in the crates below.
//!
//! A command reads its input, calls what does the work, and hands the result to whoever asked: a person, a file, or both.
//!
//! ```
//! use clap::Parser;
//! use orbitcal::{Cli, run};
//!
//! let recording = concat!(env!("CARGO_MANIFEST_DIR"), "/../recordings/paper-vars");
//! let cli = Cli::try_parse_from(["orbitcal", "check", recording, "--quiet"])?;
//! run(&cli)?;
//! # Ok::<(), Box<dyn core::error::Error>>(())
//! ```

mod cli;
mod command;
mod next_plan;
mod watch;

pub use cli::{Cli, CoreModel};
pub use command::{progress, run, schemas};
