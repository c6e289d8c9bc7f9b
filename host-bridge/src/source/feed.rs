//! Raw frames from a TCP or unix socket, a serial line or a process, on a thread of its own: it connects, listens or starts, again and again, and reads into a [`Queue`].

use core::time::Duration;
use std::fs;
use std::io::{self, ErrorKind, Read};
use std::net::{TcpListener, TcpStream, ToSocketAddrs};
use std::os::unix::fs::FileTypeExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::thread;
use std::time::Instant;

use results::output::{tell, warn};
use serialport::SerialPort;

use super::address::Address;
use super::program::{Program, Running};
use super::queue::Queue;
use super::splitter::Splitter;
use crate::config::{Role, Source, WhenFull};
use crate::stop::Stop;

/// Longest wait in the system before somebody's wish to stop is looked at.
const GLANCE: Duration = Duration::from_millis(50);
/// Longest wait for a TCP connection.
const CONNECT: Duration = Duration::from_millis(500);
/// Bytes of one read.
const READ: usize = 64 << 10;

/// A connected line.
trait Stream: Read + Send {
    /// A read waits so long at most.
    fn glance(&self) -> io::Result<()>;
}

impl Stream for TcpStream {
    fn glance(&self) -> io::Result<()> {
        self.set_read_timeout(Some(GLANCE))
    }
}

impl Stream for UnixStream {
    fn glance(&self) -> io::Result<()> {
        self.set_read_timeout(Some(GLANCE))
    }
}

impl Stream for Running {
    fn glance(&self) -> io::Result<()> {
        self.line.glance()
    }
}

impl Stream for Box<dyn SerialPort> {
    fn glance(&self) -> io::Result<()> {
        // it was opened with this time
        Ok(())
    }
}

/// Where connections come from.
enum Door {
    Connect(Address),
    Program(Program),
    Tcp(TcpListener),
    Unix(UnixListener),
}

impl Door {
    fn open(role: Role, address: &Address) -> io::Result<Self> {
        match (role, address) {
            // a serial line is opened, whoever is at its other end
            (Role::Connect, address) | (Role::Listen, address @ Address::Serial(..)) => {
                Ok(Self::Connect(address.clone()))
            }
            (Role::Listen, Address::Tcp(address)) => TcpListener::bind(address).map(Self::Tcp),
            (Role::Listen, Address::Unix(path)) => bind(Path::new(path)).map(Self::Unix),
        }
    }

    /// The next connection; one that listens waits for it.
    fn next(&self) -> io::Result<Box<dyn Stream>> {
        let stream: io::Result<Box<dyn Stream>> = match self {
            Self::Connect(Address::Tcp(address)) => connect(address).map(|stream| Box::new(stream) as _),
            Self::Connect(Address::Unix(path)) => UnixStream::connect(path).map(|stream| Box::new(stream) as _),
            Self::Connect(Address::Serial(path, baud)) => serial(path, *baud).map(|line| Box::new(line) as _),
            Self::Program(program) => program.start().map(|running| Box::new(running) as _),
            Self::Tcp(listener) => listener.accept().map(|(stream, _)| Box::new(stream) as _),
            Self::Unix(listener) => listener.accept().map(|(stream, _)| Box::new(stream) as _),
        };
        let stream = stream?;
        stream.glance()?;
        Ok(stream)
    }
}

/// Listen on a path; a socket that a killed process has left there, to which nobody listens, is replaced.
fn bind(path: &Path) -> io::Result<UnixListener> {
    let is_socket = fs::symlink_metadata(path).is_ok_and(|meta| meta.file_type().is_socket());
    let refused = || UnixStream::connect(path).is_err_and(|error| error.kind() == ErrorKind::ConnectionRefused);
    if is_socket && refused() {
        fs::remove_file(path)?;
    }
    UnixListener::bind(path)
}

fn serial(path: &str, baud: u32) -> io::Result<Box<dyn SerialPort>> {
    Ok(serialport::new(path, baud).timeout(GLANCE).open()?)
}

fn connect(address: &str) -> io::Result<TcpStream> {
    let mut last = io::Error::new(ErrorKind::NotFound, "the name has no address");
    for address in address.to_socket_addrs()? {
        match TcpStream::connect_timeout(&address, CONNECT) {
            Ok(stream) => return Ok(stream),
            Err(error) => last = error,
        }
    }
    Err(last)
}

/// Read frames of at most `most` bytes into a queue until somebody asks to stop.
///
/// # Errors
/// What the system says of a socket on which the daemon is to listen.
pub fn start(source: &Source, address: &Address, most: usize, queue: &Queue, stop: &Stop) -> io::Result<()> {
    start_at(Door::open(source.role, address)?, source, most, queue, stop)
}

/// Read the frames of a process, which is started again whenever it ends.
///
/// # Errors
/// What the system says of a new thread.
pub fn start_program(program: Program, source: &Source, most: usize, queue: &Queue, stop: &Stop) -> io::Result<()> {
    start_at(Door::Program(program), source, most, queue, stop)
}

fn start_at(door: Door, source: &Source, most: usize, queue: &Queue, stop: &Stop) -> io::Result<()> {
    let reader = Reader {
        door,
        source: source.clone(),
        splitter: Splitter::new(most),
        queue: queue.clone(),
        stop: stop.clone(),
    };
    // not joined: the process does not wait until somebody connects
    thread::Builder::new().name("source".into()).spawn(move || reader.run())?;
    Ok(())
}

struct Reader {
    door: Door,
    source: Source,
    splitter: Splitter,
    queue: Queue,
    stop: Stop,
}

impl Reader {
    fn run(mut self) {
        let [first, most] = self.source.backoff();
        let (mut wait, mut failure) = (first, String::new());
        while !self.stop.is_requested() {
            let connected = self.door.next();
            // the next one comes by itself
            let is_called = connected.is_ok() && matches!(self.door, Door::Tcp(_) | Door::Unix(_));
            match connected {
                Ok(stream) => {
                    tell(format_args!("{}: connected", self.source.address));
                    let had_frames = self.read(stream);
                    // somebody who accepts and hangs up is not asked at once again
                    wait = if had_frames { first } else { wait };
                    failure.clear();
                }
                // said once, not at each attempt
                Err(error) if failure != error.to_string() => {
                    failure = error.to_string();
                    warn(format_args!("{}: {failure}; tried again until it works", self.source.address));
                }
                Err(_) => {}
            }
            if !is_called {
                self.stop.sleep_until(Instant::now() + wait);
                wait = (2 * wait).min(most.max(first));
            }
        }
    }

    /// Read a connection to its end; true if there was a packet.
    fn read(&mut self, mut stream: Box<dyn Stream>) -> bool {
        let (mut bytes, mut heard, mut had_frames) = (vec![0; READ], Instant::now(), false);
        let why = loop {
            if self.stop.is_requested() {
                return had_frames;
            }
            match stream.read(&mut bytes) {
                Ok(0) => break "closed by the other end".to_owned(),
                Ok(length) => {
                    heard = Instant::now();
                    let long = self.splitter.push(&bytes[..length], |frame| {
                        had_frames = true;
                        match self.source.when_full {
                            WhenFull::Drop => self.queue.push(frame),
                            WhenFull::Wait => self.queue.push_patiently(frame, &self.stop),
                        }
                    });
                    self.queue.count(|faults| faults.damaged += long);
                }
                Err(error) if is_pause(&error) && heard.elapsed() < self.source.timeout() => {}
                Err(error) if is_pause(&error) => break format!("silent for {} ms", heard.elapsed().as_millis()),
                Err(error) => break error.to_string(),
            }
        };
        let is_cut = self.splitter.end();
        self.queue.count(|faults| {
            faults.disconnected += 1;
            faults.damaged += u64::from(is_cut);
        });
        warn(format_args!("{}: connection lost: {why}", self.source.address));
        had_frames
    }
}

fn is_pause(error: &io::Error) -> bool {
    [ErrorKind::WouldBlock, ErrorKind::TimedOut, ErrorKind::Interrupted].contains(&error.kind())
}
