//! The orbit feedback of a daemon, and a program that gives frames of a control system.

use core::time::Duration;
use std::fs;
use std::io::Write;
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt;
use std::process::{Command, Output};
use std::thread;
use std::time::Instant;

use shared_memory::{SetpointReader, Setpoints, Subscriber};

use crate::place::{Frames, Place, SOON, connected, listening, port};

fn request(place: &Place, what: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_orbitcal"));
    command.arg("request").args(what).args(["--service", &place.service]).output().unwrap()
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&[output.stdout.as_slice(), &output.stderr].concat()).into_owned()
}

/// The set points of a frame.
fn of(reader: &mut SetpointReader, frames: u32) -> Setpoints {
    let start = Instant::now();
    loop {
        assert!(start.elapsed() < SOON, "no set points of frame {frames}");
        match reader.newest().unwrap() {
            Some(setpoints) if setpoints.header.frames == frames => return setpoints,
            _ => thread::sleep(Duration::from_millis(1)),
        }
    }
}

#[test]
fn the_feedback_is_switched_on_and_off_where_that_is_allowed() {
    const FEEDBACK: &str = "[feedback]\ncorrectors = [\"H_A4\", \"H_C4\", \"V_D3\"]\nlimit_A = 5.0\n";
    let port = port();
    let more = format!("{FEEDBACK}[requests]\nfeedback = true\n");
    let place = Place::new("steers", &format!("tcp://127.0.0.1:{port}"), "listen", &more);
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let mut reader = SetpointReader::try_new(&place.service).unwrap();
    let (mut daemon, frames) = (place.start(), Frames::new());
    let mut line = connected(|| TcpStream::connect(("127.0.0.1", port)));
    let mut feed = |numbers: core::ops::RangeInclusive<u32>| {
        for sequence in numbers {
            line.write_all(&frames.wire(sequence)).unwrap();
            listening(&mut subscriber, 1);
        }
    };
    feed(1..=5);
    assert_eq!(reader.newest().unwrap(), None, "off");
    let on = request(&place, &["feedback", "on"]);
    assert!(on.status.success() && said(&on).contains("the orbit feedback is on"), "{}", said(&on));
    feed(6..=6);
    let first = of(&mut reader, 6);
    assert_eq!(first.header.hold, 1, "the first frame tells where the correctors are");
    let names = frames.ring.corrector_names();
    let used = |name: &String| ["H_A4", "H_C4", "V_D3"].contains(&name.as_str());
    assert!(names.iter().zip(&first.role).all(|(name, role)| *role == u32::from(used(name))), "{:?}", first.role);
    let read_back = frames.recording.rows[6].corrector_current[1] as f32;
    assert!((first.current[1] - read_back).abs() < 1e-4, "{} {read_back}", first.current[1]);
    feed(7..=20);
    let later = of(&mut reader, 20);
    assert!(later.current[1].abs() <= 5.0 && (later.current[1] - read_back).abs() > 0.1, "{:?}", later.current);
    let off = request(&place, &["feedback", "off"]);
    assert!(said(&off).contains("the orbit feedback is off"), "{}", said(&off));
    feed(21..=25);
    assert_eq!(reader.newest().unwrap(), None, "off again");
    daemon.stop();
}

#[test]
fn a_feedback_that_is_not_configured_cannot_be_switched_on() {
    let place = Place::new("holds-still", &format!("tcp://127.0.0.1:{}", port()), "listen", "");
    let mut daemon = place.start();
    place.hear("takes frames from");
    let on = request(&place, &["feedback", "on"]);
    assert!(said(&on).contains("refused: requests.feedback is false in the configuration"), "{}", said(&on));
    daemon.stop();
}

/// The program ends after its first frames, is started again, and goes on; it is told the channels each time.
#[test]
fn frames_come_from_a_program_that_is_started_again() {
    let plan = concat!(env!("CARGO_MANIFEST_DIR"), "/../config/measure-booster.toml");
    let place = Place::new("program", &format!("epics:{plan}"), "connect", "");
    place.append_to_source("program = \"./gives-frames\"\n");
    let frames = Frames::new();
    for (name, numbers) in [("first", 1..=10), ("second", 11..=20)] {
        let wires: Vec<u8> = numbers.flat_map(|sequence| frames.wire(sequence)).collect();
        fs::write(place.path(name), wires).unwrap();
    }
    let script = "#!/bin/sh\ncd \"$(dirname \"$0\")\"\nread request\nprintf '%s\\n' \"$request\" >> told\n\
                  if [ -e began ]; then cat second; exec sleep 60; fi\ntouch began; cat first\n";
    let program = place.path("gives-frames");
    fs::write(&program, script).unwrap();
    fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let mut daemon = place.start();
    let heard = listening(&mut subscriber, 20);
    assert_eq!(heard.iter().map(|record| record.sequence).collect::<Vec<_>>(), (1..=20).collect::<Vec<_>>());
    let told = fs::read_to_string(place.path("told")).unwrap();
    assert!(
        told.lines().count() >= 2 && told.lines().all(|line| line.contains("\"cycle\":\"BOOSTER:CYCLE\"")),
        "{told}"
    );
    assert!(place.said().contains("connection lost: closed by the other end"), "{}", place.said());
    daemon.stop();
}

#[test]
fn a_program_that_is_not_there_is_said() {
    let plan = concat!(env!("CARGO_MANIFEST_DIR"), "/../config/measure-booster.toml");
    let place = Place::new("no-program", &format!("epics:{plan}"), "connect", "");
    place.append_to_source("program = \"./gives-nothing\"\n");
    let mut daemon = place.start();
    place.hear("`make control-env` installs it, source.program names another; tried again until it works");
    daemon.stop();
}
