//! From bytes to packets, which zeros separate.

use embedded_io::{Error, ErrorKind, Read};
use estimator::wire::link::Refusal;

/// Cycles without a byte after which the rest of a packet will not come: its sender has stalled or restarted.
const PATIENCE: u32 = 2;

/// The packet that is coming in, of `P` bytes at most.
#[derive(Debug)]
pub struct Inbox<const P: usize> {
    bytes: [u8; P],
    length: usize,
    /// More came than any packet has; what follows up to the next zero is dropped.
    overflown: bool,
    /// Ticks of the cycle since the last byte.
    silence: u32,
    /// Whole cycles in which nothing came, since power-on.
    silent_cycles: u32,
}

/// What comes out of an inbox.
#[derive(Debug, PartialEq, Eq)]
pub enum Event<'i> {
    /// The bytes of a packet, its zero included.
    Packet(&'i mut [u8]),
    /// Bytes that are not a packet.
    Broken(Refusal),
    /// No packet yet: nothing came for a cycle, or many bytes without a packet.
    Silence,
    /// The source has ended.
    End,
}

impl<const P: usize> Default for Inbox<P> {
    fn default() -> Self {
        Self { bytes: [0; P], length: 0, overflown: false, silence: 0, silent_cycles: 0 }
    }
}

impl<const P: usize> Inbox<P> {
    /// Whole cycles, from tick to tick, in which nothing came, since power-on.
    pub fn silent_cycles(&self) -> u32 {
        self.silent_cycles
    }

    /// Wait for a packet, or for a cycle to pass without a byte. A stream of bytes without packets is interrupted occasionally,
    /// so that the loop can feed the watchdog.
    ///
    /// # Errors
    /// What the source reports, but [`ErrorKind::TimedOut`].
    pub fn next<R: Read>(&mut self, source: &mut R) -> Result<Event<'_>, R::Error> {
        let mut byte = [0];
        for _ in 0..2 * P {
            match source.read(&mut byte) {
                Ok(0) => return Ok(Event::End),
                Ok(_) => self.silence = 0,
                Err(error) if error.kind() == ErrorKind::TimedOut => return Ok(self.wait()),
                Err(error) => return Err(error),
            }
            match byte {
                [0] if self.length > 0 => {
                    self.push(0); // for which there may be no room either
                    let length = core::mem::take(&mut self.length);
                    if core::mem::take(&mut self.overflown) {
                        return Ok(Event::Broken(Refusal::Oversized));
                    }
                    return Ok(Event::Packet(self.bytes.get_mut(..length).unwrap_or_default()));
                }
                [0] => {} // an empty packet is no packet: a sender may begin with a zero
                [other] => self.push(other),
            }
        }
        Ok(Event::Silence)
    }

    fn push(&mut self, byte: u8) {
        match self.bytes.get_mut(self.length) {
            Some(to) => (*to, self.length) = (byte, self.length + 1),
            None => self.overflown = true,
        }
    }

    fn wait(&mut self) -> Event<'static> {
        // the first tick after a byte ends a cycle in which that came
        self.silent_cycles = self.silent_cycles.saturating_add(u32::from(self.silence > 0));
        self.silence = self.silence.saturating_add(1);
        if self.silence < PATIENCE || self.length == 0 {
            return Event::Silence;
        }
        (self.length, self.overflown) = (0, false);
        Event::Broken(Refusal::Stalled)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MOST: usize = 1544;
    type Small = Inbox<MOST>;

    /// A source of bytes, with cycles that pass where a `None` stands.
    struct Script<'s>(&'s [Option<u8>]);

    impl embedded_io::ErrorType for Script<'_> {
        type Error = ErrorKind;
    }

    impl Read for Script<'_> {
        fn read(&mut self, to: &mut [u8]) -> Result<usize, ErrorKind> {
            let Some((first, rest)) = self.0.split_first() else { return Ok(0) };
            self.0 = rest;
            to[0] = first.ok_or(ErrorKind::TimedOut)?;
            Ok(1)
        }
    }

    fn bytes<const L: usize>(bytes: [u8; L]) -> [Option<u8>; L] {
        bytes.map(Some)
    }

    #[test]
    fn packets_end_with_a_zero_and_may_begin_with_one() {
        let (script, mut inbox) = (bytes([0, 0, 2, 7, 0, 3, 0, 9]), Small::default());
        let mut source = Script(&script);
        assert_eq!(inbox.next(&mut source), Ok(Event::Packet(&mut [2, 7, 0])));
        assert_eq!(inbox.next(&mut source), Ok(Event::Packet(&mut [3, 0])));
        assert_eq!(inbox.next(&mut source), Ok(Event::End));
    }

    #[test]
    fn a_packet_that_is_too_long_does_not_spoil_the_one_after() {
        for length in [MOST - 1, MOST, MOST + 1, MOST + 9] {
            let mut script = [Some(1); MOST + 12];
            (script[length], script[length + 2]) = (Some(0), Some(0));
            let (mut source, mut inbox) = (Script(&script), Small::default());
            match inbox.next(&mut source) {
                Ok(Event::Packet(bytes)) => assert_eq!((bytes.len(), bytes.last()), (MOST, Some(&0)), "{length} bytes"),
                other => assert_eq!((other, length >= MOST), (Ok(Event::Broken(Refusal::Oversized)), true), "{length}"),
            }
            assert_eq!(inbox.next(&mut source), Ok(Event::Packet(&mut [1, 0])), "after {length} bytes");
        }
    }

    #[test]
    fn a_stream_without_packets_is_interrupted_occasionally() {
        for noise in [0, 1] {
            let script = [Some(noise); 3 * MOST];
            let (mut source, mut inbox) = (Script(&script), Small::default());
            assert_eq!(inbox.next(&mut source), Ok(Event::Silence));
            assert_eq!(inbox.next(&mut source), Ok(Event::End));
        }
    }

    #[test]
    fn a_stalled_sender_does_not_spoil_the_packet_after() {
        let script = [Some(5), None, Some(6), None, None, None, Some(7), Some(0)];
        let (mut source, mut inbox) = (Script(&script), Small::default());
        assert_eq!(inbox.next(&mut source), Ok(Event::Silence), "one cycle is no stall");
        assert_eq!(inbox.next(&mut source), Ok(Event::Silence));
        assert_eq!(inbox.next(&mut source), Ok(Event::Broken(Refusal::Stalled)));
        assert_eq!(inbox.next(&mut source), Ok(Event::Silence), "nothing is waiting any more");
        assert_eq!(inbox.next(&mut source), Ok(Event::Packet(&mut [7, 0])));
        assert_eq!(inbox.silent_cycles(), 2, "of two ticks after a byte and of three");
    }

    #[test]
    fn a_stream_of_a_packet_a_cycle_has_no_silent_cycle() {
        let script = [Some(5), Some(0), None].repeat(20);
        let (mut source, mut inbox) = (Script(&script), Small::default());
        while inbox.next(&mut source) != Ok(Event::End) {}
        assert_eq!(inbox.silent_cycles(), 0);
    }
}
