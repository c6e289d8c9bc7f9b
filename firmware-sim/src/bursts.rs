//! A receiver that hands over bursts, such as a DMA that stops where the line falls idle, as a stream of bytes.

use core::sync::atomic::{AtomicU32, Ordering};

use embedded_io::{Error, ErrorKind, ErrorType, Read, ReadReady};

/// The bytes of a receiver, of which it gives at most `N` at once. A fault of the line loses bytes: it is counted, and a zero stands
/// for what was lost, so that the packet which misses it ends there and the next one is whole.
#[derive(Debug)]
pub struct Bursts<'l, R, const N: usize> {
    receiver: R,
    burst: [u8; N],
    /// First byte of the burst that was not taken yet, and the burst's end.
    rest: (usize, usize),
    lost: &'l AtomicU32,
}

impl<'l, R: Read, const N: usize> Bursts<'l, R, N> {
    /// From now on; `lost` counts faults of the line.
    pub fn new(receiver: R, lost: &'l AtomicU32) -> Self {
        const { assert!(N > 0, "there is room for the zero of a fault") };
        Self { receiver, burst: [0; N], rest: (0, 0), lost }
    }

    /// Wait for the next burst.
    fn refill(&mut self) -> Result<(), R::Error> {
        let length = match self.receiver.read(&mut self.burst) {
            Ok(length) => length,
            Err(error) if error.kind() == ErrorKind::TimedOut => return Err(error),
            Err(_) => {
                self.lost.fetch_add(1, Ordering::Relaxed);
                self.burst.first_mut().map_or(0, |first| {
                    *first = 0;
                    1
                })
            }
        };
        self.rest = (0, length);
        Ok(())
    }
}

impl<R: Read, const N: usize> ErrorType for Bursts<'_, R, N> {
    type Error = R::Error;
}

impl<R: Read, const N: usize> Read for Bursts<'_, R, N> {
    fn read(&mut self, to: &mut [u8]) -> Result<usize, R::Error> {
        if self.rest.0 == self.rest.1 && !to.is_empty() {
            self.refill()?;
        }
        let (from, end) = self.rest;
        let taken = to.iter_mut().zip(self.burst.get(from..end).unwrap_or_default());
        let count = taken.map(|(to, byte)| *to = *byte).count();
        self.rest.0 += count;
        Ok(count)
    }
}

impl<R: Read + ReadReady, const N: usize> ReadReady for Bursts<'_, R, N> {
    /// A fault is ready, too: the next read counts it.
    fn read_ready(&mut self) -> Result<bool, R::Error> {
        Ok(self.rest.0 < self.rest.1 || self.receiver.read_ready().unwrap_or(true))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::inbox::{Event, Inbox};

    /// What a receiver reports, one after the other.
    struct Script<'s>(&'s [Result<&'s [u8], ErrorKind>]);

    impl ErrorType for Script<'_> {
        type Error = ErrorKind;
    }

    impl Read for Script<'_> {
        fn read(&mut self, to: &mut [u8]) -> Result<usize, ErrorKind> {
            let Some((first, rest)) = self.0.split_first() else { return Ok(0) };
            self.0 = rest;
            let bytes = (*first)?;
            to[..bytes.len()].copy_from_slice(bytes);
            Ok(bytes.len())
        }
    }

    impl ReadReady for Script<'_> {
        fn read_ready(&mut self) -> Result<bool, ErrorKind> {
            self.0.first().map_or(Ok(false), |first| first.map(|bytes| !bytes.is_empty()))
        }
    }

    /// A receiver that finds its ring lapped says so when it is asked whether bytes wait.
    #[test]
    fn a_fault_that_is_found_before_the_read_is_counted_by_it() {
        let lost = AtomicU32::new(0);
        let mut source = Bursts::<_, 4>::new(Script(&[Err(ErrorKind::Other), Ok(&[7])]), &lost);
        assert_eq!(source.read_ready(), Ok(true));
        let mut bytes = [9; 2];
        assert_eq!((source.read(&mut bytes), bytes), (Ok(1), [0, 9]), "what was lost ends a packet");
        assert_eq!((lost.load(Ordering::Relaxed), source.read_ready()), (1, Ok(true)));
        assert_eq!((source.read(&mut bytes), bytes, source.read_ready()), (Ok(1), [7, 9], Ok(false)));
    }

    #[test]
    fn bursts_are_a_stream_of_bytes() {
        let lost = AtomicU32::new(0);
        let mut source = Bursts::<_, 4>::new(Script(&[Ok(&[1, 2, 3]), Err(ErrorKind::TimedOut), Ok(&[4])]), &lost);
        let mut read = |most: usize| {
            let mut bytes = [9; 4];
            source.read(&mut bytes[..most]).map(|n| (n, bytes))
        };
        assert_eq!(read(2), Ok((2, [1, 2, 9, 9])));
        assert_eq!(read(4), Ok((1, [3, 9, 9, 9])), "what is there, without waiting for more");
        assert_eq!(read(0), Ok((0, [9; 4])));
        assert_eq!(read(1), Err(ErrorKind::TimedOut), "a cycle has passed");
        assert_eq!((read(1), read(1)), (Ok((1, [4, 9, 9, 9])), Ok((0, [9; 4]))), "and its end");
        assert_eq!(lost.into_inner(), 0);
    }

    #[test]
    fn a_fault_of_the_line_spoils_one_packet_and_is_counted() {
        let lost = AtomicU32::new(0);
        let overrun = Err(ErrorKind::Other);
        // in mid-packet; then between packets, where it spoils none
        let script = [Ok(&[5, 6][..]), overrun, Ok(&[7, 0][..]), overrun, overrun, Ok(&[8, 0][..])];
        let (mut source, mut inbox) = (Bursts::<_, 2>::new(Script(&script), &lost), Inbox::<16>::default());
        assert_eq!(inbox.next(&mut source), Ok(Event::Packet(&mut [5, 6, 0])));
        assert_eq!(inbox.next(&mut source), Ok(Event::Packet(&mut [7, 0])));
        assert_eq!(inbox.next(&mut source), Ok(Event::Packet(&mut [8, 0])));
        assert_eq!(inbox.next(&mut source), Ok(Event::End));
        assert_eq!(lost.into_inner(), 3);
    }

    /// A line that is broken for good: the loop comes round, so that the watchdog is fed.
    #[test]
    fn a_broken_line_does_not_hold_the_loop() {
        let (lost, script) = (AtomicU32::new(0), [Err(ErrorKind::Other); 100]);
        let (mut source, mut inbox) = (Bursts::<_, 2>::new(Script(&script), &lost), Inbox::<16>::default());
        assert_eq!(inbox.next(&mut source), Ok(Event::Silence));
        assert_eq!(lost.load(Ordering::Relaxed), 32);
    }
}
