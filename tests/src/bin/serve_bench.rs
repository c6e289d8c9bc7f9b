//! `make serve-bench`: how fast the daemon is, from a TCP source on loopback to a subscriber of the shared memory: frames lost and late at
//! 10 kHz, latency at 1 kHz. Numbers of the machine at hand; no test asserts them.

use core::error::Error;
use core::sync::atomic::{AtomicU64, Ordering};
use core::time::Duration;
use std::fs;
use std::io::Write;
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::Instant;

use clap::Parser;
use host_bridge::sink::shared_memory::Subscriber;
use inference::{Recording, stream};
use twin::Ring;

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
    /// Time at 10 kHz [s]
    #[arg(long, default_value_t = 60)]
    seconds: u32,
}

fn main() -> Result<(), Box<dyn Error>> {
    let options = Options::parse();
    println!("other work: load {}", fs::read_to_string("/proc/loadavg")?.trim());
    println!("{:>6} {:>8} {:>8} {:>8}  latency [us]: median, 99 %, 99.9 %, largest", "Hz", "frames", "lost", "late");
    for (hertz, seconds) in [(10_000, options.seconds), (1_000, 20)] {
        println!("{}", measure(&options, hertz, seconds)?);
    }
    Ok(())
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
fn measure(options: &Options, hertz: u32, seconds: u32) -> Result<String, Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
    let service = format!("orbitcal/bench/{}/{hertz}", std::process::id());
    let recording = fs::canonicalize(&options.recording)?;
    let buffer_frames = hertz / 10; // 100 ms
    let config = folder.path().join("config.toml");
    fs::write(
        &config,
        format!(
            "[machine]\nrecording = {recording:?}\n[source]\naddress = \"tcp://127.0.0.1:{port}\"\nrole = \"listen\"\n\
             buffer_frames = {buffer_frames}\n[publish]\nservice = {service:?}\n[checkpoint]\nfile = \"checkpoint\"\n"
        ),
    )?;
    let frames = wires(&recording, hertz, hertz * seconds)?;
    let mut subscriber = Subscriber::try_new(&service)?;
    let said = fs::File::create(folder.path().join("said"))?;
    let mut command = Command::new(&options.program);
    let daemon = Daemon(command.arg("serve").arg(&config).stdin(Stdio::null()).stderr(said).spawn()?);
    let line = connect(port)?;
    let sent: Vec<AtomicU64> = frames.iter().map(|_| AtomicU64::new(0)).collect();
    let start = Instant::now();
    let mut latencies = thread::scope(|scope| {
        let sender = scope.spawn(|| send(line, &frames, &sent, start, hertz));
        let heard = hear(&mut subscriber, &sent, start, || sender.is_finished());
        sender.join().expect("the sender does not panic").map(|()| heard)
    })?;
    latencies.sort_unstable();
    let lost = frames.len() - latencies.len();
    let late = latencies.iter().filter(|latency| **latency > LATE).count();
    let at = |share: f64| {
        let index = (share * latencies.len() as f64) as usize;
        latencies.get(index.min(latencies.len().saturating_sub(1))).map_or(f64::NAN, |time| time.as_secs_f64() * 1e6)
    };
    let quantiles: Vec<String> = [0.5, 0.99, 0.999, 1.0].iter().map(|share| format!("{:.0}", at(*share))).collect();
    let threads = threads(daemon.0.id(), latencies.len());
    let said = fs::read_to_string(folder.path().join("said"))?;
    let faults: Vec<&str> = said.lines().filter(|line| line.contains("so far")).collect();
    let (count, quantiles, faults) = (frames.len(), quantiles.join(", "), faults.join("; "));
    Ok(format!("{hertz:>6} {count:>8} {lost:>8} {late:>8}  {quantiles} {faults}\n       {threads}"))
}

/// Time that each thread of the daemon has run for a frame, and waited for a processor [us], by the kernel.
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
    format!("us a frame: {}", tasks.filter_map(of).collect::<Vec<_>>().join(", "))
}

/// Frames of a recording again and again.
fn wires(recording: &Path, hertz: u32, count: u32) -> Result<Vec<Vec<u8>>, Box<dyn Error>> {
    let recording = Recording::read(recording, &Ring::booster())?;
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

/// How long each frame took from the socket's writer to here, until the last one or a while after the sender has ended.
fn hear(
    subscriber: &mut Subscriber,
    sent: &[AtomicU64],
    start: Instant,
    has_ended: impl Fn() -> bool,
) -> Vec<Duration> {
    let (mut latencies, mut ended) = (Vec::new(), None);
    while ended.is_none_or(|ended: Instant| ended.elapsed() < END) && latencies.len() < sent.len() {
        let heard = subscriber.wait(Duration::from_millis(100)).unwrap_or_default();
        let now = start.elapsed();
        for record in heard.iter().map(|published| &published.record) {
            let sent = sent.get(record.sequence as usize).map_or(0, |sent| sent.load(Ordering::Acquire));
            latencies.push(now.saturating_sub(Duration::from_nanos(sent)));
        }
        ended = ended.or_else(|| has_ended().then(Instant::now));
    }
    latencies
}
