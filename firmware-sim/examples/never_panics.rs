//! Links only if the core cannot panic: the panic handler calls a function that exists nowhere, so that one path to a panic
//! from the calls below leaves an undefined symbol. Built for the chip by a test; `can_panic.rs` shows that it would tell.
#![cfg_attr(target_os = "none", no_std, no_main)]
#![allow(unsafe_code)] // linked, never run: a symbol that is missing, an entry point, memory that is there or not

#[cfg(target_os = "none")]
mod chip {
    use core::hint::black_box;

    use estimator::booster::{Estimate, Estimator, Green, Setup};
    use estimator::{IngestError, Model};

    unsafe extern "C" {
        fn the_core_can_panic() -> !;
    }

    #[panic_handler]
    fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
        unsafe { the_core_can_panic() }
    }

    /// Everything that a frame can set in motion.
    #[repr(C)]
    struct Memory {
        core: Estimator,
        green: Green,
        setup: Setup,
        bytes: [u8; 1024],
        answer: Option<Result<Estimate, IngestError>>,
    }

    #[unsafe(no_mangle)]
    extern "C" fn _start() -> ! {
        let memory = unsafe { &mut *black_box(0x2000_0000 as *mut Memory) };
        let model = Model { surrogate: &memory.green, setup: &memory.setup };
        let _ = black_box(memory.core.restart(&model));
        memory.answer = Some(memory.core.ingest(&model, &mut memory.bytes));
        let _ = black_box(memory.core.prepare(&model));
        let _ = black_box(memory.core.adopt(&model));
        black_box(memory.core.fit_quality(&model));
        black_box(memory.core.covariance(black_box(1), black_box(2)));
        loop {}
    }
}

#[cfg(not(target_os = "none"))]
fn main() {}
