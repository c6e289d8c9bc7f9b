//! The host's side of orbitcal: recordings in, shared memory, tables and files out. `main.rs` joins these parts.

pub mod answer;
pub mod cli;
pub mod command;
pub mod link;
pub mod model_file;
pub mod output;
pub mod publish;
pub mod record;
pub mod trace;
pub mod watch;
