//! The cycle trigger: SysTick counts periods, and each tick wakes a sleeping main loop.

use core::sync::atomic::{AtomicU32, Ordering};

use cortex_m::peripheral::SYST;
use cortex_m::peripheral::syst::SystClkSource;
use cortex_m_rt::exception;

use super::SYSCLK_HZ;

static TICKS: AtomicU32 = AtomicU32::new(0);

/// The longest period [us]: SysTick counts 24 bits.
const LONGEST_US: u32 = (1 << 24) / (SYSCLK_HZ / 1_000_000);

/// Ticks since the start.
pub struct Clock(());

impl Clock {
    /// Start ticking with a period [us].
    pub fn start<const PERIOD_US: u32>(mut systick: SYST) -> Self {
        const { assert!(PERIOD_US > 0 && PERIOD_US <= LONGEST_US, "SysTick counts 24 bits") };
        systick.set_clock_source(SystClkSource::Core);
        systick.set_reload(PERIOD_US * (SYSCLK_HZ / 1_000_000) - 1);
        systick.clear_current();
        systick.enable_interrupt();
        systick.enable_counter();
        Self(())
    }

    /// Ticks so far; they wrap around.
    pub fn now(&self) -> u32 {
        TICKS.load(Ordering::Relaxed)
    }
}

#[exception]
fn SysTick() {
    TICKS.fetch_add(1, Ordering::Relaxed);
}
