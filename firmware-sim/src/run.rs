//! The loop of a device: bytes in, packets, replies out. The same on the host and on a chip.

use embedded_hal::digital::OutputPin;
use embedded_io::{Read, ReadReady, Write};
use estimator::wire::link::Vitals;
use estimator::{Core, Prepared, Steering};

use crate::device::{Device, Reply};
use crate::inbox::{Event, Inbox};
use crate::panel::Panel;

/// Run until the source ends. No packet has more than `P` bytes.
///
/// `source` reports [`embedded_io::ErrorKind::TimedOut`] once a machine cycle while nothing comes; `vitals` reads the status of
/// the board, when a host requests it.
///
/// # Errors
/// What the source or the sink report.
pub fn run<E: Core, S: Steering<E>, R: Read + ReadReady, W: Write<Error = R::Error>, const L: usize, const P: usize>(
    device: &mut Device<'_, E, S, L>,
    source: &mut R,
    sink: &mut W,
    panel: &mut Panel<impl OutputPin, impl OutputPin>,
    vitals: impl Fn() -> Vitals,
) -> Result<(), R::Error> {
    let mut inbox = Inbox::<P>::default();
    loop {
        let silent_cycles = inbox.silent_cycles();
        let event = inbox.next(source)?;
        let mut sent = Ok(());
        let mut reply = |number, reply: &Reply<E>| {
            if sent.is_ok() {
                sent = send::<E, W, P>(sink, number, reply);
            }
        };
        let refused = device.refused();
        let needs_attention = match event {
            Event::Packet(bytes) => device.hear(bytes, || Vitals { silent_cycles, ..vitals() }, &mut reply),
            Event::Broken(why) => {
                device.refuse(why, &mut reply);
                None
            }
            Event::Silence => None,
            Event::End => return sink.flush(),
        };
        // a pin that fails is no reason to stop
        let _ = needs_attention.map(|needs_attention| panel.show(needs_attention));
        let _ = (device.refused() != refused).then(|| panel.alarm());
        sent?;
        let _ = panel.feed();
        // the reply is sent: in slices, the device gets ready for the next frame until that comes
        while !source.read_ready()? && device.prepare() != Prepared::Nothing {}
    }
}

#[inline(never)] // its buffers are not to lie on the stack meanwhile
fn send<E: Core, W: Write, const P: usize>(sink: &mut W, number: u32, reply: &Reply<E>) -> Result<(), W::Error> {
    let mut outbox = [0; P];
    // a reply always fits its buffer
    let mut rest = reply.encode(number, &mut outbox).ok().and_then(|n| outbox.get(..n)).unwrap_or_default();
    // `write_all` panics at a sink that takes nothing
    while !rest.is_empty() {
        match sink.write(rest)? {
            0 => break,
            taken => rest = rest.get(taken..).unwrap_or_default(),
        }
    }
    Ok(())
}
