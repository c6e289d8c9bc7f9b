//! UART 0 as a stream of bytes: received by interrupt into a queue, sent by waiting for the transmitter.
//!
//! The interrupt empties the one-byte register of the hardware whatever the main loop computes meanwhile. No byte is
//! lost silently: one for which the queue has no room counts as dropped, one that the hardware overwrote as overrun.

use core::cell::RefCell;
use core::sync::atomic::{AtomicU32, Ordering};

use cortex_m::{asm, interrupt, interrupt::Mutex};
use embedded_io::{ErrorKind, ErrorType, Read, ReadReady, Write};
use heapless::spsc::{Consumer, Producer, Queue};
use static_cell::ConstStaticCell;

use super::SYSCLK_HZ;
use super::clock::Clock;
use super::registers::{NVIC_ISER0, UART0_BAUDDIV, UART0_CTRL, UART0_DATA, UART0_INTCLEAR, UART0_STATE};

/// Room for received bytes [B].
///
/// Between two packets the main loop takes none while it updates (2.4 ms at 400 MHz and one instruction a cycle), sends the
/// estimate (15 ms at 921,600 baud) and ends a slice of its work between frames (3.7 ms): 21 ms, and 55 ms more if it sends
/// a covariance. A sender without pauses fills this in 44 ms; what it sends then is lost, and counted. A front end that
/// sends a frame of 260 bytes a cycle, and some requests, is far from that.
const QUEUE: usize = 4096;

/// UART 0 receive in the interrupt assignment of AN500.
pub const INTERRUPT: i16 = 0;

// UART0_STATE; the overrun bit is cleared by writing a one.
const TRANSMITTER_FULL: u32 = 1 << 0;
const RECEIVER_FULL: u32 = 1 << 1;
const RECEIVER_OVERRUN: u32 = 1 << 3;

// UART0_CTRL.
const TRANSMITTER_ENABLE: u32 = 1 << 0;
const RECEIVER_ENABLE: u32 = 1 << 1;
const RECEIVE_INTERRUPT_ENABLE: u32 = 1 << 3;

// UART0_INTCLEAR.
const RECEIVE_INTERRUPT: u32 = 1 << 1;

static WAITING: ConstStaticCell<Queue<u8, QUEUE>> = ConstStaticCell::new(Queue::new());
static RECEIVED: Mutex<RefCell<Option<Producer<'static, u8>>>> = Mutex::new(RefCell::new(None));
static DROPPED: AtomicU32 = AtomicU32::new(0);
static OVERRUN: AtomicU32 = AtomicU32::new(0);

/// Bytes that did not reach the main loop, since the start: those for which the queue had no room, and the overruns of the
/// hardware's register, each of which stands for one byte or more.
pub fn lost() -> u32 {
    DROPPED.load(Ordering::Relaxed).saturating_add(OVERRUN.load(Ordering::Relaxed))
}

/// Start the UART at a rate [baud]; its reader waits for one tick of the clock at most.
///
/// # Panics
/// If called twice: there is one UART.
pub fn start(baud: u32, clock: &Clock) -> (Receiver<'_>, Sender) {
    let (producer, bytes) = WAITING.take().split();
    interrupt::free(|cs| RECEIVED.borrow(cs).replace(Some(producer)));
    UART0_BAUDDIV.write(SYSCLK_HZ / baud);
    UART0_CTRL.write(TRANSMITTER_ENABLE | RECEIVER_ENABLE | RECEIVE_INTERRUPT_ENABLE);
    NVIC_ISER0.write(1 << INTERRUPT);
    (Receiver { bytes, clock }, Sender(()))
}

/// What the interrupt does: take the byte from the hardware's register to the queue.
///
/// The interrupt is cleared before the register is read, so that a byte that arrives in between raises it again. Inlined
/// into its handler, so that a count of instructions can leave out all that an interrupt adds.
#[inline(always)]
pub fn receive() {
    UART0_INTCLEAR.write(RECEIVE_INTERRUPT);
    let state = UART0_STATE.read();
    if state & RECEIVER_OVERRUN != 0 {
        UART0_STATE.write(RECEIVER_OVERRUN);
        OVERRUN.fetch_add(1, Ordering::Relaxed);
    }
    if state & RECEIVER_FULL != 0 {
        enqueue(UART0_DATA.read() as u8);
    }
}

#[inline(always)]
fn enqueue(byte: u8) {
    let queued = interrupt::free(|cs| RECEIVED.borrow(cs).borrow_mut().as_mut().map(|queue| queue.enqueue(byte)));
    if !matches!(queued, Some(Ok(()))) {
        DROPPED.fetch_add(1, Ordering::Relaxed);
    }
}

/// The reading half. It sleeps while there is nothing to read.
pub struct Receiver<'c> {
    bytes: Consumer<'static, u8>,
    clock: &'c Clock,
}

impl Receiver<'_> {
    /// Sleep until an interrupt, unless a byte is there.
    ///
    /// With interrupts masked none slips in between the look and the sleep; a pending one ends the sleep all the same,
    /// and is served once they are unmasked.
    fn sleep(&self) {
        interrupt::free(|_| {
            if self.bytes.is_empty() {
                asm::wfi();
            }
        });
    }
}

impl ErrorType for Receiver<'_> {
    type Error = ErrorKind;
}

impl Read for Receiver<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize, ErrorKind> {
        let began = self.clock.now();
        while self.bytes.is_empty() && !buffer.is_empty() {
            self.sleep();
            if self.bytes.is_empty() && self.clock.now() != began {
                return Err(ErrorKind::TimedOut);
            }
        }
        let filled = buffer.iter_mut().zip(core::iter::from_fn(|| self.bytes.dequeue()));
        Ok(filled.map(|(slot, byte)| *slot = byte).count())
    }
}

impl ReadReady for Receiver<'_> {
    fn read_ready(&mut self) -> Result<bool, ErrorKind> {
        Ok(!self.bytes.is_empty())
    }
}

/// The writing half. It waits for the transmitter with interrupts enabled.
pub struct Sender(());

impl ErrorType for Sender {
    type Error = ErrorKind;
}

impl Write for Sender {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, ErrorKind> {
        for &byte in bytes {
            self.flush()?;
            UART0_DATA.write(byte.into());
        }
        Ok(bytes.len())
    }

    /// Wait until the last byte is in the shift register.
    fn flush(&mut self) -> Result<(), ErrorKind> {
        while UART0_STATE.read() & TRANSMITTER_FULL != 0 {}
        Ok(())
    }
}
