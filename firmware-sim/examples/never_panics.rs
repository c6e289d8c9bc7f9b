//! Links only if the loop of a device cannot panic, from the bytes that come in to the bytes that go out: the panic handler calls
//! a function that exists nowhere, so that one path to a panic leaves an undefined symbol. Built for the chip by a test;
//! `can_panic.rs` shows that it would tell.
#![cfg_attr(target_os = "none", no_std, no_main)]
#![allow(unsafe_code)] // linked, never run: a symbol that is missing, an entry point, memory that is there or not

#[cfg(target_os = "none")]
mod chip {
    use core::hint::black_box;

    use embedded_hal::digital;
    use embedded_io::{ErrorKind, ErrorType, Read, ReadReady, Write};
    use estimator::booster::{Estimator, Green, LINE, PACKET, Steer};
    use estimator::wire::link::Vitals;
    use firmware_sim::{Device, Panel};

    unsafe extern "C" {
        fn the_loop_can_panic() -> !;
    }

    #[panic_handler]
    fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
        unsafe { the_loop_can_panic() }
    }

    /// A line and a pin of which the compiler knows nothing: any byte, any number of bytes, any error.
    struct Anything;

    impl ErrorType for Anything {
        type Error = ErrorKind;
    }

    impl Read for Anything {
        fn read(&mut self, to: &mut [u8]) -> Result<usize, ErrorKind> {
            black_box(to);
            black_box(Ok(1))
        }
    }

    impl ReadReady for Anything {
        fn read_ready(&mut self) -> Result<bool, ErrorKind> {
            Ok(black_box(false))
        }
    }

    impl Write for Anything {
        fn write(&mut self, bytes: &[u8]) -> Result<usize, ErrorKind> {
            black_box(bytes);
            black_box(Ok(1))
        }

        fn flush(&mut self) -> Result<(), ErrorKind> {
            black_box(Ok(()))
        }
    }

    impl digital::ErrorType for Anything {
        type Error = digital::ErrorKind;
    }

    impl digital::OutputPin for Anything {
        fn set_low(&mut self) -> Result<(), digital::ErrorKind> {
            black_box(Ok(()))
        }

        fn set_high(&mut self) -> Result<(), digital::ErrorKind> {
            black_box(Ok(()))
        }
    }

    /// State of a device.
    struct Memory {
        core: Estimator,
        steer: Steer,
        built_in: Green,
        slot: Green,
    }

    #[unsafe(no_mangle)]
    extern "C" fn _start() -> ! {
        let Memory { core, steer, built_in, slot } = unsafe { &mut *black_box(0x2000_0000 as *mut Memory) };
        let mut device = Device::<_, _, LINE>::new(core, steer, built_in, slot);
        let mut panel = Panel::new(Anything, Anything, Anything);
        let run = firmware_sim::run::<_, _, _, _, LINE, PACKET>;
        let vitals = || black_box(Vitals::default());
        loop {
            let _ = black_box(run(&mut device, &mut Anything, &mut Anything, &mut panel, vitals));
        }
    }
}

#[cfg(not(target_os = "none"))]
fn main() {}
