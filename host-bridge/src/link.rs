//! The host's end of a device's line: requests and frames out, replies in.

use core::fmt;
use core::str::FromStr;
use core::time::Duration;
use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::os::unix::net::UnixStream;

use estimator::booster::Green;
use estimator::surrogate::ParcelError;
use estimator::{FrameError, Setup, packet};
use firmware_sim::link::{Refusal, Reply, Request, Status, TRIANGLE, Taken};
use inference::stream::BoosterEstimate;

/// Longest silence while an answer is due.
const PATIENCE: Duration = Duration::from_secs(10);
/// Rate of a serial line where none is given [baud].
const BAUD: u32 = 921_600;

/// Where a device is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Source {
    /// `tcp://HOST:PORT`
    Tcp(String),
    /// `unix:PATH`
    Unix(String),
    /// `serial:PATH[@BAUD]`
    Serial(String, u32),
}

impl FromStr for Source {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("expected tcp://HOST:PORT, unix:PATH or serial:PATH[@BAUD], found {text:?}");
        let (scheme, rest) = text.split_once(':').filter(|(_, rest)| !rest.is_empty()).ok_or_else(wrong)?;
        match scheme {
            "tcp" => match rest.strip_prefix("//") {
                Some(address) if address.contains(':') => Ok(Self::Tcp(address.to_owned())),
                _ => Err(wrong()),
            },
            "unix" => Ok(Self::Unix(rest.to_owned())),
            "serial" => {
                let (path, baud) = rest.split_once('@').unwrap_or((rest, ""));
                let baud = if baud.is_empty() { Ok(BAUD) } else { baud.parse().map_err(|_| wrong()) };
                Ok(Self::Serial(path.to_owned(), baud?))
            }
            _ => Err(wrong()),
        }
    }
}

impl fmt::Display for Source {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tcp(address) => write!(f, "tcp://{address}"),
            Self::Unix(path) => write!(f, "unix:{path}"),
            Self::Serial(path, baud) => write!(f, "serial:{path}@{baud}"),
        }
    }
}

/// What goes wrong on the line.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LinkError {
    /// Nobody is there.
    #[error("{device}: {error}")]
    Open {
        /// Where.
        device: Source,
        /// Why.
        error: io::Error,
    },
    /// The line broke, or nothing came while an answer was due.
    #[error("the device's line: {0}")]
    Line(#[from] io::Error),
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
    #[error("the device did not take the tables: {0:?}")]
    Tables(ParcelError),
}

/// An estimate of a device, with the covariance if that was asked for.
#[derive(Debug, Clone, PartialEq)]
pub struct Heard {
    /// The estimate.
    pub estimate: BoosterEstimate,
    /// Covariance of `theta = ln var`, lower triangle row by row.
    pub covariance: Option<Box<[f32; TRIANGLE]>>,
}

impl LinkError {
    /// True if the line is sound, and only nothing came.
    pub fn is_silence(&self) -> bool {
        let silent = |error: &io::Error| matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut);
        matches!(self, Self::Line(error) if silent(error))
    }
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
}

impl Link<Box<dyn Line>> {
    /// Connect to a device.
    ///
    /// # Errors
    /// [`LinkError::Open`].
    pub fn open(source: &Source) -> Result<Self, LinkError> {
        let line = connect(source).map_err(|error| LinkError::Open { device: source.clone(), error })?;
        Ok(Self::new(line))
    }
}

fn connect(source: &Source) -> io::Result<Box<dyn Line>> {
    Ok(match source {
        Source::Tcp(address) => {
            let line = TcpStream::connect(address)?;
            line.set_nodelay(true)?;
            line.set_read_timeout(Some(PATIENCE))?;
            Box::new(line)
        }
        Source::Unix(path) => {
            let line = UnixStream::connect(path)?;
            line.set_read_timeout(Some(PATIENCE))?;
            Box::new(line)
        }
        Source::Serial(path, baud) => Box::new(serialport::new(path, *baud).timeout(PATIENCE).open()?),
    })
}

impl<L: Read + Write> Link<L> {
    /// A device on a line that is open already.
    pub fn new(line: L) -> Self {
        Self { line, received: Vec::new() }
    }

    /// Let the device begin at the prior.
    ///
    /// # Errors
    /// [`LinkError`].
    pub fn restart(&mut self, setup: &Setup) -> Result<(), LinkError> {
        // a zero first: half a packet of somebody before us may be waiting
        self.write(&[0])?;
        self.send(&Request::Restart(*setup))?;
        loop {
            match self.next()? {
                Reply::Restarted => return Ok(()),
                Reply::Refused { why: Refusal::Setup, .. } => {
                    return Err(LinkError::Refused { what: "its setup", why: Refusal::Setup });
                }
                _ => {} // answers to somebody before us
            }
        }
    }

    /// Send a frame and wait for its answer, with the covariance.
    ///
    /// # Errors
    /// [`LinkError`].
    pub fn ingest(&mut self, wire: &[u8]) -> Result<Heard, LinkError> {
        self.send(&Request::Covariance)?;
        self.write(wire)?;
        self.listen()
    }

    /// Wait for an estimate, and for its covariance if that follows.
    ///
    /// # Errors
    /// [`LinkError`].
    pub fn listen(&mut self) -> Result<Heard, LinkError> {
        let estimate = |reply| match reply {
            Reply::Estimate(answer) => answer.estimate().ok_or(LinkError::Reply(FrameError::Malformed)),
            Reply::Refused { why, .. } => Err(LinkError::Refused { what: "a frame", why }),
            other => Err(unexpected("an estimate", &other)),
        };
        let mut estimate_so_far = estimate(self.next()?)?;
        let mut covariance = Box::new([0.0; TRIANGLE]);
        let mut place = 0;
        while place < TRIANGLE {
            match self.next()? {
                Reply::Covariance { sequence, first, entries }
                    if sequence == estimate_so_far.sequence && usize::from(first) == place && !entries.is_empty() =>
                {
                    let room = covariance.iter_mut().skip(place);
                    room.zip(&entries).for_each(|(to, entry)| *to = *entry);
                    place += entries.len();
                }
                // the frame of that estimate came before the request: the covariance follows this one
                newer if place == 0 => estimate_so_far = estimate(newer)?,
                other => return Err(unexpected("the rest of a covariance", &other)),
            }
        }
        Ok(Heard { estimate: estimate_so_far, covariance: Some(covariance) })
    }

    /// How the device is.
    ///
    /// # Errors
    /// [`LinkError`].
    pub fn status(&mut self) -> Result<Status, LinkError> {
        self.send(&Request::Status)?;
        match self.next()? {
            Reply::Status(status) => Ok(status),
            other => Err(unexpected("its status", &other)),
        }
    }

    /// Put other tables in use; `progress` hears of each of their parts.
    ///
    /// # Errors
    /// [`LinkError::Tables`] if the device did not take them, in which case it goes by the former ones.
    pub fn load(&mut self, tables: &Green, mut progress: impl FnMut()) -> Result<(), LinkError> {
        self.send(&Request::BuiltIn)?;
        self.taken()?;
        let mut last = Taken::BuiltIn;
        for parcel in tables.parcels() {
            self.send(&Request::Model(parcel))?;
            last = self.taken()?;
            progress();
        }
        if last == Taken::InUse { Ok(()) } else { Err(unexpected("tables in use", &Reply::Model(Ok(last)))) }
    }

    fn taken(&mut self) -> Result<Taken, LinkError> {
        match self.next()? {
            Reply::Model(taken) => taken.map_err(LinkError::Tables),
            other => Err(unexpected("a word on tables", &other)),
        }
    }

    /// Send bytes as they are.
    ///
    /// # Errors
    /// [`LinkError::Line`].
    pub fn write(&mut self, bytes: &[u8]) -> Result<(), LinkError> {
        self.line.write_all(bytes)?;
        Ok(self.line.flush()?)
    }

    /// Send a request.
    ///
    /// # Errors
    /// [`LinkError`].
    pub fn send(&mut self, request: &Request) -> Result<(), LinkError> {
        let mut bytes = [0; packet::MAX_WIRE_BYTES];
        let n = request.encode(&mut bytes)?;
        self.write(&bytes[..n])
    }

    /// Wait for the next reply.
    ///
    /// # Errors
    /// [`LinkError`].
    #[allow(clippy::should_implement_trait)] // an iterator that ends with the first error would hide it
    pub fn next(&mut self) -> Result<Reply, LinkError> {
        loop {
            if let Some(end) = self.received.iter().position(|byte| *byte == 0) {
                let mut packet: Vec<u8> = self.received.drain(..=end).collect();
                if packet.len() > 1 {
                    return Ok(Reply::decode(&mut packet)?);
                }
                continue;
            }
            let mut bytes = [0; 4096];
            match self.line.read(&mut bytes) {
                Ok(0) => return Err(LinkError::Closed),
                Ok(n) => self.received.extend_from_slice(&bytes[..n]),
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(error.into()),
            }
        }
    }
}

fn unexpected(expected: &'static str, found: &Reply) -> LinkError {
    LinkError::Unexpected { expected, found: format!("{found:?}").chars().take(60).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sources_are_tcp_unix_or_serial() {
        assert_eq!("tcp://localhost:5000".parse(), Ok(Source::Tcp("localhost:5000".into())));
        assert_eq!("unix:/run/device".parse(), Ok(Source::Unix("/run/device".into())));
        assert_eq!("serial:/dev/ttyACM0".parse(), Ok(Source::Serial("/dev/ttyACM0".into(), 921_600)));
        assert_eq!("serial:/dev/ttyS1@115200".parse(), Ok(Source::Serial("/dev/ttyS1".into(), 115_200)));
        for wrong in ["", "tcp:localhost:5000", "tcp://localhost", "unix:", "serial:/dev/ttyS1@fast", "usb:1"] {
            let error = wrong.parse::<Source>().unwrap_err();
            assert!(error.ends_with(&format!("found {wrong:?}")), "{error}");
        }
        let shown = "serial:/dev/ttyS1@115200";
        assert_eq!(shown.parse::<Source>().unwrap().to_string(), shown);
    }
}
