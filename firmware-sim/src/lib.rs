//! The loop around the core: bytes in, replies out, on the host and on a Cortex-M. Start reading at [`run`]; the messages
//! are in `docs/device.md`.
#![no_std]

#[cfg(test)]
extern crate std;

mod device;
mod inbox;
mod panel;
mod run;

pub use device::{Device, Reply, Request};
pub use inbox::{Event, Inbox};
pub use panel::Panel;
pub use run::run;
