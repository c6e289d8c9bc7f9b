//! The deepest stack so far. The start-up code paints the stack; what has lost its paint was used.

use cortex_m_rt::STACK_PAINT_VALUE;

/// Bytes of stack used at most since the start [B].
#[allow(unsafe_code)] // the linker script places both symbols, and all words between them are the stack's
pub fn peak() -> usize {
    unsafe extern "C" {
        static _stack_start: u32;
        static _stack_end: u32;
    }
    let (top, bottom) = (&raw const _stack_start, &raw const _stack_end);
    let mut word = bottom;
    while word < top && unsafe { word.read_volatile() } == STACK_PAINT_VALUE {
        word = word.wrapping_add(1);
    }
    top.addr() - word.addr()
}
