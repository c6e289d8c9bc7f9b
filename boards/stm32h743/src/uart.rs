//! USART 3, which the board's debugger shows its host as a serial line: received by DMA into a ring, handed over when the line falls
//! idle or half of the ring is full; sent by waiting for the transmitter.

use embassy_futures::block_on;
use embassy_stm32::mode::Async;
use embassy_stm32::peripherals::{DMA1_CH0, DMA1_CH1, PD8, PD9, USART3};
use embassy_stm32::usart::{Config, InterruptHandler, RingBufferedUartRx, Uart, UartTx};
use embassy_stm32::{Peri, bind_interrupts, dma};
use embassy_time::{Duration, Instant, with_deadline};
use embedded_io::{ErrorKind, ErrorType, Read, ReadReady, Write};

use crate::memory;

/// Rate of the UART [baud].
const BAUD: u32 = 921_600;
/// One machine cycle.
const CYCLE: Duration = Duration::from_millis(200);

bind_interrupts!(struct Interrupts {
    USART3 => InterruptHandler<USART3>;
    DMA1_STREAM0 => dma::InterruptHandler<DMA1_CH0>;
    DMA1_STREAM1 => dma::InterruptHandler<DMA1_CH1>;
});

/// Start it, once.
pub fn start(
    uart: Peri<'static, USART3>,
    rx: Peri<'static, PD9>,
    tx: Peri<'static, PD8>,
    to: Peri<'static, DMA1_CH0>,
    from: Peri<'static, DMA1_CH1>,
) -> (Receiver, Sender) {
    let mut config = Config::default();
    config.baudrate = BAUD;
    let uart = Uart::new(uart, rx, tx, to, from, Interrupts, config).expect("a rate that the clock can make");
    let (sender, receiver) = uart.split();
    let mut ring = receiver.into_ring_buffered(memory::ring());
    ring.start_uart();
    (Receiver(ring), Sender(sender))
}

/// Machine cycles since power-on.
pub fn cycles() -> u32 {
    (Instant::now().as_ticks() / CYCLE.as_ticks()) as u32
}

/// The next tick of the cycle.
fn next_tick() -> Instant {
    let now = Instant::now();
    now + CYCLE - Duration::from_ticks(now.as_ticks() % CYCLE.as_ticks())
}

/// The receiving half: what has come, at the latest when the line falls idle.
pub struct Receiver(RingBufferedUartRx<'static>);

impl ErrorType for Receiver {
    type Error = ErrorKind;
}

impl Read for Receiver {
    fn read(&mut self, to: &mut [u8]) -> Result<usize, ErrorKind> {
        match block_on(with_deadline(next_tick(), self.0.read(to))) {
            Ok(taken) => taken.map_err(|_| ErrorKind::Other),
            Err(_) => Err(ErrorKind::TimedOut),
        }
    }
}

impl ReadReady for Receiver {
    fn read_ready(&mut self) -> Result<bool, ErrorKind> {
        self.0.read_ready().map_err(|_| ErrorKind::Other)
    }
}

/// The sending half.
pub struct Sender(UartTx<'static, Async>);

impl ErrorType for Sender {
    type Error = ErrorKind;
}

impl Write for Sender {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, ErrorKind> {
        self.0.blocking_write(bytes).map(|()| bytes.len()).map_err(|_| ErrorKind::Other)
    }

    fn flush(&mut self) -> Result<(), ErrorKind> {
        self.0.blocking_flush().map_err(|_| ErrorKind::Other)
    }
}
