//! `orbitcal serve CONFIG.toml` as operators run it: a process fed through a socket, read through shared memory, and killed.

use core::time::Duration;
use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::net::{TcpListener, TcpStream};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::Instant;

use host_bridge::record::{EstimateRecord, Names};
use host_bridge::sink::shared_memory::{Published, Subscriber};
use inference::Recording;
use inference::stream::{self, Core};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use twin::Ring;

const RECORDING: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../recordings/paper-vars");
const SOON: Duration = Duration::from_secs(20);

/// A daemon's folder, configuration and service.
struct Place {
    folder: tempfile::TempDir,
    service: String,
}

impl Place {
    fn new(test: &str, address: &str, role: &str, more: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let service = format!("orbitcal/test/{}/{test}", std::process::id());
        let text = format!(
            "[machine]\nrecording = {RECORDING:?}\n[source]\naddress = {address:?}\nrole = {role:?}\ntimeout_ms = 1000\n\
             backoff_first_ms = 10\nbackoff_most_ms = 50\n[publish]\nservice = {service:?}\n[checkpoint]\nfile = \"checkpoint\"\n{more}"
        );
        fs::write(folder.path().join("config.toml"), text).unwrap();
        Self { folder, service }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// A daemon there; what it says is added to the file `said`.
    fn start(&self) -> Daemon {
        let said = fs::File::options().create(true).append(true).open(self.path("said")).unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_orbitcal"));
        command.arg("serve").arg(self.path("config.toml")).stdin(Stdio::null()).stderr(said);
        Daemon(command.spawn().unwrap())
    }

    fn said(&self) -> String {
        fs::read_to_string(self.path("said")).unwrap()
    }

    /// Wait until the daemon has said something.
    fn hear(&self, words: &str) {
        let start = Instant::now();
        while !self.said().contains(words) {
            assert!(start.elapsed() < SOON, "{words:?} was not said: {}", self.said());
            thread::sleep(Duration::from_millis(5));
        }
    }
}

/// A process that is killed if a test fails before its end.
struct Daemon(Child);

impl Daemon {
    /// SIGKILL.
    fn kill(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }

    /// SIGTERM; returns how long the end took.
    fn stop(&mut self) -> Duration {
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
struct Frames {
    ring: Ring,
    recording: Recording,
}

impl Frames {
    fn new() -> Self {
        let ring = Ring::booster();
        let recording = Recording::read(Path::new(RECORDING), &ring).unwrap();
        Self { ring, recording }
    }

    fn wire(&self, sequence: u32) -> Vec<u8> {
        let mut row = self.recording.rows[sequence as usize % self.recording.rows.len()].clone();
        (row.sequence, row.time) = (sequence, 1e-3 * f64::from(sequence));
        stream::wire(&self.recording, &row).unwrap()
    }

    /// The core as the daemon has it.
    fn core(&self) -> Core {
        let powered = self.recording.powered(&self.ring);
        let setup = stream::setup(&powered, &self.recording, stream::FOLLOW).unwrap();
        Core::with_tables(training::green::tables(&powered).unwrap(), setup).unwrap()
    }
}

/// A port that is free now.
fn port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

fn listening(subscriber: &mut Subscriber, until: usize) -> Vec<EstimateRecord> {
    let (start, mut heard) = (Instant::now(), Vec::new());
    while heard.len() < until {
        assert!(start.elapsed() < SOON, "{} of {until} estimates", heard.len());
        heard.extend(subscriber.wait(Duration::from_millis(20)).unwrap().into_iter().map(|each| each.record));
    }
    heard
}

fn connected<S>(connect: impl Fn() -> std::io::Result<S>) -> S {
    let start = Instant::now();
    loop {
        match connect() {
            Ok(stream) => return stream,
            Err(error) => assert!(start.elapsed() < SOON, "{error}"),
        }
        thread::sleep(Duration::from_millis(5));
    }
}

/// Estimates of one uninterrupted core: those of frames that were in a life which ended, and in no checkpoint, are forgotten.
#[derive(Default)]
struct Survivors {
    records: BTreeMap<u32, EstimateRecord>,
    life: u64,
    /// Frames that each kill has lost.
    lost: Vec<u32>,
}

impl Survivors {
    fn add(&mut self, Published { record, stamp }: Published) {
        if stamp.started_ns != self.life {
            assert!(stamp.started_ns > self.life, "an estimate of a dead daemon after one of the next");
            let gone = self.records.split_off(&record.frames);
            self.lost.extend((self.life > 0).then_some(gone.len() as u32));
            self.life = stamp.started_ns;
        }
        self.records.insert(record.frames, record);
    }
}

/// What processes have left in shared memory, and of its bookkeeping: the upper half of an id holds the process.
fn left_by(processes: &[u32]) -> Vec<String> {
    let is_theirs = |name: &str| {
        let ids = name.split(['_', '.']).filter_map(|part| part.parse::<u128>().ok());
        ids.into_iter().any(|id| processes.contains(&((id >> 64) as u32)))
    };
    let names =
        ["/dev/shm", "/tmp/iceoryx2/nodes"].into_iter().flat_map(|folder| fs::read_dir(folder).into_iter().flatten());
    names.filter_map(|entry| entry.ok()?.file_name().into_string().ok()).filter(|name| is_theirs(name)).collect()
}

/// Twenty kills at random moments (fixed seed) over a feed at 1 kHz: each restart goes on at a checkpoint, and all estimates that survive
/// are those of one core that was fed the surviving frames and never stopped.
#[test]
fn kills_at_random_moments_cost_the_frames_since_a_checkpoint_and_no_bit() {
    const EVERY: u32 = 50;
    let port = port();
    let address = format!("tcp://127.0.0.1:{port}");
    let place = Place::new("kills", &address, "listen", &format!("checkpoint_every_frames = {EVERY}\n"));
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let ends = Arc::new(AtomicBool::new(false));
    let feeder = {
        let ends = ends.clone();
        thread::spawn(move || feed(port, &ends))
    };
    let (mut random, mut survivors, mut processes) = (StdRng::seed_from_u64(17), Survivors::default(), Vec::new());
    for _ in 0..20 {
        let mut daemon = place.start();
        processes.push(daemon.0.id());
        live(&mut subscriber, &mut survivors, Duration::from_millis(random.random_range(1..400)));
        daemon.kill();
    }
    let mut daemon = place.start();
    processes.push(daemon.0.id());
    live(&mut subscriber, &mut survivors, Duration::from_millis(300));
    assert_ne!(left_by(&processes[20..]), [""; 0], "the daemon that lives has shared memory");
    let took = daemon.stop();
    assert!(took < Duration::from_secs(1), "SIGTERM took {took:?}");
    ends.store(true, Ordering::Relaxed);
    feeder.join().unwrap();
    drop(subscriber);
    assert_eq!(left_by(&processes), [""; 0]);
    println!("frames lost by kills: {:?}", survivors.lost);
    assert_eq!(survivors.lost.len(), 20);
    // a checkpoint that is being written at the kill is no whole one
    assert!(survivors.lost.iter().all(|lost| *lost <= 2 * EVERY), "{:?}", survivors.lost);
    expect_one_core(&survivors);
}

/// Send frames at 1 kHz to whoever listens, from 1 on; what nobody takes is lost.
fn feed(port: u16, ends: &AtomicBool) {
    let (frames, start, mut stream) = (Frames::new(), Instant::now(), None);
    for sequence in 1.. {
        thread::sleep((start + Duration::from_millis(u64::from(sequence))).saturating_duration_since(Instant::now()));
        if ends.load(Ordering::Relaxed) {
            return;
        }
        stream = stream.or_else(|| TcpStream::connect(("127.0.0.1", port)).ok());
        let wire = frames.wire(sequence);
        stream = stream.take().and_then(|mut stream: TcpStream| stream.write_all(&wire).is_ok().then_some(stream));
    }
}

/// Hear a daemon for so long after its first estimate.
fn live(subscriber: &mut Subscriber, survivors: &mut Survivors, time: Duration) {
    let (start, before) = (Instant::now(), survivors.life);
    let mut first = None;
    while first.is_none_or(|first: Instant| first.elapsed() < time) {
        assert!(start.elapsed() < SOON, "no estimate");
        subscriber.wait(Duration::from_millis(1)).unwrap().into_iter().for_each(|each| survivors.add(each));
        first = first.or_else(|| (survivors.life != before).then(Instant::now));
    }
}

fn expect_one_core(survivors: &Survivors) {
    let frames = Frames::new();
    let (mut core, names) = (frames.core(), Names::of(&frames.ring));
    for (number, (count, record)) in (1..).zip(&survivors.records) {
        assert_eq!(number, *count, "an estimate was not heard");
        (0..record.remarks.slices).for_each(|_| _ = core.slice());
        let estimate = core.ingest(&mut frames.wire(record.sequence)).unwrap();
        let mismatch = core.fit_quality().is_mismatch();
        let mut expected = EstimateRecord::of(&names, &estimate, |i, j| core.covariance(i, j), Some(mismatch));
        expected.remarked = record.remarked;
        assert_eq!(bits(record), bits(&expected), "frame {}", record.sequence);
        assert!(*record == expected, "frame {}", record.sequence);
    }
}

fn bits(record: &EstimateRecord) -> Vec<u32> {
    let EstimateRecord { mean, sigma, map_params, covariance, monitor_sigma, .. } = record;
    [mean, sigma, map_params, covariance, monitor_sigma].into_iter().flatten().map(|value| value.to_bits()).collect()
}

#[test]
fn a_damaged_stream_is_counted_and_the_next_frame_is_taken() {
    let port = port();
    let place = Place::new("damaged", &format!("tcp://127.0.0.1:{port}"), "listen", "");
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let mut daemon = place.start();
    let frames = Frames::new();
    let connect = || connected(|| TcpStream::connect(("127.0.0.1", port)));
    let mut line = connect();
    line.write_all(&[frames.wire(1), frames.wire(2)].concat()).unwrap();
    let mut flipped = frames.wire(3);
    flipped[40] ^= 1 << 3;
    if flipped[40] == 0 {
        flipped[40] = 1; // a zero would make two packets of it
    }
    line.write_all(&flipped).unwrap();
    line.write_all(&vec![7; 1 << 20]).unwrap(); // too long, in one piece
    line.write_all(&[0]).unwrap();
    line.write_all(&[frames.wire(4), frames.wire(4), frames.wire(5)].concat()).unwrap();
    line.write_all(&frames.wire(6)[..100]).unwrap(); // cut off
    drop(line);
    connect().write_all(&frames.wire(7)).unwrap();
    let heard: Vec<u32> = listening(&mut subscriber, 5).iter().map(|record| record.sequence).collect();
    assert_eq!(heard, [1, 2, 4, 5, 7]);
    place.hear("connection lost: closed by the other end");
    daemon.stop();
    let said = place.said();
    assert!(said.contains("so far 3 packets damaged, 1 frames refused, "), "{said}");
}

#[test]
fn a_daemon_connects_again_and_says_so_once() {
    let folder = tempfile::tempdir().unwrap();
    let socket = folder.path().join("front-end");
    let place = Place::new("again", &format!("unix:{}", socket.display()), "connect", "");
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let mut daemon = place.start();
    place.hear("tried again until it works");
    let frames = Frames::new();
    for life in 0..3 {
        let listener = UnixListener::bind(&socket).unwrap();
        let mut line = listener.accept().unwrap().0;
        line.write_all(&frames.wire(life + 1)).unwrap();
        assert_eq!(listening(&mut subscriber, 1)[0].sequence, life + 1);
        if life == 1 {
            // silent from now on, without a word
            place.hear("connection lost: silent for 1");
        }
        drop((line, listener));
        fs::remove_file(&socket).unwrap();
    }
    daemon.stop();
    assert_eq!(place.said().matches(": connected\n").count(), 3, "{}", place.said());
    assert!(place.said().matches("tried again until it works").count() <= 7, "{}", place.said());
}

/// A socket that a killed daemon has left is no obstacle, and a disk that is full no end.
#[test]
fn a_full_disk_is_survived_and_counted() {
    let folder = tempfile::tempdir().unwrap();
    let socket = folder.path().join("daemon");
    let address = format!("unix:{}", socket.display());
    let place = Place::new("full", &address, "listen", "checkpoint_every_frames = 2\n");
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    place.start().kill();
    drop(UnixListener::bind(&socket));
    std::os::unix::fs::symlink("/dev/full", place.path("checkpoint.new")).unwrap();
    let mut daemon = place.start();
    let (mut line, frames) = (connected(|| UnixStream::connect(&socket)), Frames::new());
    for sequence in 1..=10 {
        line.write_all(&frames.wire(sequence)).unwrap();
        assert_eq!(listening(&mut subscriber, 1)[0].frames, sequence);
    }
    place.hear("checkpoint not saved: No space left on device");
    fs::remove_file(place.path("checkpoint.new")).unwrap();
    (11..=14).for_each(|sequence| line.write_all(&frames.wire(sequence)).unwrap());
    place.hear("checkpoints are saved again");
    listening(&mut subscriber, 4);
    daemon.stop();
    assert!(place.said().contains("checkpoints not saved"), "{}", place.said());
    let mut daemon = place.start();
    place.hear("resumed after frame 14: 14 frames");
    daemon.stop();
}

#[test]
fn a_damaged_or_foreign_checkpoint_is_set_aside_and_the_one_before_is_loaded() {
    let port = port();
    let place = Place::new("aside", &format!("tcp://127.0.0.1:{port}"), "listen", "");
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let frames = Frames::new();
    let run = |subscriber: &mut Subscriber, sequence| {
        let mut daemon = place.start();
        connected(|| TcpStream::connect(("127.0.0.1", port))).write_all(&frames.wire(sequence)).unwrap();
        let frames = listening(subscriber, 1)[0].frames;
        daemon.stop();
        frames
    };
    assert_eq!([1, 2, 3].map(|sequence| run(&mut subscriber, sequence)), [1, 2, 3]);
    let file = place.path("checkpoint");
    let mut bytes = fs::read(&file).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    fs::write(&file, &bytes).unwrap();
    assert_eq!(run(&mut subscriber, 7), 3, "frames 1, 2 and 7");
    assert!(place.said().contains("frames 3 to 6 were lost since the checkpoint: 4"), "{}", place.said());
    let aside = || {
        fs::read_dir(place.folder.path())
            .unwrap()
            .flatten()
            .filter(|entry| entry.file_name().to_string_lossy().contains("set-aside"))
    };
    assert_eq!(fs::read(aside().next().unwrap().path()).unwrap(), bytes);
    let config = place.path("config.toml");
    let text = fs::read_to_string(&config).unwrap();
    fs::write(&config, format!("{text}[walk]\nparams_per_root_second = 1e-3\n")).unwrap();
    assert_eq!(run(&mut subscriber, 8), 1, "of another walk: at the prior");
    assert!(place.said().contains("of other priors, noise, calibration or walk"), "{}", place.said());
    assert_eq!(aside().count(), 3, "both that were there");
}

#[test]
fn a_check_says_everything_that_is_wrong_and_starts_nothing() {
    let place = Place::new("check", "tcp://nowhere", "listen", "checkpoint_every_frames = 0\nspeed = 3\n");
    let check = |file: &Path| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_orbitcal"));
        command.args(["serve", "--check"]).arg(file).output().unwrap()
    };
    let output = check(&place.path("config.toml"));
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{said}");
    for line in
        ["line 4: source.address", "line 13: checkpoint.checkpoint_every_frames = 0", "line 14: checkpoint.speed"]
    {
        assert!(said.contains(line), "{line}: {said}");
    }
    let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/booster.toml");
    let output = check(&example);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(String::from_utf8(output.stdout).unwrap().contains("33 monitors, 48 vars"));
}
