//! The watchdog: a stalled main loop is reported, and then reset.
//!
//! A count that runs out once raises the non-maskable interrupt, in which [`super::fault`] reports; were that stuck too,
//! the second time resets the machine.

use cortex_m_rt::exception;
use embedded_hal::digital::OutputPin;
use firmware_sim::Supervisor;

use super::registers::{WATCHDOG_CONTROL, WATCHDOG_INTCLR, WATCHDOG_LOAD, WATCHDOG_LOCK};
use super::{SYSCLK_HZ, fault};

// WATCHDOG_CONTROL.
const INTERRUPT_ENABLE: u32 = 1 << 0;
const RESET_ENABLE: u32 = 1 << 1;

// WATCHDOG_LOCK: any other value forbids writes to the watchdog, so that a runaway program cannot stop it.
const UNLOCK: u32 = 0x1ACC_E551;
const LOCK: u32 = 0;

/// Start it; it must be fed more often than this [s, 171 at most], by an edge of the pin to an external one. Neither can be
/// stopped.
pub fn start<P: OutputPin>(seconds: u32, supervisor: P) -> Supervisor<P, fn()> {
    WATCHDOG_LOCK.write(UNLOCK);
    WATCHDOG_LOAD.write(seconds * SYSCLK_HZ);
    WATCHDOG_CONTROL.write(INTERRUPT_ENABLE | RESET_ENABLE);
    WATCHDOG_LOCK.write(LOCK);
    Supervisor::new(supervisor, feed)
}

/// Restart the count.
fn feed() {
    WATCHDOG_LOCK.write(UNLOCK);
    WATCHDOG_INTCLR.write(1);
    WATCHDOG_LOCK.write(LOCK);
}

#[exception]
#[allow(unsafe_code)] // the attribute asks for `unsafe fn`: this interrupt cannot be masked, no critical section holds it off
unsafe fn NonMaskableInt() {
    fault::fail(|| defmt::error!("watchdog: the main loop has stalled"));
}
