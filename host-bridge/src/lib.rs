//! The daemon of orbitcal, and what else follows a machine. Estimates come from a [`source`] (the core fed by a recording, a device), pass
//! the loop [`serve`], and go to every [`sink`] (shared memory, trace). A [`service`] is all of it as a configuration says, for months:
//! with checkpoints, a [`history`], the health of instruments, an orbit feedback and a page.
//!
//! ```
//! use host_bridge::config::Config;
//!
//! let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../config/booster.toml");
//! let config = Config::read(file.as_ref())?;
//! assert_eq!(config.publish.service, "orbitcal/estimate");
//! # Ok::<(), host_bridge::config::ConfigError>(())
//! ```

mod checkpoint;
pub mod config;
mod daemon;
mod health;
pub mod history;
pub mod logs;
pub mod serve;
pub mod service;
pub mod sink;
pub mod source;
pub mod stop;
mod web;

pub use checkpoint::{Checkpoint, CheckpointError, Head, Model, write as write_checkpoint};
pub use health::Health;

/// The worked examples of `docs/extending.md`, compiled and run as a test.
#[cfg(doctest)]
#[doc = include_str!("../../docs/extending.md")]
mod extending {}
