//! The registers that the firmware touches, each with its address.
//!
//! Sources: Arm, Cortex-M System Design Kit Technical Reference Manual (DDI 0479), programmers models of the APB UART,
//! the APB watchdog and the AHB GPIO; Arm, Application Note AN500, memory map; Arm, ARMv7-M Architecture Reference
//! Manual (DDI 0403), B3.4.

use core::ptr;

/// A 32-bit register of a peripheral.
///
/// The address is private, so that those below are all there are: reading and writing them is then safe, since each is
/// mapped on this board and none reaches into the program's memory.
#[derive(Clone, Copy)]
pub struct Register(usize);

impl Register {
    #[allow(unsafe_code)] // the address is one of those below
    pub fn read(self) -> u32 {
        unsafe { ptr::with_exposed_provenance::<u32>(self.0).read_volatile() }
    }

    #[allow(unsafe_code)] // the address is one of those below
    pub fn write(self, value: u32) {
        unsafe { ptr::with_exposed_provenance_mut::<u32>(self.0).write_volatile(value) }
    }
}

pub const UART0_DATA: Register = Register(0x4000_4000);
pub const UART0_STATE: Register = Register(0x4000_4004);
pub const UART0_CTRL: Register = Register(0x4000_4008);
pub const UART0_INTCLEAR: Register = Register(0x4000_400C);
pub const UART0_BAUDDIV: Register = Register(0x4000_4010);

pub const WATCHDOG_LOAD: Register = Register(0x4000_8000);
pub const WATCHDOG_CONTROL: Register = Register(0x4000_8008);
pub const WATCHDOG_INTCLR: Register = Register(0x4000_800C);
pub const WATCHDOG_LOCK: Register = Register(0x4000_8C00);

pub const GPIO0_DATAOUT: Register = Register(0x4001_0004);
pub const GPIO0_OUTENSET: Register = Register(0x4001_0010);

/// User LEDs, bits 0 and 1.
pub const FPGAIO_LED: Register = Register(0x4002_8000);

/// Enables interrupts 0 to 31: a one bit enables, a zero bit leaves alone.
pub const NVIC_ISER0: Register = Register(0xE000_E100);
