//! The device on an STM32H743, wired for the board NUCLEO-H743ZI2: the loop of `firmware_sim::run`, as on the emulated board.
//!
//! It builds and links; it has never run on a board. See `docs/device.md`.
#![no_std]
#![no_main]

mod clocks;
mod fault;
mod memory;
#[path = "../../../firmware-sim/src/board/stack.rs"]
mod stack;
mod uart;

use core::sync::atomic::{AtomicU32, Ordering};

use defmt_rtt as _; // the logger
use embassy_stm32::Peri;
use embassy_stm32::gpio::{AnyPin, Level, Output, Speed};
use embassy_stm32::wdg::IndependentWatchdog;
use estimator::Tables as _;
use estimator::wire::link::Vitals;
use firmware_sim::machine::{BUILT_IN, Estimator, LINE, PACKET, Steer, Tables};
use firmware_sim::{Bursts, Device, Panel, Supervisor};
use static_cell::ConstStaticCell;

/// The posterior. All zero at first, so that it takes no flash.
static CORE: ConstStaticCell<Estimator> = ConstStaticCell::new(Estimator::BLANK);
/// The feedback on it.
static STEER: ConstStaticCell<Steer> = ConstStaticCell::new(Steer::BLANK);
/// Room for other tables.
static SLOT: ConstStaticCell<Tables> = ConstStaticCell::new(Tables::BLANK);
/// Faults of the line, each of which has lost one byte or more.
static LOST: AtomicU32 = AtomicU32::new(0);

/// Timeout of the watchdog [us]: 25 cycles.
const WATCHDOG_US: u32 = 5_000_000;
/// Most bytes that are taken from the receiver at once.
const BURST: usize = 64;

#[cortex_m_rt::entry]
fn main() -> ! {
    let part = embassy_stm32::init(clocks::config());
    memory::start(cortex_m::Peripherals::take().expect("taken once"));
    let (receiver, mut sender) = uart::start(part.USART3, part.PD9, part.PD8, part.DMA1_CH0, part.DMA1_CH1);
    let mut source = Bursts::<_, BURST>::new(receiver, &LOST);
    let low = |pin: Peri<'static, AnyPin>| Output::new(pin, Level::Low, Speed::Low);
    let mut watchdog = IndependentWatchdog::new(part.IWDG1, WATCHDOG_US);
    watchdog.unleash();
    let supervisor = Supervisor::new(low(part.PG0.into()), || watchdog.pet());
    let mut panel = Panel::new(low(part.PB0.into()), low(part.PB14.into()), supervisor);
    let mut device = Device::<_, _, LINE>::new(CORE.take(), STEER.take(), &BUILT_IN, SLOT.take());
    let vitals = || Vitals {
        lost_bytes: LOST.load(Ordering::Relaxed),
        cycles: uart::cycles(),
        stack_bytes: stack::peak() as u32,
        ..Vitals::default()
    };
    defmt::info!("orbitcal device, tables {=u32:08x}, waiting for its setup", BUILT_IN.digest::<LINE>());
    let ended =
        firmware_sim::run::<_, _, _, _, LINE, PACKET>(&mut device, &mut source, &mut sender, &mut panel, vitals);
    panic!("the UART has ended: {}", ended.is_ok())
}
