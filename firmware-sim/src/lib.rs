//! The loop around the core: bytes in, answers out, on the host and on a Cortex-M. Start reading at [`run`]; what travels
//! is in `docs/device.md`.
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
