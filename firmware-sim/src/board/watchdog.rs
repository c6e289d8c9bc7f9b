//! The watchdog: a stalled main loop is reported, and then reset.
//!
//! A count that runs out once raises the non-maskable interrupt, in which [`super::fault`] reports; were that stuck too,
//! the second time resets the machine.

use cortex_m_rt::exception;
use embedded_hal::digital::{ErrorType, OutputPin};

use super::registers::{WATCHDOG_CONTROL, WATCHDOG_INTCLR, WATCHDOG_LOAD, WATCHDOG_LOCK};
use super::{SYSCLK_HZ, fault};

// WATCHDOG_CONTROL.
const INTERRUPT_ENABLE: u32 = 1 << 0;
const RESET_ENABLE: u32 = 1 << 1;

// WATCHDOG_LOCK: any other value forbids writes to the watchdog, so that a runaway program cannot stop it.
const UNLOCK: u32 = 0x1ACC_E551;
const LOCK: u32 = 0;

/// The running watchdog, and the pin that feeds an external one beside it. Neither can be stopped: an edge of the pin feeds
/// both.
pub struct Watchdog<P> {
    supervisor: P,
}

impl<P: OutputPin> Watchdog<P> {
    /// Start it; it must be fed more often than this [s].
    pub fn start(seconds: u32, supervisor: P) -> Self {
        WATCHDOG_LOCK.write(UNLOCK);
        WATCHDOG_LOAD.write(seconds * SYSCLK_HZ);
        WATCHDOG_CONTROL.write(INTERRUPT_ENABLE | RESET_ENABLE);
        WATCHDOG_LOCK.write(LOCK);
        Self { supervisor }
    }

    /// Restart the count.
    fn feed(&mut self) {
        WATCHDOG_LOCK.write(UNLOCK);
        WATCHDOG_INTCLR.write(1);
        WATCHDOG_LOCK.write(LOCK);
    }
}

impl<P: OutputPin> ErrorType for Watchdog<P> {
    type Error = P::Error;
}

impl<P: OutputPin> OutputPin for Watchdog<P> {
    fn set_low(&mut self) -> Result<(), P::Error> {
        self.feed();
        self.supervisor.set_low()
    }

    fn set_high(&mut self) -> Result<(), P::Error> {
        self.feed();
        self.supervisor.set_high()
    }
}

#[exception]
#[allow(unsafe_code)] // the attribute asks for `unsafe fn`: this interrupt cannot be masked, no critical section holds it off
unsafe fn NonMaskableInt() {
    fault::fail(|| defmt::error!("watchdog: the main loop has stalled"));
}
