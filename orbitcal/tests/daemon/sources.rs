//! Every source of raw frames gives the estimates of a core in this process, bit for bit.

use core::time::Duration;
use std::fs;
use std::io::Write;
use std::net::TcpStream;
use std::process::Command;
use std::thread;
use std::time::Instant;

use results::EstimateRecord;
use serialport::{SerialPort, TTYPort};
use shared_memory::{FrameWriter, Subscriber};

use crate::place::{Frames, Place, RECORDING, connected, listening, port};

/// Those of a core here that did the same slices of work.
fn expect_those_of_a_core_here(frames: &Frames, heard: &[EstimateRecord]) {
    let mut core = frames.core();
    for (record, count) in heard.iter().zip(1..) {
        (0..record.remarks.slices).for_each(|_| _ = core.slice());
        let estimate = core.ingest(&mut frames.wire(record.sequence)).unwrap();
        assert_eq!((record.frames, &record.mean, &record.sigma), (count, &estimate.mean, &estimate.sigma));
    }
}

#[test]
fn a_serial_device_is_read() {
    let (mut front_end, daemon_side) = TTYPort::pair().unwrap();
    let place = Place::new("serial", &format!("serial:{}", daemon_side.name().unwrap()), "connect", "");
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let mut daemon = place.start();
    place.hear(": connected");
    let frames = Frames::new();
    (1..=20).for_each(|sequence| front_end.write_all(&frames.wire(sequence)).unwrap());
    expect_those_of_a_core_here(&frames, &listening(&mut subscriber, 20));
    daemon.stop();
}

#[test]
fn frames_in_shared_memory_are_read_and_their_publisher_may_start_again() {
    let service = format!("orbitcal/test/{}/raw", std::process::id());
    let place = Place::new("shared", &format!("iceoryx2:{service}"), "connect", "");
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let mut daemon = place.start();
    place.hear("takes frames from iceoryx2:");
    let (frames, mut heard) = (Frames::new(), Vec::new());
    for first in [1, 11] {
        let mut front_end = FrameWriter::try_new(&service, "front end").unwrap();
        for sequence in first..first + 10 {
            front_end.send(&frames.wire(sequence)).unwrap();
            heard.extend(listening(&mut subscriber, 1));
        }
    }
    expect_those_of_a_core_here(&frames, &heard);
    daemon.stop();
}

/// The second daemon takes the frames that the first one has taken and published.
#[test]
fn a_daemon_takes_the_frames_of_another() {
    let (port, service) = (port(), format!("orbitcal/test/{}/passed-on", std::process::id()));
    let first = Place::new("first", &format!("tcp://127.0.0.1:{port}"), "listen", "");
    let config = first.path("config.toml");
    let text = fs::read_to_string(&config).unwrap();
    fs::write(&config, text.replacen("[checkpoint]", &format!("frames = {service:?}\n[checkpoint]"), 1)).unwrap();
    let second = Place::new("second", &format!("iceoryx2:{service}"), "connect", "");
    let [mut one, mut two] = [&first, &second].map(|place| Subscriber::try_new(&place.service).unwrap());
    let mut daemons = [second.start(), first.start()];
    second.hear("takes frames from iceoryx2:");
    let (frames, mut heard) = (Frames::new(), Vec::new());
    let mut line = connected(|| TcpStream::connect(("127.0.0.1", port)));
    for sequence in 1..=20 {
        line.write_all(&frames.wire(sequence)).unwrap();
        listening(&mut one, 1);
        heard.extend(listening(&mut two, 1));
    }
    expect_those_of_a_core_here(&frames, &heard);
    daemons.iter_mut().for_each(|daemon| _ = daemon.stop());
}

/// With room for two frames, a recording waits for the core, and the daemon ends after it.
#[test]
fn a_recording_is_replayed_to_its_end_without_a_loss() {
    let place = Place::new("replay", &format!("replay:{RECORDING}"), "connect", "");
    place.append_to_source("buffer_frames = 2\nrate_hz = 2000\n");
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let (start, mut daemon) = (Instant::now(), place.start());
    let heard = listening(&mut subscriber, 346);
    assert!(daemon.0.wait().unwrap().success(), "{}", place.said());
    assert!(start.elapsed() > Duration::from_millis(345 / 2), "{:?}", start.elapsed());
    assert_eq!(heard.last().unwrap().frames, 346);
    assert!(!place.said().contains("dropped"), "{}", place.said());
}

/// A sender that is faster than the core waits, and loses nothing in a buffer of two frames.
#[test]
fn a_front_end_waits_where_no_frame_may_be_lost() {
    const COUNT: usize = 400;
    let port = port();
    let place = Place::new("waits", &format!("tcp://127.0.0.1:{port}"), "listen", "");
    place.append_to_source("buffer_frames = 2\nwhen_full = \"wait\"\n");
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let mut daemon = place.start();
    let frames = Frames::new();
    let wires: Vec<u8> = (1..=COUNT as u32).flat_map(|sequence| frames.wire(sequence)).collect();
    let mut line = connected(|| TcpStream::connect(("127.0.0.1", port)));
    let sender = thread::spawn(move || line.write_all(&wires).map(|()| line));
    expect_those_of_a_core_here(&frames, &listening(&mut subscriber, COUNT));
    let _line = sender.join().unwrap().unwrap();
    daemon.stop();
    assert!(!place.said().contains("dropped"), "{}", place.said());
}

#[test]
fn a_recording_that_is_not_there_is_said_before_anything_starts() {
    let place = Place::new("absent", "replay:no/such/night", "connect", "");
    let mut command = Command::new(env!("CARGO_BIN_EXE_orbitcal"));
    let output = command.args(["serve", "--check"]).arg(place.path("config.toml")).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(said.contains("no/such/night"), "{said}");
    assert_eq!(fs::read_dir(place.folder.path()).unwrap().count(), 1, "nothing was started");
}
