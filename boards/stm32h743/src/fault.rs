//! A panic or a fault of the processor is logged, and the part starts anew: its host meets a device that waits for its setup.

use core::panic::PanicInfo;

use cortex_m::peripheral::SCB;
use cortex_m_rt::{ExceptionFrame, exception};

#[panic_handler]
fn panic(info: &PanicInfo) -> ! {
    defmt::error!("{}", defmt::Display2Format(info));
    SCB::sys_reset()
}

#[exception]
#[allow(unsafe_code)] // the attribute asks for `unsafe fn`: a fault interrupts even a critical section
unsafe fn HardFault(frame: &ExceptionFrame) -> ! {
    defmt::error!("hard fault: pc {=u32:#x} lr {=u32:#x}", frame.pc(), frame.lr());
    SCB::sys_reset()
}
