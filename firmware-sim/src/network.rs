//! An image that evaluates the networks of the Booster and compares outputs and Jacobians with the host's, bit for bit: status 0 if all
//! agree, `cargo run --profile firmware -p firmware-sim --bin network --target thumbv7em-none-eabihf`.
//!
//! What the host arrives at is written by the build script, with the compiler's own inner loop; here two products are made at once.
#![cfg_attr(target_os = "none", no_std, no_main)]

use estimator::surrogate::Network;

include!(concat!(env!("OUT_DIR"), "/network.rs"));

/// Inputs in both planes: 24 correctors, 5 currents, 48 vars.
const INPUTS: usize = 77;
/// Both planes.
const PLANES: [Network<'static>; 2] = [
    Network::new(include_bytes!("../../training/tables/resnet-x.bin"), INPUTS, 15, 24),
    Network::new(include_bytes!("../../training/tables/resnet-y.bin"), INPUTS, 18, 24),
];

#[cfg(target_os = "none")]
mod chip {
    use core::arch::asm;

    use cortex_m as _; // critical sections
    use cortex_m_semihosting::debug;
    use defmt_semihosting as _; // the logger
    use estimator::surrogate::{Pass, Products};
    use static_cell::ConstStaticCell;

    use super::{DIGESTS, PLANES};

    /// Work space, too large for the stack.
    static PASS: ConstStaticCell<Pass> = ConstStaticCell::new(Pass::BLANK);

    /// Two products at once by the chip's instructions for 16-bit halves.
    struct Dual;

    impl Products for Dual {
        fn sum(weights: &[u8], codes: &[i16]) -> i32 {
            let length = weights.len().min(codes.len());
            let (fours, rest) = weights.get(..length).unwrap_or_default().as_chunks::<4>();
            let (codes, last) = codes.get(..length).unwrap_or_default().as_chunks::<4>();
            let mut sum = 0;
            for (weights, [first, second, third, fourth]) in fours.iter().zip(codes) {
                let pair = |low: i16, high: i16| u32::from(low as u16) | u32::from(high as u16) << 16;
                sum = accumulate(sum, u32::from_le_bytes(*weights), pair(*first, *third), pair(*second, *fourth));
            }
            rest.iter().zip(last).fold(sum, |sum, (weight, code)| sum + i32::from(*weight as i8) * i32::from(*code))
        }
    }

    /// Add the products of four weights with the even and with the odd ones of four codes.
    #[inline(always)]
    #[allow(unsafe_code)] // four instructions on registers, which every Cortex-M7 has; the flag for a sum too large is not read
    fn accumulate(sum: i32, weights: u32, even: u32, odd: u32) -> i32 {
        let result: i32;
        unsafe {
            asm!(
                "sxtb16 {half}, {weights}",
                "smlad {sum}, {half}, {even}, {sum}",
                "sxtb16 {half}, {weights}, ror #8",
                "smlad {sum}, {half}, {odd}, {sum}",
                half = out(reg) _,
                weights = in(reg) weights,
                even = in(reg) even,
                odd = in(reg) odd,
                sum = inout(reg) sum => result,
                options(pure, nomem, nostack)
            );
        }
        result
    }

    #[cortex_m_rt::entry]
    fn main() -> ! {
        let pass = PASS.take();
        let digests = [PLANES[0].digest::<Dual>(pass), PLANES[1].digest::<Dual>(pass)];
        let ([x, y], [host_x, host_y]) = (digests, DIGESTS);
        defmt::info!("x {=u32:08x}, host {=u32:08x}; y {=u32:08x}, host {=u32:08x}", x, host_x, y, host_y);
        debug::exit(if digests == DIGESTS { debug::EXIT_SUCCESS } else { debug::EXIT_FAILURE });
        panic!("the emulator goes on")
    }

    #[panic_handler]
    fn panic(_: &core::panic::PanicInfo) -> ! {
        loop {
            debug::exit(debug::EXIT_FAILURE);
        }
    }
}

/// The same on the host.
#[cfg(not(target_os = "none"))]
fn main() {
    use estimator::surrogate::{Pass, Plain};

    let mut pass = Pass::BLANK;
    let digests = [0, 1].map(|plane: usize| PLANES[plane].digest::<Plain>(&mut pass));
    assert_eq!(digests, DIGESTS, "this build and that of the build script disagree");
}
