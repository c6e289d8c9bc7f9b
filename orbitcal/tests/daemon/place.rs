//! A daemon in a folder of its own, and frames for it.

use core::iter;
use core::sync::atomic::{AtomicU16, Ordering};
use core::time::Duration;
use std::fs;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::thread;
use std::time::Instant;

use inference::Recording;
use inference::stream::{self, Core};
use results::EstimateRecord;
use shared_memory::Subscriber;
use twin::Ring;

pub const RECORDING: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../recordings/paper-vars");
/// Longest wait for anything.
pub const SOON: Duration = Duration::from_secs(60);

/// A daemon's folder, configuration and service.
pub struct Place {
    pub folder: tempfile::TempDir,
    pub service: String,
}

impl Place {
    /// Its line may be silent for as long as anything is waited for: a machine that is busy pauses for seconds.
    pub fn new(test: &str, address: &str, role: &str, more: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let service = format!("orbitcal/test/{}/{test}", std::process::id());
        let text = format!(
            "[machine]\nrecording = {RECORDING:?}\n[source]\naddress = {address:?}\nrole = {role:?}\ntimeout_ms = 60000\n\
             backoff_first_ms = 10\nbackoff_most_ms = 50\n[publish]\nservice = {service:?}\n[checkpoint]\nfile = \"checkpoint\"\n{more}"
        );
        fs::write(folder.path().join("config.toml"), text).unwrap();
        Self { folder, service }
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Add lines to the section of the source.
    pub fn append_to_source(&self, lines: &str) {
        self.change("[publish]", &format!("{lines}[publish]"));
    }

    /// Replace words of the configuration where they first stand.
    pub fn change(&self, from: &str, to: &str) {
        let config = self.path("config.toml");
        let text = fs::read_to_string(&config).unwrap();
        fs::write(&config, text.replacen(from, to, 1)).unwrap();
    }

    /// A daemon there; what it says is added to the file `said`.
    pub fn start(&self) -> Daemon {
        let said = fs::File::options().create(true).append(true).open(self.path("said")).unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_orbitcal"));
        command.arg("serve").arg(self.path("config.toml")).stdin(Stdio::null()).stderr(said);
        Daemon(command.spawn().unwrap())
    }

    /// Another reader of its estimates.
    pub fn watch(&self) -> Daemon {
        let mut command = Command::new(env!("CARGO_BIN_EXE_orbitcal"));
        command.args(["watch", "--quiet", "--service", &self.service]).stdin(Stdio::null()).stdout(Stdio::null());
        Daemon(command.spawn().unwrap())
    }

    pub fn said(&self) -> String {
        fs::read_to_string(self.path("said")).unwrap()
    }

    /// Wait until the daemon has said something.
    pub fn hear(&self, words: &str) {
        let start = Instant::now();
        while !self.said().contains(words) {
            assert!(start.elapsed() < SOON, "{words:?} was not said: {}", self.said());
            thread::sleep(Duration::from_millis(5));
        }
    }
}

/// A process that is killed if a test fails before its end.
pub struct Daemon(pub Child);

impl Daemon {
    /// SIGKILL.
    pub fn kill(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }

    /// SIGTERM; returns how long the end took.
    pub fn stop(&mut self) -> Duration {
        let start = Instant::now();
        assert!(Command::new("kill").arg(self.0.id().to_string()).status().unwrap().success());
        assert!(self.0.wait().unwrap().success());
        start.elapsed()
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        self.kill();
    }
}

/// Frames of a recording again and again, at 1 kHz by their time stamps.
pub struct Frames {
    pub ring: Ring,
    pub recording: Recording,
}

impl Frames {
    pub fn new() -> Self {
        let ring = Ring::booster();
        let recording = Recording::read(Path::new(RECORDING), &ring).unwrap();
        Self { ring, recording }
    }

    pub fn wire(&self, sequence: u32) -> Vec<u8> {
        let mut row = self.recording.rows[sequence as usize % self.recording.rows.len()].clone();
        (row.sequence, row.time) = (sequence, 1e-3 * f64::from(sequence));
        stream::wire(&self.recording, &row).unwrap()
    }

    /// The core as the daemon has it.
    pub fn core(&self) -> Core {
        let powered = self.recording.powered(&self.ring);
        let setup = stream::setup(&powered, &self.recording, stream::FOLLOW).unwrap();
        Core::with_tables(training::green::tables(&powered).unwrap(), setup).unwrap()
    }
}

/// A port that no other call is given, below those that Linux gives to clients: nobody takes it before it is used.
pub fn port() -> u16 {
    static GIVEN: AtomicU16 = AtomicU16::new(0);
    let first = 20_000 + 100 * (std::process::id() % 120) as u16;
    let is_free = |port: &u16| TcpListener::bind(("127.0.0.1", *port)).is_ok();
    iter::repeat_with(|| first + GIVEN.fetch_add(1, Ordering::Relaxed)).find(is_free).unwrap()
}

/// What a program has said, and how it ended, where that is not as expected.
pub fn told(output: &Output) -> String {
    let [out, err] = [&output.stdout, &output.stderr].map(|said| String::from_utf8_lossy(said));
    format!("{}\nstdout: {out}\nstderr: {err}", output.status)
}

pub fn listening(subscriber: &mut Subscriber, until: usize) -> Vec<EstimateRecord> {
    let (start, mut heard) = (Instant::now(), Vec::new());
    while heard.len() < until {
        assert!(start.elapsed() < SOON, "{} of {until} estimates", heard.len());
        heard.extend(subscriber.wait(Duration::from_millis(20)).unwrap().into_iter().map(|each| each.record));
    }
    heard
}

pub fn connected<S>(connect: impl Fn() -> std::io::Result<S>) -> S {
    let start = Instant::now();
    loop {
        match connect() {
            Ok(stream) => return stream,
            Err(error) => assert!(start.elapsed() < SOON, "{error}"),
        }
        thread::sleep(Duration::from_millis(5));
    }
}

/// Numbers as their bits: a comparison that sees the sign of a zero.
pub fn bits(values: &[&Vec<f32>]) -> Vec<u32> {
    values.iter().copied().flatten().map(|value| value.to_bits()).collect()
}
