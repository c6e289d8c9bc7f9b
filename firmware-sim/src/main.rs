//! The image of a device: the loop of `run`, wired to the board. On the host the same loop stands between standard input
//! and output.
#![cfg_attr(target_os = "none", no_std, no_main)]

#[cfg(target_os = "none")]
mod board;
#[cfg(target_os = "none")]
mod chip;
#[cfg(not(target_os = "none"))]
mod host;

#[cfg(not(target_os = "none"))]
fn main() -> std::io::Result<()> {
    host::run()
}
