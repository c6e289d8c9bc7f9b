//! `make serve-bench`: how fast the daemon is, from a TCP source on loopback to a subscriber of the shared memory: frames lost and late at
//! 10 kHz, latency at 1 kHz, the same under attack by senders and browsers, and both of a ring that nearly fills the largest core at 10 Hz. Numbers of the machine at
//! hand; no test asserts them.
//!
//! The latency begins before the writer's call of the system. What of it is the daemon's, the daemon says itself, of the last 1,024 frames: from
//! the frame in its queue until its readers are woken. From the stamp of the estimate until it is read is told by the reader.

use core::error::Error;
use core::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use core::time::Duration;
use std::fs;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use clap::Parser;
use inference::{Recording, simulate, stream};
use shared_memory::{Published, Subscriber};
use system_tests::{attackers, cells};
use twin::{LatticeError, Ring};

/// Frames that are later than this are counted as late.
const LATE: Duration = Duration::from_millis(100);
/// Wait for the last estimates.
const END: Duration = Duration::from_secs(2);

/// Measure the daemon.
#[derive(Debug, Parser)]
struct Options {
    /// The program
    #[arg(long, default_value = "target/release/orbitcal")]
    program: String,
    /// Frames come as those of this recording
    #[arg(long, default_value = "recordings/paper-vars")]
    recording: String,
    /// Time at 10 kHz, under attack, and at 10 Hz [s]
    #[arg(long, default_value_t = 60)]
    seconds: u32,
}

fn main() -> Result<(), Box<dyn Error>> {
    let options = Options::parse();
    println!("other work: load {}", fs::read_to_string("/proc/loadavg")?.trim());
    println!("{:>6} {:>8} {:>8} {:>8}  latency [us]: median, 99 %, 99.9 %, largest", "Hz", "frames", "lost", "late");
    let booster = Campaign { machine: None, recording: fs::canonicalize(&options.recording)? };
    for (hertz, seconds, attacked) in
        [(10_000, options.seconds, false), (1_000, 20, false), (1_000, options.seconds, true)]
    {
        println!("{}", measure(&options, &booster, (hertz, attacked), seconds)?);
    }
    let folder = tempfile::tempdir()?;
    println!("{}", measure(&options, &largest(folder.path())?, (10, false), options.seconds)?);
    Ok(())
}

/// A recording, and the machine file where it is not of the Booster.
struct Campaign {
    machine: Option<PathBuf>,
    recording: PathBuf,
}

impl Campaign {
    /// Keys of the daemon's configuration.
    fn keys(&self) -> String {
        let file = self.machine.as_ref().map_or(String::new(), |path| format!("file = {path:?}\n"));
        format!("{file}recording = {:?}\n", self.recording)
    }

    fn ring(&self) -> Result<Ring, LatticeError> {
        self.machine.as_ref().map_or_else(|| Ok(Ring::booster()), |path| Ring::read(path))
    }
}

/// A ring of 512 quadrupoles with 320 monitors a plane, and a campaign of it.
fn largest(folder: &Path) -> Result<Campaign, Box<dyn Error>> {
    let machine = folder.join("ring.json");
    fs::write(&machine, cells::file(256, 64).to_string())?;
    let ring = Ring::read(&machine)?;
    let vars = simulate::vars(&ring, false, 1)?;
    cells::campaign(&ring, 1025, &vars).write(folder, &ring)?;
    Ok(Campaign { machine: Some(machine), recording: folder.to_owned() })
}

struct Daemon(Child);

impl Drop for Daemon {
    fn drop(&mut self) {
        let ended = Command::new("kill").arg(self.0.id().to_string()).status();
        if ended.is_err() {
            let _ = self.0.kill();
        }
        let _ = self.0.wait();
    }
}

/// One line of the table.
fn measure(
    options: &Options,
    campaign: &Campaign,
    (hertz, attacked): (u32, bool),
    seconds: u32,
) -> Result<String, Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let [port, page] = free_ports()?;
    let service = format!("orbitcal/bench/{}/{hertz}", std::process::id());
    let buffer_frames = (hertz / 10).max(10); // 100 ms, or ten frames
    let config = folder.path().join("config.toml");
    fs::write(
        &config,
        format!(
            "[machine]\n{}[source]\naddress = \"tcp://127.0.0.1:{port}\"\nrole = \"listen\"\n\
             buffer_frames = {buffer_frames}\n[publish]\nservice = {service:?}\n[checkpoint]\nfile = \"checkpoint\"\ncheckpoint_every_frames = {}\n\
             [page]\naddress = \"127.0.0.1:{page}\"\n",
            campaign.keys(),
            (20 * hertz).min(1000)
        ),
    )?;
    let mut frames = wires(campaign, hertz, hertz * seconds)?;
    if attacked {
        for (number, frame) in frames.iter_mut().enumerate() {
            *frame = [&attackers::damage(frame, number)[..], &[0], frame].concat();
        }
    }
    let mut subscriber = Subscriber::try_new(&service)?;
    let said = fs::File::create(folder.path().join("said"))?;
    let mut command = Command::new(&options.program);
    let daemon = Daemon(command.arg("serve").arg(&config).stdin(Stdio::null()).stderr(said).spawn()?);
    let line = connect(port)?;
    let sent: Vec<AtomicU64> = frames.iter().map(|_| AtomicU64::new(0)).collect();
    let start = Instant::now();
    let is_over = AtomicBool::new(false);
    let (latencies, since_published) = thread::scope(|scope| {
        if attacked {
            scope.spawn(|| attackers::browse(page, &is_over));
        }
        let sender = scope.spawn(|| send(line, &frames, &sent, start, hertz));
        let heard = hear(&mut subscriber, &sent, start, || sender.is_finished());
        is_over.store(true, Ordering::Relaxed);
        sender.join().expect("the sender does not panic").map(|()| heard)
    })?;
    let lost = frames.len() - latencies.len();
    let late = latencies.iter().filter(|latency| **latency > LATE).count();
    let quantiles: Vec<String> =
        [0.5, 0.99, 0.999, 1.0].iter().map(|share| format!("{:.0}", quantile_us(&latencies, *share))).collect();
    let [in_daemon, of_reader] = [in_daemon_us(page)?, [0.5, 0.99].map(|share| quantile_us(&since_published, share))]
        .map(|us| us.map(|us| format!("{us:.0}")).join(", "));
    let threads = threads(daemon.0.id(), latencies.len());
    let said = fs::read_to_string(folder.path().join("said"))?;
    let faults: Vec<&str> = said.lines().filter(|line| line.contains("so far")).collect();
    let (count, quantiles, faults) = (frames.len(), quantiles.join(", "), faults.join("; "));
    Ok(format!(
        "{hertz:>6} {count:>8} {lost:>8} {late:>8}  {quantiles} {}{faults}\n       \
         us, median and 99 %: frame in the daemon's queue to readers woken {in_daemon}; estimate stamped to read {of_reader}\n       {threads}",
        if attacked { "under attack " } else { "" }
    ))
}

/// Two ports that nobody listens at.
fn free_ports() -> std::io::Result<[u16; 2]> {
    let (one, other) = (TcpListener::bind("127.0.0.1:0")?, TcpListener::bind("127.0.0.1:0")?);
    Ok([one.local_addr()?.port(), other.local_addr()?.port()])
}

/// A quantile of times that are sorted [us].
fn quantile_us(sorted: &[Duration], share: f64) -> f64 {
    let index = (share * sorted.len() as f64) as usize;
    sorted.get(index.min(sorted.len().saturating_sub(1))).map_or(f64::NAN, |time| time.as_secs_f64() * 1e6)
}

/// Median and 99 % of the time from a frame in the daemon's queue until its readers are woken, by its page [us].
fn in_daemon_us(page: u16) -> Result<[f64; 2], Box<dyn Error>> {
    let mut line = TcpStream::connect(("127.0.0.1", page))?;
    line.write_all(b"GET /state.json HTTP/1.0\r\n\r\n")?;
    let mut reply = String::new();
    line.read_to_string(&mut reply)?;
    let (_, body) = reply.split_once("\r\n\r\n").ok_or("the page has sent no body")?;
    let state: serde_json::Value = serde_json::from_str(body)?;
    // null before the first estimate
    Ok(serde_json::from_value(state["latency_us"].clone()).unwrap_or([f64::NAN; 2]))
}

/// Most memory that the daemon has had.
fn memory(process: u32) -> String {
    let status = fs::read_to_string(format!("/proc/{process}/status")).unwrap_or_default();
    let most = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    most.map_or(String::new(), |most| format!("memory {}; ", most.trim()))
}

/// Memory of the daemon; time that each of its threads has run for a frame, and waited for a processor [us], by the kernel.
fn threads(process: u32, frames: usize) -> String {
    let of = |task: fs::DirEntry| {
        let read = |name: &str| fs::read_to_string(task.path().join(name)).ok();
        let (name, times) = (read("comm")?, read("schedstat")?);
        let us = |ns: &str| ns.parse::<f64>().ok().map(|ns| ns * 1e-3 / frames.max(1) as f64);
        let mut times = times.split_whitespace();
        let (ran, waited) = (us(times.next()?)?, us(times.next()?)?);
        (ran > 0.5).then(|| format!("{} {ran:.0} (waited {waited:.0})", name.trim()))
    };
    let tasks = fs::read_dir(format!("/proc/{process}/task")).into_iter().flatten().flatten();
    format!("{}us a frame: {}", memory(process), tasks.filter_map(of).collect::<Vec<_>>().join(", "))
}

/// Frames of a recording again and again.
fn wires(campaign: &Campaign, hertz: u32, count: u32) -> Result<Vec<Vec<u8>>, Box<dyn Error>> {
    let recording = Recording::read(&campaign.recording, &campaign.ring()?)?;
    let each = recording.rows.iter().cycle().zip(0..count).map(|(row, sequence)| {
        let mut row = row.clone();
        (row.sequence, row.time) = (sequence, f64::from(sequence) / f64::from(hertz));
        Ok(stream::wire(&recording, &row)?)
    });
    each.collect()
}

fn connect(port: u16) -> Result<TcpStream, Box<dyn Error>> {
    let start = Instant::now();
    loop {
        match TcpStream::connect(("127.0.0.1", port)) {
            Ok(line) => {
                line.set_nodelay(true)?;
                return Ok(line);
            }
            Err(error) if start.elapsed() > Duration::from_secs(10) => return Err(error.into()),
            Err(_) => thread::sleep(Duration::from_millis(10)),
        }
    }
}

/// Send each frame when it is due, and note when that was.
fn send(
    mut line: TcpStream,
    frames: &[Vec<u8>],
    sent: &[AtomicU64],
    start: Instant,
    hertz: u32,
) -> std::io::Result<()> {
    for ((frame, sent), number) in frames.iter().zip(sent).zip(0_u64..) {
        let due = start + Duration::from_nanos(number * 1_000_000_000 / u64::from(hertz));
        thread::sleep(due.saturating_duration_since(Instant::now()));
        sent.store(start.elapsed().as_nanos() as u64, Ordering::Release);
        line.write_all(frame)?;
    }
    Ok(())
}

/// How long each frame took from the socket's writer to here, and from the stamp of its estimate, both sorted; until the last one or a while
/// after the sender has ended.
fn hear(
    subscriber: &mut Subscriber,
    sent: &[AtomicU64],
    start: Instant,
    has_ended: impl Fn() -> bool,
) -> (Vec<Duration>, Vec<Duration>) {
    let (mut latencies, mut since_published, mut ended) = (Vec::new(), Vec::new(), None);
    while ended.is_none_or(|ended: Instant| ended.elapsed() < END) && latencies.len() < sent.len() {
        let heard = subscriber.wait(Duration::from_millis(100)).unwrap_or_default();
        let (now, clock) = (start.elapsed(), SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default());
        for Published { record, stamp } in &heard {
            let sent = sent.get(record.sequence as usize).map_or(0, |sent| sent.load(Ordering::Acquire));
            latencies.push(now.saturating_sub(Duration::from_nanos(sent)));
            since_published.push(clock.saturating_sub(Duration::from_nanos(stamp.published_ns)));
        }
        ended = ended.or_else(|| has_ended().then(Instant::now));
    }
    latencies.sort_unstable();
    since_published.sort_unstable();
    (latencies, since_published)
}
