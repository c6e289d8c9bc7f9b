//! The emulated board: ARM MPS2 with the AN500 image, a Cortex-M7 at 25 MHz.
//!
//! All of the program's `unsafe` is here, and all that knows an address.

pub mod clock;
mod fault;
pub mod pins;
mod registers;
pub mod stack;
pub mod uart;
pub mod watchdog;

use cortex_m_rt::exception;
use defmt_semihosting as _; // the logger: frames go to the emulator's standard output

/// The clock of core and peripherals [Hz].
pub const SYSCLK_HZ: u32 = 25_000_000;

/// All device interrupts; without a device crate they come to one handler.
#[exception]
#[allow(unsafe_code)] // the attribute asks for `unsafe fn`: other handlers may be mapped here, too; none is
unsafe fn DefaultHandler(interrupt: i16) {
    match interrupt {
        uart::INTERRUPT => uart::receive(),
        other => panic!("interrupt {other} is not expected"),
    }
}
