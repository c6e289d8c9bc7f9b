//! What the daemon shows of itself on this machine: a live page, the same numbers as JSON, and metrics for Prometheus.
//!
//! The loop leaves its numbers on a [`Board`] and goes on; a server of its own threads reads them there. Nothing can be changed through it, and it listens on a loopback
//! address only. The page fetches nothing from elsewhere.

mod board;
mod connection;
mod metrics;
mod place;
mod server;
mod state;
mod trail;

pub use board::Board;
pub use place::Place;
pub use server::start;
