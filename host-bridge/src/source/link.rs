//! The host's end of a device's line: requests and frames out, replies in.

use core::hash::BuildHasher as _;
use core::time::Duration;
use std::hash::RandomState;
use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::os::unix::net::UnixStream;
use std::time::Instant;

use estimator::wire::link::{Form, Refusal, Short, Status, Taken, UNASKED};
use estimator::{FrameError, ParcelError, Tables as _};
use inference::stream::{Estimate, Setup};
use training::rooms::largest::{Feedback, PACKET, Reply, Request, Setpoints};
use training::{LINE, Tables};

use super::address::Address;

/// Longest wait for a reply that is due, and for a device to take bytes.
const PATIENCE: Duration = Duration::from_secs(10);
/// Longest wait for an estimate that nobody here has asked for: five cycles.
const LULL: Duration = Duration::from_secs(1);
/// Longest read or write of a line; then the time is looked at.
const GLANCE: Duration = Duration::from_millis(200);
/// What goes wrong on the line.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LinkError {
    /// Nobody is there.
    #[error("{device}: {error}")]
    Open {
        /// Where.
        device: Address,
        /// Why.
        error: io::Error,
    },
    /// The line broke.
    #[error("the device's line: {0}")]
    Line(io::Error),
    /// What was due did not come.
    #[error("the device has not said what was due for {seconds} s")]
    Silent {
        /// How long it was waited for.
        seconds: u64,
    },
    /// The line takes no bytes.
    #[error("the device has taken no bytes for {seconds} s")]
    Stuck {
        /// How long it was waited for.
        seconds: u64,
    },
    /// The device has gone.
    #[error("the device has closed its line")]
    Closed,
    /// A reply was damaged on its way.
    #[error("a reply of the device: {0}")]
    Reply(#[from] FrameError),
    /// A reply is not the one that was due.
    #[error("expected {expected}, the device said {found}")]
    Unexpected {
        /// What was due.
        expected: &'static str,
        /// The reply, shortened.
        found: String,
    },
    /// The device refused a packet.
    #[error("the device refused {what}: {why:?}")]
    Refused {
        /// What it was.
        what: &'static str,
        /// Why.
        why: Refusal,
    },
    /// The device did not take new tables.
    #[error("the device did not take the tables: {0}")]
    Tables(ParcelError),
}

/// An estimate of a device, with the covariance if that followed.
#[derive(Debug, Clone, PartialEq)]
pub struct Heard {
    /// The estimate.
    pub estimate: Estimate,
    /// Covariance of `theta = ln var`, lower triangle row by row.
    pub covariance: Option<Vec<f32>>,
}

/// An estimate whose covariance may follow.
struct Coming {
    estimate: Estimate,
    /// Entries that are there.
    covariance: Vec<f32>,
}

impl Coming {
    fn new(estimate: Estimate) -> Self {
        Self { covariance: Vec::with_capacity(triangle(&estimate)), estimate }
    }

    /// Take a piece of a covariance, if it is the next one of this estimate's.
    fn add(&mut self, sequence: u32, first: u32, entries: &[f32]) {
        if sequence == self.estimate.sequence && first as usize == self.covariance.len() {
            let room = triangle(&self.estimate) - self.covariance.len();
            self.covariance.extend(entries.iter().take(room));
        }
    }

    fn is_whole(&self) -> bool {
        self.covariance.len() == triangle(&self.estimate)
    }

    /// What has come: the estimate, and its covariance if that is whole.
    fn heard(self) -> Heard {
        let is_whole = self.is_whole();
        Heard { estimate: self.estimate, covariance: is_whole.then_some(self.covariance) }
    }
}

/// Entries of the covariance of its params.
fn triangle(estimate: &Estimate) -> usize {
    let params = estimate.mean.len();
    params * (params + 1) / 2
}

/// What a line brings.
enum Event {
    /// An estimate.
    Heard(Box<Heard>),
    /// A reply that is no part of an estimate, and the number of its request.
    Other(u32, Box<Reply>),
}

impl Heard {
    /// Covariance of two params `theta = ln var`; 0 if it was not sent.
    pub fn covariance(&self, i: usize, j: usize) -> f32 {
        let (i, j) = (i.max(j), i.min(j));
        self.covariance.as_ref().map_or(0.0, |entries| entries[i * (i + 1) / 2 + j])
    }
}

/// Both directions of a byte stream.
pub trait Line: Read + Write {}

impl<L: Read + Write> Line for L {}

/// A device at the other end of a line.
pub struct Link<L> {
    line: L,
    received: Vec<u8>,
    coming: Option<Coming>,
    /// Number of the last request.
    number: u32,
}

impl Link<Box<dyn Line>> {
    /// Connect to a device.
    ///
    /// # Errors
    /// [`LinkError::Open`].
    pub fn open(address: &Address) -> Result<Self, LinkError> {
        let line = connect(address).map_err(|error| LinkError::Open { device: address.clone(), error })?;
        Ok(Self::new(line))
    }
}

fn connect(address: &Address) -> io::Result<Box<dyn Line>> {
    Ok(match address {
        Address::Tcp(address) => {
            let line = TcpStream::connect(address)?;
            line.set_nodelay(true)?;
            line.set_read_timeout(Some(GLANCE))?;
            line.set_write_timeout(Some(GLANCE))?;
            Box::new(line)
        }
        Address::Unix(path) => {
            let line = UnixStream::connect(path)?;
            line.set_read_timeout(Some(GLANCE))?;
            line.set_write_timeout(Some(GLANCE))?;
            Box::new(line)
        }
        Address::Serial(path, baud) => Box::new(serialport::new(path, *baud).timeout(GLANCE).open()?),
    })
}

impl<L: Read + Write> Link<L> {
    /// A device on a line that is open already. A read of it is to time out now and then, or nothing here ends.
    pub fn new(line: L) -> Self {
        // replies to somebody before us may be on their way: their numbers are not those of ours
        let number = RandomState::new().hash_one(()) as u32;
        Self { line, received: Vec::new(), coming: None, number }
    }

    /// Let the device begin at the prior.
    ///
    /// # Errors
    /// [`LinkError`].
    pub fn restart(&mut self, setup: &Setup) -> Result<(), LinkError> {
        // a zero first: half a packet of somebody before us may be waiting
        self.write(&[0])?;
        let number = self.send(&Request::Restart(setup.on_wire()))?;
        self.coming = None;
        let deadline = Instant::now() + PATIENCE;
        loop {
            match self.reply_to(number, deadline) {
                Ok(Reply::Restarted) => return Ok(()),
                Ok(Reply::Refused { why, .. }) => return Err(LinkError::Refused { what: "its setup", why }),
                // the tables in its slot have no design; or the half of a reply that was on its way when the line was opened
                Ok(Reply::Model(_)) | Err(LinkError::Reply(_)) => {}
                Ok(other) => return Err(unexpected("a word on the setup", &other)),
                Err(error) => return Err(error),
            }
        }
    }

    /// Let the device reply to frames in full or in short, until it is restarted.
    ///
    /// # Errors
    /// [`LinkError`].
    pub fn form(&mut self, form: Form) -> Result<(), LinkError> {
        match self.ask(&Request::Form(form))? {
            Reply::Form(got) if got == form => Ok(()),
            other => Err(unexpected("the form of its replies", &other)),
        }
    }

    /// Let the device steer from the next frame on, as if it were the first, or no more; restarted it does not.
    ///
    /// # Errors
    /// [`LinkError`].
    pub fn steer(&mut self, feedback: Option<Feedback>) -> Result<(), LinkError> {
        let steers = feedback.is_some();
        match self.ask(&Request::Feedback(feedback))? {
            Reply::Feedback(got) if got == steers => Ok(()),
            Reply::Refused { why, .. } => Err(LinkError::Refused { what: "a feedback", why }),
            other => Err(unexpected("whether it steers", &other)),
        }
    }

    /// Send a frame and wait for the reply, with the covariance.
    ///
    /// # Errors
    /// [`LinkError`].
    pub fn ingest(&mut self, sequence: u32, wire: &[u8]) -> Result<Heard, LinkError> {
        let number = self.send(&Request::Covariance)?;
        self.write(wire)?;
        let deadline = Instant::now() + PATIENCE;
        loop {
            match self.gather(deadline, PATIENCE)? {
                // of a frame that somebody before us has sent
                Event::Heard(heard) if heard.estimate.sequence != sequence => {}
                Event::Heard(heard) if heard.covariance.is_some() => return Ok(*heard),
                Event::Heard(_) => {
                    let found = format!("only the estimate of frame {sequence}");
                    return Err(LinkError::Unexpected { expected: "an estimate and its covariance", found });
                }
                Event::Other(of, other) if of == number || of == UNASKED => {
                    return Err(match *other {
                        Reply::Refused { why, .. } => LinkError::Refused { what: "a frame", why },
                        other => unexpected("an estimate", &other),
                    });
                }
                Event::Other(..) => {}
            }
        }
    }

    /// Send a frame to a device that replies in short, and wait for that: with setpoints, if it steers.
    ///
    /// # Errors
    /// [`LinkError`].
    pub fn feedback(&mut self, sequence: u32, wire: &[u8]) -> Result<Short<Setpoints>, LinkError> {
        self.write(wire)?;
        let deadline = Instant::now() + PATIENCE;
        loop {
            match self.reply_to(UNASKED, deadline)? {
                Reply::Short(short) if short.sequence == sequence => return Ok(short),
                // of a frame that somebody before us has sent
                Reply::Short(_) => {}
                Reply::Refused { why, .. } => return Err(LinkError::Refused { what: "a frame", why }),
                other => return Err(unexpected("a short reply", &other)),
            }
        }
    }

    /// Wait a second for an estimate of a frame that somebody else has sent, and for its covariance if that follows. One
    /// whose covariance does not follow, or not whole, is heard with the next reply or after that second.
    ///
    /// # Errors
    /// [`LinkError`]; after [`LinkError::Silent`], [`LinkError::Refused`] and [`LinkError::Reply`] the next estimate can be
    /// waited for.
    pub fn listen(&mut self) -> Result<Heard, LinkError> {
        let deadline = Instant::now() + LULL;
        loop {
            match self.gather(deadline, LULL)? {
                Event::Heard(heard) => return Ok(*heard),
                Event::Other(_, other) => {
                    if let Reply::Refused { why, .. } = *other {
                        return Err(LinkError::Refused { what: "a packet", why });
                    } // else a reply to somebody else
                }
            }
        }
    }

    /// Wait for an estimate, and for its covariance, which follows at once if at all; or for another reply.
    fn gather(&mut self, deadline: Instant, patience: Duration) -> Result<Event, LinkError> {
        loop {
            match self.next_before(deadline, patience) {
                Ok((_, Reply::Estimate(reply))) => {
                    let estimate = Estimate::of_answer(&reply).ok_or(LinkError::Reply(FrameError::Malformed))?;
                    if let Some(former) = self.coming.replace(Coming::new(estimate)) {
                        return Ok(Event::Heard(Box::new(former.heard())));
                    }
                }
                Ok((_, Reply::Covariance { sequence, first, entries })) => {
                    if let Some(coming) = &mut self.coming {
                        coming.add(sequence, first, &entries);
                    }
                    if let Some(whole) = self.coming.take_if(|coming| coming.is_whole()) {
                        return Ok(Event::Heard(Box::new(whole.heard())));
                    }
                }
                Ok((number, other)) => return Ok(Event::Other(number, Box::new(other))),
                Err(error @ LinkError::Reply(_)) => return Err(error),
                // no more will come of it
                Err(error) => {
                    return self.coming.take().map(|coming| Event::Heard(Box::new(coming.heard()))).ok_or(error);
                }
            }
        }
    }

    /// How the device is.
    ///
    /// # Errors
    /// [`LinkError`].
    pub fn status(&mut self) -> Result<Status, LinkError> {
        match self.ask(&Request::Status)? {
            Reply::Status(status) => Ok(status),
            other => Err(unexpected("its status", &other)),
        }
    }

    /// Put other tables in use; `progress` hears of each of their parts.
    ///
    /// # Errors
    /// [`LinkError::Tables`] if the device did not take them, in which case it keeps the former ones.
    pub fn load(&mut self, tables: &Tables, mut progress: impl FnMut()) -> Result<(), LinkError> {
        let mut last = self.taken(&Request::BuiltIn)?;
        for parcel in tables.parcels::<LINE>() {
            last = self.taken(&Request::Model(parcel))?;
            progress();
        }
        if last == Taken::InUse { Ok(()) } else { Err(unexpected("tables in use", &Reply::Model(Ok(last)))) }
    }

    fn taken(&mut self, request: &Request) -> Result<Taken, LinkError> {
        match self.ask(request)? {
            Reply::Model(taken) => taken.map_err(LinkError::Tables),
            other => Err(unexpected("a word on tables", &other)),
        }
    }

    /// Send bytes as they are.
    ///
    /// # Errors
    /// [`LinkError::Line`] or [`LinkError::Stuck`].
    pub fn write(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        // not flushed: that waits until a serial line has sent all, which one that was pulled out never does
        let (mut rest, deadline) = (bytes, Instant::now() + PATIENCE);
        while !rest.is_empty() {
            match self.line.write(rest) {
                Ok(0) => return Err(LinkError::Closed),
                Ok(n) => rest = &rest[n..],
                Err(error) if !is_lull(&error) => return Err(broken(error)),
                Err(_) if Instant::now() >= deadline => return Err(LinkError::Stuck { seconds: PATIENCE.as_secs() }),
                Err(_) => {}
            }
        }
        Ok(())
    }

    /// Send a request; returns its number.
    ///
    /// # Errors
    /// [`LinkError`].
    pub fn send(&mut self, request: &Request) -> Result<u32, LinkError> {
        self.number = self.number.checked_add(1).unwrap_or(UNASKED + 1);
        let mut bytes = [0; PACKET];
        let n = request.encode(self.number, &mut bytes)?;
        self.write(&bytes[..n])?;
        Ok(self.number)
    }

    /// Send a request and wait for its reply; replies to others are skipped.
    fn ask(&mut self, request: &Request) -> Result<Reply, LinkError> {
        let number = self.send(request)?;
        self.reply_to(number, Instant::now() + PATIENCE)
    }

    fn reply_to(&mut self, number: u32, deadline: Instant) -> Result<Reply, LinkError> {
        loop {
            let (of, reply) = self.next_before(deadline, PATIENCE)?;
            if of == number {
                return Ok(reply);
            }
        }
    }

    /// Wait for the next reply, and the number of its request.
    ///
    /// # Errors
    /// [`LinkError`].
    #[allow(clippy::should_implement_trait)] // an iterator that ends with the first error would hide it
    pub fn next(&mut self) -> Result<(u32, Reply), LinkError> {
        self.next_before(Instant::now() + PATIENCE, PATIENCE)
    }

    /// Wait for the next reply until a deadline, after some `patience`.
    fn next_before(&mut self, deadline: Instant, patience: Duration) -> Result<(u32, Reply), LinkError> {
        loop {
            if let Some(end) = self.received.iter().position(|byte| *byte == 0) {
                let mut packet: Vec<u8> = self.received.drain(..=end).collect();
                if packet.len() > 1 {
                    let (number, reply) = Reply::decode(&mut packet);
                    return Ok((number, reply?));
                }
                continue;
            }
            let got = self.received.len();
            if got > PACKET {
                self.received.clear();
                return Err(FrameError::Oversized { limit: PACKET, got }.into());
            }
            if Instant::now() >= deadline {
                return Err(LinkError::Silent { seconds: patience.as_secs() });
            }
            let mut bytes = [0; 4096];
            match self.line.read(&mut bytes) {
                Ok(0) => return Err(LinkError::Closed),
                Ok(n) => self.received.extend_from_slice(&bytes[..n]),
                Err(error) if is_lull(&error) => {}
                Err(error) => return Err(broken(error)),
            }
        }
    }
}

/// True if no byte could be read or written, and the next one may be.
fn is_lull(error: &io::Error) -> bool {
    use io::ErrorKind::{Interrupted, TimedOut, WouldBlock};
    matches!(error.kind(), Interrupted | TimedOut | WouldBlock)
}

/// Why a line is of no more use.
fn broken(error: io::Error) -> LinkError {
    use io::ErrorKind::{BrokenPipe, ConnectionReset};
    if matches!(error.kind(), BrokenPipe | ConnectionReset) { LinkError::Closed } else { LinkError::Line(error) }
}

fn unexpected(expected: &'static str, found: &Reply) -> LinkError {
    LinkError::Unexpected { expected, found: format!("{found:?}").chars().take(60).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pair() -> (Link<UnixStream>, UnixStream) {
        let (line, device) = UnixStream::pair().unwrap();
        line.set_read_timeout(Some(GLANCE)).unwrap();
        (Link::new(line), device)
    }

    fn sealed(reply: &Reply) -> Vec<u8> {
        let mut bytes = vec![0; PACKET];
        let n = reply.encode(UNASKED, &mut bytes).unwrap();
        bytes.truncate(n);
        bytes
    }

    #[test]
    fn a_silent_device_is_named() {
        let (mut link, device) = pair();
        let error = link.listen().unwrap_err();
        assert_eq!(error.to_string(), "the device has not said what was due for 1 s");
        drop(device);
        assert!(matches!(link.listen(), Err(LinkError::Closed)));
    }

    #[test]
    fn others_who_talk_do_not_hold_up_a_deadline() {
        let (mut link, mut device) = pair();
        let others = std::thread::spawn(move || {
            while device.write_all(&sealed(&Reply::SequenceForgotten)).is_ok() {
                std::thread::sleep(GLANCE / 4);
            }
        });
        assert!(matches!(link.listen(), Err(LinkError::Silent { seconds: 1 })));
        drop(link);
        others.join().unwrap();
    }

    #[test]
    fn noise_is_not_kept_and_the_reply_after_it_is_heard() {
        let (mut link, mut device) = pair();
        device.write_all(&[7; PACKET + 4096]).unwrap();
        assert!(matches!(link.next(), Err(LinkError::Reply(FrameError::Oversized { .. }))));
        device.write_all(&[0]).unwrap();
        device.write_all(&sealed(&Reply::Restarted)).unwrap();
        let mut next = link.next();
        while let Err(LinkError::Reply(_)) = next {
            next = link.next(); // the rest of it
        }
        assert_eq!(next.unwrap(), (UNASKED, Reply::Restarted));
        assert!(link.received.is_empty());
    }
}
