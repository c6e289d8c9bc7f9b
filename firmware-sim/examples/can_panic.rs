//! The counterpart of `never_panics.rs`: an index that may be out of bounds, which must not link.
#![cfg_attr(target_os = "none", no_std, no_main)]
#![allow(unsafe_code)] // linked, never run: a symbol that is missing, an entry point, memory that is there or not

#[cfg(target_os = "none")]
mod chip {
    use core::hint::black_box;

    unsafe extern "C" {
        fn the_loop_can_panic() -> !;
    }

    #[panic_handler]
    fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
        unsafe { the_loop_can_panic() }
    }

    #[unsafe(no_mangle)]
    extern "C" fn _start() -> ! {
        black_box([1, 2, 3][black_box(7)]);
        loop {}
    }
}

#[cfg(not(target_os = "none"))]
fn main() {}
