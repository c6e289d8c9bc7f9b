//! Caches on, and the memory that the DMA writes kept out of them.
//!
//! Source: Arm, ARMv7-M Architecture Reference Manual (DDI 0403), B3.5; ST, AN4839, Level 1 cache on STM32F7 and STM32H7 Series.

use core::mem::MaybeUninit;

use cortex_m::Peripherals;
use cortex_m::asm::{dsb, isb};

/// Room for received bytes [B]: what comes in 44 ms at 921,600 baud, while the loop computes or sends.
const RING: usize = 4096;

// Attributes of a region: no code, any access, normal memory that is not cached, shared, 2^13 bytes, in use.
const NO_CODE: u32 = 1 << 28;
const FULL_ACCESS: u32 = 0b011 << 24;
const NOT_CACHED: u32 = 0b001 << 19;
const SHARED: u32 = 1 << 18;
const SIZE_8_KB: u32 = 12 << 1;
const ENABLE: u32 = 1 << 0;

/// Everything outside the regions is as if there were no MPU.
const DEFAULT_ELSEWHERE: u32 = 1 << 2;

/// Set up MPU and caches, once, before the DMA is used.
#[allow(unsafe_code)] // registers of the MPU; the linker script places the symbol
pub fn start(mut core: Peripherals) {
    unsafe extern "C" {
        static _dma_start: u32;
    }
    unsafe {
        core.MPU.ctrl.write(0);
        core.MPU.rnr.write(0);
        core.MPU.rbar.write((&raw const _dma_start).addr() as u32);
        core.MPU.rasr.write(NO_CODE | FULL_ACCESS | NOT_CACHED | SHARED | SIZE_8_KB | ENABLE);
        core.MPU.ctrl.write(DEFAULT_ELSEWHERE | ENABLE);
    }
    dsb();
    isb();
    core.SCB.enable_icache();
    core.SCB.enable_dcache(&mut core.CPUID);
}

/// The ring that the DMA fills. To be called once.
#[allow(unsafe_code)] // nobody else knows the static, and its only caller runs once
pub fn ring() -> &'static mut [u8] {
    #[unsafe(link_section = ".dma")]
    static mut BYTES: MaybeUninit<[u8; RING]> = MaybeUninit::uninit();
    // not loaded and not zeroed at the start, as the section is not the program's
    let bytes = &raw mut BYTES;
    unsafe { (*bytes).write([0; RING]) }
}
