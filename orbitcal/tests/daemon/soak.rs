//! A long stream with faults of every kind: what the daemon publishes is what a core makes of the surviving frames alone.

use core::sync::atomic::{AtomicU32, Ordering};
use core::time::Duration;
use std::fs;
use std::io::Write;
use std::net::TcpStream;
use std::thread;
use std::time::Instant;

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use shared_memory::Subscriber;

use crate::place::{Frames, Place, SOON, bits, connected, port};

/// One frame in twenty has a fault.
const FAULTY: f64 = 0.05;
/// Frames on their way at a time: fewer than a reader's buffer of 256, so that no estimate is missed.
const ON_THE_WAY: u32 = 100;
/// Growth of the resident memory after the first tenth that counts as none [kB]: a checkpoint on its way to the disk, five times.
const GROWTH: u64 = 2_000;

/// What may happen to a frame on its way.
#[derive(Debug, Clone, Copy)]
enum Fault {
    Flipped,
    Cut,
    Lost,
    Repeated,
    OutOfOrder,
    Junk,
}

impl Fault {
    fn random(random: &mut StdRng) -> Option<Self> {
        let all = [Self::Flipped, Self::Cut, Self::Lost, Self::Repeated, Self::OutOfOrder, Self::Junk];
        random.random_bool(FAULTY).then(|| all[random.random_range(0..all.len())])
    }

    /// True if the frame itself arrives.
    fn is_survived(self) -> bool {
        !matches!(self, Self::Flipped | Self::Cut | Self::Lost)
    }

    /// The bytes that are sent in place of a frame.
    fn put_into(self, frames: &Frames, sequence: u32, random: &mut StdRng) -> Vec<u8> {
        let mut wire = frames.wire(sequence);
        match self {
            Self::Flipped => {
                let at = random.random_range(0..wire.len() - 1);
                let bit = 1 << random.random_range(0..8);
                // a zero would make two packets of it, and both are damaged as well
                wire[at] ^= bit;
                wire
            }
            Self::Cut => [&wire[..random.random_range(1..wire.len() - 1)], &[0]].concat(),
            Self::Lost => Vec::new(),
            Self::Repeated => wire.repeat(2),
            Self::OutOfOrder => [wire, frames.wire(sequence - 5)].concat(),
            Self::Junk => [vec![7; random.random_range(1..100_000)], vec![0], wire].concat(),
        }
    }
}

/// Frames with their faults, sent as fast as estimates of them come back; returns which survived.
fn feed(mut line: TcpStream, count: u32, [sent, heard]: [&AtomicU32; 2]) -> Vec<u32> {
    let (frames, mut random, mut survived) = (Frames::new(), StdRng::seed_from_u64(5), Vec::new());
    for sequence in 10..10 + count {
        while survived.len() as u32 > heard.load(Ordering::Acquire) + ON_THE_WAY {
            thread::sleep(Duration::from_micros(200));
        }
        let fault = Fault::random(&mut random);
        let bytes = fault.map_or_else(|| frames.wire(sequence), |fault| fault.put_into(&frames, sequence, &mut random));
        line.write_all(&bytes).unwrap();
        survived.extend(fault.is_none_or(Fault::is_survived).then_some(sequence));
        sent.store(survived.len() as u32, Ordering::Release);
    }
    survived
}

/// Resident memory of a process [kB].
fn resident(process: u32) -> u64 {
    let status = fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.trim().trim_end_matches(" kB").parse().unwrap()
}

/// Returns the growth of the daemon's memory after the first tenth [kB].
fn soak(test: &str, count: u32) -> u64 {
    let port = port();
    let place = Place::new(test, &format!("tcp://127.0.0.1:{port}"), "listen", "checkpoint_every_frames = 1000\n");
    place.append_to_source("when_full = \"wait\"\n");
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let mut daemon = place.start();
    let line = connected(|| TcpStream::connect(("127.0.0.1", port)));
    let ([sent, heard], frames, mut taken) = ([const { AtomicU32::new(0) }; 2], Frames::new(), Vec::new());
    let (mut core, mut early, mut late) = (frames.core(), 0, 0);
    let survived = thread::scope(|scope| {
        let feeder = scope.spawn(|| feed(line, count, [&sent, &heard]));
        let mut news = Instant::now();
        while !feeder.is_finished() || (taken.len() as u32) < sent.load(Ordering::Acquire) {
            assert!(news.elapsed() < SOON, "no estimate after {} of {count} frames", taken.len());
            for published in subscriber.wait(Duration::from_millis(20)).unwrap() {
                let record = published.record;
                (0..record.remarks.slices).for_each(|_| _ = core.slice());
                let estimate = core.ingest(&mut frames.wire(record.sequence)).unwrap();
                let expected = bits(&[&estimate.mean, &estimate.sigma, &estimate.map_params]);
                assert_eq!(bits(&[&record.mean, &record.sigma, &record.map_params]), expected, "{}", record.sequence);
                assert_eq!(record.log_evidence.to_bits(), estimate.log_evidence.to_bits(), "{}", record.sequence);
                taken.push(record.sequence);
                heard.store(taken.len() as u32, Ordering::Release);
                news = Instant::now();
            }
            late = resident(daemon.0.id());
            early = if taken.len() as u32 <= count / 10 { late } else { early };
        }
        feeder.join().unwrap()
    });
    assert!(taken == survived, "{} estimates of {} surviving frames", taken.len(), survived.len());
    daemon.stop();
    assert!(!place.said().contains("dropped"), "{}", place.said());
    println!("{count} frames, {} survived, memory {early} kB after a tenth, {late} kB at the end", survived.len());
    late.saturating_sub(early)
}

#[test]
fn faults_of_every_kind_leave_no_trace_in_the_estimates() {
    soak("faulty", 3_000);
}

#[test]
#[ignore = "minutes: make serve-soak"]
fn serve_soak() {
    let growth = soak("soak", 2_000_000);
    assert!(growth < GROWTH, "the resident memory grew by {growth} kB");
}
