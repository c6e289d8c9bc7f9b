//! The image: what lies where in memory, and the wiring.

use estimator::Tables as _;
use estimator::wire::link::Vitals;
use firmware_sim::machine::{BUILT_IN, Estimator, LINE, PACKET, Steer, Tables};
use firmware_sim::{Device, Panel};
use static_cell::ConstStaticCell;

use crate::board::clock::Clock;
use crate::board::pins::Pins;
use crate::board::{stack, uart, watchdog};

/// The posterior. All zero at first, so that it takes no flash.
static CORE: ConstStaticCell<Estimator> = ConstStaticCell::new(Estimator::BLANK);
/// The feedback on it.
static STEER: ConstStaticCell<Steer> = ConstStaticCell::new(Steer::BLANK);
/// Room for other tables.
static SLOT: ConstStaticCell<Tables> = ConstStaticCell::new(Tables::BLANK);

/// Rate of the UART [baud].
const BAUD: u32 = 921_600;
/// One machine cycle [us], that of the recordings' drift stream.
const CYCLE_US: u32 = 200_000;
/// Timeout of the watchdog [s]. A board has 5 s, 25 cycles; the emulator's timers follow its host's clock also while a busy
/// host lets the program stand still.
const WATCHDOG_S: u32 = 120;

#[cortex_m_rt::entry]
fn main() -> ! {
    let core = cortex_m::Peripherals::take().expect("taken once");
    let clock = Clock::start::<CYCLE_US>(core.SYST);
    let pins = Pins::start();
    let (mut receiver, mut sender) = uart::start(BAUD, &clock);
    let mut panel = Panel::new(pins.heartbeat, pins.attention, watchdog::start(WATCHDOG_S, pins.supervisor));
    let mut device = Device::<_, _, LINE>::new(CORE.take(), STEER.take(), &BUILT_IN, SLOT.take());
    let vitals = || Vitals {
        lost_bytes: uart::lost(),
        cycles: clock.now(),
        stack_bytes: stack::peak() as u32,
        ..Vitals::default()
    };
    defmt::info!("orbitcal device, tables {=u32:08x}, waiting for its setup", BUILT_IN.digest::<LINE>());
    let ended =
        firmware_sim::run::<_, _, _, _, LINE, PACKET>(&mut device, &mut receiver, &mut sender, &mut panel, vitals);
    panic!("the UART has ended: {}", ended.is_ok())
}
