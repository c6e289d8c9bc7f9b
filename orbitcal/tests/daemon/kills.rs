//! kill -9 at random moments.

use core::sync::atomic::{AtomicBool, Ordering};
use core::time::Duration;
use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::net::TcpStream;
use std::sync::Arc;
use std::thread;
use std::time::Instant;

use estimator::Tables as _;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use results::{EstimateRecord, Names};
use shared_memory::{Published, Subscriber};
use training::LINE;

use crate::place::{Frames, Place, SOON, bits, port};

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

/// Kills at random moments (fixed seed) over a feed at 1 kHz: each restart goes on at a checkpoint, and all estimates that survive
/// are those of one core that was fed the surviving frames and never stopped. Another reader is killed as often.
fn kill(test: &str, kills: usize) {
    // 0.2 s at 1 kHz: longer than a busy disk takes to write one
    const EVERY: u32 = 200;
    let port = port();
    let address = format!("tcp://127.0.0.1:{port}");
    let place = Place::new(test, &address, "listen", &format!("checkpoint_every_frames = {EVERY}\n"));
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let ends = Arc::new(AtomicBool::new(false));
    let feeder = {
        let ends = ends.clone();
        thread::spawn(move || feed(port, &ends))
    };
    let (mut random, mut survivors, mut processes) = (StdRng::seed_from_u64(17), Survivors::default(), Vec::new());
    for _ in 0..kills {
        let (mut daemon, mut reader) = (place.start(), place.watch());
        processes.extend([daemon.0.id(), reader.0.id()]);
        let time = Duration::from_millis(random.random_range(1..500));
        live(&mut subscriber, &mut survivors, time / 2);
        reader.kill();
        live_on(&mut subscriber, &mut survivors, time / 2);
        daemon.kill();
    }
    let mut daemon = place.start();
    processes.push(daemon.0.id());
    live(&mut subscriber, &mut survivors, Duration::from_millis(300));
    assert_ne!(left_by(&[daemon.0.id()]), [""; 0], "the daemon that lives has shared memory");
    let took = daemon.stop();
    println!("SIGTERM took {took:?}");
    assert!(took < SOON, "SIGTERM took {took:?}");
    ends.store(true, Ordering::Relaxed);
    feeder.join().unwrap();
    drop(subscriber);
    // a last process that joins clears away what the last reader left
    drop(Subscriber::try_new(&place.service).unwrap());
    assert_eq!(left_by(&processes), [""; 0]);
    println!("frames lost by kills: {:?}", survivors.lost);
    assert_eq!(survivors.lost.len(), kills);
    // a checkpoint waits for work under way as long as one more interval, and is none while it is written; without any, lives would add up to thousands
    assert!(survivors.lost.iter().all(|lost| *lost <= 4 * EVERY), "{:?}", survivors.lost);
    expect_one_core(&survivors);
}

#[test]
fn kills_at_random_moments_cost_the_frames_since_a_checkpoint_and_no_bit() {
    kill("kills", 15);
}

#[test]
#[ignore = "a minute: make serve-kill"]
fn serve_kill() {
    kill("serve-kill", 100);
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

/// Hear it for so long from now on.
fn live_on(subscriber: &mut Subscriber, survivors: &mut Survivors, time: Duration) {
    let start = Instant::now();
    while start.elapsed() < time {
        subscriber.wait(Duration::from_millis(1)).unwrap().into_iter().for_each(|each| survivors.add(each));
    }
}

fn expect_one_core(survivors: &Survivors) {
    let frames = Frames::new();
    let (mut core, names) = (frames.core(), Names::of(&frames.ring));
    for (number, (count, record)) in (1..).zip(&survivors.records) {
        assert_eq!(number, *count, "an estimate was not heard");
        (0..record.remarks.slices).for_each(|_| _ = core.slice());
        let estimate = core.ingest(&mut frames.wire(record.sequence)).unwrap();
        let covariance = core.spread().covariance();
        // readings and model are compared ten times a second
        let mut expected = EstimateRecord::of(&names, estimate, &covariance, record.mismatch);
        expected.remarked = record.remarked;
        expected.tables = Some(core.tables.digest::<LINE>());
        assert_eq!(numbers(record), numbers(&expected), "frame {}", record.sequence);
        assert!(*record == expected, "frame {}", record.sequence);
    }
}

fn numbers(record: &EstimateRecord) -> Vec<u32> {
    let EstimateRecord { mean, sigma, map_params, covariance, monitor_sigma, .. } = record;
    bits(&[mean, sigma, map_params, covariance, monitor_sigma])
}
