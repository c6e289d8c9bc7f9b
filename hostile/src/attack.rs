//! One input of one target.

use core::panic::AssertUnwindSafe;
use core::time::Duration;
use std::panic::catch_unwind;
use std::time::Instant;

use crate::{ALLOCATOR, Target};

/// Most bytes that an input may have in use at once [B].
pub const MEMORY: usize = 300 << 20;

/// What was wrong.
#[derive(Debug)]
pub enum Fault {
    /// It panicked.
    Panic,
    /// It had more bytes in use than [`MEMORY`].
    Memory(usize),
}

/// Have a target read an input, or refuse it; how long that took, or what was wrong.
///
/// # Errors
/// [`Fault`].
pub fn attack(target: &Target, input: &[u8]) -> Result<Duration, Fault> {
    let (began, before) = (Instant::now(), ALLOCATOR.current_usage());
    ALLOCATOR.reset_peak_usage();
    catch_unwind(AssertUnwindSafe(|| (target.read)(input))).map_err(|_| Fault::Panic)?;
    match ALLOCATOR.peak_usage().saturating_sub(before) {
        used if used > MEMORY => Err(Fault::Memory(used)),
        _ => Ok(began.elapsed()),
    }
}
