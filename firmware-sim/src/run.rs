//! The loop of a device: bytes in, packets, answers out. The same on the host and on a chip.

use embedded_hal::digital::OutputPin;
use embedded_io::{Read, Write};
use estimator::packet;

use crate::device::Device;
use crate::inbox::{Event, Inbox};
use crate::link::{Reply, Vitals};
use crate::panel::Panel;

/// Run until the source ends.
///
/// `source` reports [`embedded_io::ErrorKind::TimedOut`] once a machine cycle while nothing comes; `vitals` asks the board
/// how it is, when a host asks for that.
///
/// # Errors
/// What the source or the sink report.
pub fn run<R: Read, W: Write<Error = R::Error>>(
    device: &mut Device<'_>,
    source: &mut R,
    sink: &mut W,
    panel: &mut Panel<impl OutputPin, impl OutputPin>,
    vitals: impl Fn() -> Vitals,
) -> Result<(), R::Error> {
    let mut inbox = Inbox::default();
    loop {
        let silent_cycles = inbox.silent_cycles();
        let event = inbox.next(source)?;
        let mut sent = Ok(());
        let mut reply = |reply: &Reply| {
            if sent.is_ok() {
                sent = send(sink, reply);
            }
        };
        let refused = device.refused();
        let answer = match event {
            Event::Packet(bytes) => device.hear(bytes, || Vitals { silent_cycles, ..vitals() }, &mut reply),
            Event::Broken(why) => {
                device.refuse(why, &mut reply);
                None
            }
            Event::Silence => None,
            Event::End => return sink.flush(),
        };
        // a lamp that does not light is no reason to stop
        let _ = answer.map(|estimate| panel.show(&estimate));
        let _ = (device.refused() != refused).then(|| panel.alarm());
        sent?;
        let _ = panel.feed();
        // the answer is out; this may take until the next frame
        device.prepare();
    }
}

#[inline(never)] // its buffers are not to lie on the stack meanwhile
fn send<W: Write>(sink: &mut W, reply: &Reply) -> Result<(), W::Error> {
    let mut outbox = [0; packet::MAX_WIRE_BYTES];
    // a reply always fits its buffer
    let bytes = reply.encode(&mut outbox).ok().and_then(|n| outbox.get(..n)).unwrap_or_default();
    sink.write_all(bytes)
}
