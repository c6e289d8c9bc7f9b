//! The host's side of orbitcal. Estimates come from a [`source`] (the core fed by a recording, a device), pass the loop
//! [`serve`], and go to every [`sink`] (shared memory, trace); a [`result`] is what a command prints. `main.rs` joins these parts.

pub mod checkpoint;
pub mod cli;
pub mod command;
pub mod config;
pub mod daemon;
pub mod health;
pub mod history;
pub mod logs;
pub mod next_plan;
pub mod serve;
pub mod sink;
pub mod source;
pub mod stop;
pub mod watch;
pub mod web;

/// The worked examples of `docs/extending.md`, compiled and run as a test.
#[cfg(doctest)]
#[doc = include_str!("../../docs/extending.md")]
mod extending {}
