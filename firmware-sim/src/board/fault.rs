//! The ends of the program: a panic, a hardware fault and a watchdog that was not fed are reported once, then it stops.

use core::panic::PanicInfo;
use core::sync::atomic::{AtomicBool, Ordering};

use cortex_m::peripheral::SCB;
use cortex_m_rt::{ExceptionFrame, exception};
use cortex_m_semihosting::debug;

static FAILED: AtomicBool = AtomicBool::new(false);

/// Report and stop.
///
/// A failure within the report, such as one that hit the logger at work, stops without another.
pub fn fail(report: impl FnOnce()) -> ! {
    if !FAILED.swap(true, Ordering::Relaxed) {
        report();
    }
    stop()
}

/// Leave the emulator with status 1. On a part without a debugger this is the place for `SCB::sys_reset`.
fn stop() -> ! {
    loop {
        debug::exit(debug::EXIT_FAILURE);
    }
}

#[panic_handler]
fn panic(info: &PanicInfo) -> ! {
    fail(|| defmt::error!("{}", defmt::Display2Format(info)))
}

#[exception]
#[allow(unsafe_code)] // the attribute asks for `unsafe fn`: a fault interrupts even a critical section
unsafe fn HardFault(frame: &ExceptionFrame) -> ! {
    let status = configurable_fault_status();
    fail(|| defmt::error!("hard fault: pc {=u32:#x} lr {=u32:#x} cfsr {=u32:#x}", frame.pc(), frame.lr(), status))
}

/// Which rule was broken (ARMv7-M Architecture Reference Manual, B3.2.15).
#[allow(unsafe_code)] // reading this register has no side effect
fn configurable_fault_status() -> u32 {
    unsafe { (*SCB::PTR).cfsr.read() }
}
