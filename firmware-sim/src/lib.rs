//! The loop around the core: bytes in, replies out, on the host and on a Cortex-M. Start reading at [`run`]; the messages
//! are in `docs/device.md`.
#![no_std]

#[cfg(test)]
extern crate std;

mod bursts;
mod device;
mod inbox;
pub mod machine;
mod panel;
mod run;
mod supervisor;

pub use bursts::Bursts;
pub use device::{Device, Reply, Request};
pub use inbox::{Event, Inbox};
pub use panel::Panel;
pub use run::run;
pub use supervisor::Supervisor;
