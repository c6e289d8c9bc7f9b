//! The running emulator: one image, its UART as a socket, its log from standard output.

use core::time::Duration;
use std::io::{self, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread::{self, JoinHandle};
use std::time::Instant;

use tempfile::TempDir;

use super::counts::{Counts, Plugin};
use super::{Error, Function, Image};

/// The emulator opens its sockets in well under a second; a busy machine may take longer.
const START: Duration = Duration::from_secs(120);

/// Time to end after it was asked to.
const STOP: Duration = Duration::from_secs(120);

/// Longest silence of the UART: a test fails, rather than waiting for ever.
const SILENCE: Duration = Duration::from_secs(120);

const PAUSE: Duration = Duration::from_millis(5);

/// What is done besides running the image.
#[derive(Debug, Clone, Default)]
pub struct Options {
    /// Functions whose instructions are counted; none, and nothing is counted.
    pub regions: Vec<Function>,
    /// Further arguments of the emulator.
    pub arguments: Vec<String>,
}

/// A run that has ended.
#[derive(Debug)]
pub struct Run {
    /// Exit status; none if a signal ended it.
    pub status: Option<i32>,
    /// What the image wrote by semihosting: its log, see [`Image::log`].
    pub stdout: Vec<u8>,
    /// Messages of the emulator itself.
    pub stderr: String,
    /// Instructions of each region.
    pub counts: Counts,
}

/// An emulator that runs an image. Dropping it kills it.
#[derive(Debug)]
pub struct Emulator {
    child: Child,
    uart: UnixStream,
    monitor: UnixStream,
    stdout: Option<JoinHandle<Vec<u8>>>,
    stderr: Option<JoinHandle<Vec<u8>>>,
    plugin: Option<Plugin>,
    _folder: TempDir, // the sockets and the reports lie there until the end
}

impl Emulator {
    /// Start an image; it runs as soon as its UART is connected.
    ///
    /// # Errors
    /// If the emulator is not installed or does not start.
    pub fn start(image: &Image, options: &Options) -> Result<Self, Error> {
        let folder = TempDir::new()?;
        let plugin = match options.regions.as_slice() {
            [] => None,
            regions => Some(Plugin::build(folder.path(), regions)?),
        };
        let mut command = command(image, folder.path());
        if let Some(plugin) = &plugin {
            command.arg("-plugin").arg(plugin.argument(&image.handlers()?));
        }
        command.args(&options.arguments);
        let child = command.spawn().map_err(Error::starting("qemu-system-arm"))?;
        Self::connect(child, plugin, folder)
    }

    fn connect(mut child: Child, plugin: Option<Plugin>, folder: TempDir) -> Result<Self, Error> {
        let (stdout, stderr) = (capture(child.stdout.take()), capture(child.stderr.take()));
        match connect(&mut child, &socket(folder.path(), "uart"), &socket(folder.path(), "monitor")) {
            Ok((uart, monitor)) => Ok(Self { child, uart, monitor, stdout, stderr, plugin, _folder: folder }),
            Err(error) => {
                kill(&mut child);
                let stderr = String::from_utf8_lossy(&collect(stderr)).into_owned();
                Err(Error::Failed { program: "qemu-system-arm", stderr: format!("{stderr}{error}") })
            }
        }
    }

    /// The other end of the UART. `&UnixStream` reads and writes; either fails after 30 s of silence.
    ///
    /// The emulator knows no baud rate: bytes arrive as fast as they are written and the image takes them.
    pub fn uart(&self) -> &UnixStream {
        &self.uart
    }

    /// Let the program stand still for a while, as a busy host does; the clock of its timers goes on.
    ///
    /// # Errors
    /// If no signal can be sent.
    pub fn freeze(&self, time: Duration) -> Result<(), Error> {
        self.signal("STOP")?;
        thread::sleep(time);
        self.signal("CONT")
    }

    fn signal(&self, signal: &str) -> Result<(), Error> {
        let line = format!("kill -{signal} {}", self.child.id());
        let output = Command::new("sh").arg("-c").arg(line).output().map_err(Error::starting("sh"))?;
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        if output.status.success() { Ok(()) } else { Err(Error::Failed { program: "kill", stderr }) }
    }

    /// End the run now.
    ///
    /// # Errors
    /// If it does not end, or its counts cannot be read.
    pub fn stop(self) -> Result<Run, Error> {
        let _ = (&self.monitor).write_all(b"quit\n"); // it may have ended by itself
        self.wait(STOP)
    }

    /// Wait for the image to end by itself.
    ///
    /// # Errors
    /// If it does not in time, or its counts cannot be read.
    pub fn wait(mut self, limit: Duration) -> Result<Run, Error> {
        let end = Instant::now() + limit;
        while self.child.try_wait()?.is_none() {
            if Instant::now() > end {
                return Err(Error::Running(limit.as_secs_f32()));
            }
            thread::sleep(PAUSE);
        }
        let status = self.child.wait()?.code();
        let (stdout, stderr) = (collect(self.stdout.take()), collect(self.stderr.take()));
        let counts = self.plugin.as_ref().map_or(Ok(Counts::new()), Plugin::counts)?;
        Ok(Run { status, stdout, stderr: String::from_utf8_lossy(&stderr).into_owned(), counts })
    }
}

impl Drop for Emulator {
    fn drop(&mut self) {
        kill(&mut self.child);
    }
}

fn kill(child: &mut Child) {
    let _ = child.kill(); // it may have ended by itself
    let _ = child.wait();
}

fn command(image: &Image, folder: &Path) -> Command {
    let (uart, monitor) = (socket(folder, "uart"), socket(folder, "monitor"));
    let mut command = Command::new("qemu-system-arm");
    command.args(["-M", "mps2-an500", "-display", "none", "-semihosting-config", "enable=on,target=native"]);
    command.arg("-serial").arg(format!("unix:{},server=on,wait=on", uart.display()));
    command.arg("-monitor").arg(format!("unix:{},server=on,wait=off", monitor.display()));
    command.arg("-kernel").arg(image.path());
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

fn socket(folder: &Path, name: &str) -> PathBuf {
    folder.join(name)
}

/// Connect to UART and monitor, in the order in which the emulator waits for them.
fn connect(child: &mut Child, uart: &Path, monitor: &Path) -> io::Result<(UnixStream, UnixStream)> {
    let (uart, monitor) = (connect_one(child, uart)?, connect_one(child, monitor)?);
    uart.set_read_timeout(Some(SILENCE))?;
    uart.set_write_timeout(Some(SILENCE))?;
    Ok((uart, monitor))
}

/// Connect to a socket that the emulator is about to open.
fn connect_one(child: &mut Child, socket: &Path) -> io::Result<UnixStream> {
    let end = Instant::now() + START;
    loop {
        match UnixStream::connect(socket) {
            Err(_) if Instant::now() < end && child.try_wait()?.is_none() => thread::sleep(PAUSE),
            result => return result,
        }
    }
}

/// Read a pipe to its end, beside the test: one that is full would stop the emulator.
fn capture(pipe: Option<impl Read + Send + 'static>) -> Option<JoinHandle<Vec<u8>>> {
    let mut pipe = pipe?;
    Some(thread::spawn(move || {
        let mut bytes = Vec::new();
        let _ = pipe.read_to_end(&mut bytes); // what has arrived is kept
        bytes
    }))
}

fn collect(captured: Option<JoinHandle<Vec<u8>>>) -> Vec<u8> {
    captured.and_then(|thread| thread.join().ok()).unwrap_or_default()
}
