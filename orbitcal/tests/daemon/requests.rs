//! What operators ask of the running daemon, and what its configuration allows.

use core::time::Duration;
use std::fs;
use std::io::Write;
use std::net::TcpStream;
use std::path::Path;
use std::process::{Command, Output};
use std::thread;
use std::time::Instant;

use estimator::{MonitorState, Tables as _};
use results::model_file;
use shared_memory::{HealthReader, State, Subscriber};
use training::LINE;
use twin::Effect;

use crate::place::{Frames, Place, SOON, connected, listening, port};

/// `orbitcal request` on a daemon's service.
fn request(place: &Place, what: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_orbitcal"));
    command.arg("request").args(what).args(["--service", &place.service]).output().unwrap()
}

fn said(output: &Output) -> String {
    String::from_utf8_lossy(&[output.stdout.as_slice(), &output.stderr].concat()).into_owned()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn by_default_a_daemon_is_read_and_not_changed() {
    let port = port();
    let place = Place::new("read", &format!("tcp://127.0.0.1:{port}"), "listen", "");
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let (mut daemon, frames) = (place.start(), Frames::new());
    let mut line = connected(|| TcpStream::connect(("127.0.0.1", port)));
    (1..=5).for_each(|sequence| line.write_all(&frames.wire(sequence)).unwrap());
    listening(&mut subscriber, 5);
    let reset = request(&place, &["reset"]);
    assert_eq!(reset.status.code(), Some(1));
    assert!(said(&reset).contains("refused: requests.reset is false in the configuration"), "{}", said(&reset));
    let model = request(&place, &["model", text(&place.path("config.toml"))]);
    assert!(said(&model).contains("requests.model is false"), "{}", said(&model));
    let snapshot = place.path("snapshot");
    let taken = request(&place, &["snapshot", text(&snapshot)]);
    assert!(taken.status.success(), "{}", said(&taken));
    daemon.stop();
    // a daemon that begins with the snapshot goes on there
    fs::rename(&snapshot, place.path("checkpoint")).unwrap();
    let mut daemon = place.start();
    place.hear("resumed after frame 5: 5 frames");
    let mut line = connected(|| TcpStream::connect(("127.0.0.1", port)));
    line.write_all(&frames.wire(6)).unwrap();
    assert_eq!(listening(&mut subscriber, 1)[0].frames, 6);
    daemon.stop();
}

#[test]
fn what_is_allowed_is_done() {
    let port = port();
    let more = "[requests]\nreset = true\nmodel = true\n";
    let place = Place::new("asked", &format!("tcp://127.0.0.1:{port}"), "listen", more);
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let mut health = HealthReader::try_new(&place.service).unwrap();
    let (mut daemon, frames) = (place.start(), Frames::new());
    let mut line = connected(|| TcpStream::connect(("127.0.0.1", port)));
    (1..=346).for_each(|sequence| line.write_all(&frames.wire(sequence)).unwrap());
    let before = listening(&mut subscriber, 346).pop().unwrap();
    assert!(before.is_usable());
    let rolled = Effect::parse("quad_roll@D8=0.009", &frames.ring).unwrap();
    let extended = training::extended::tables(&frames.recording.powered(&frames.ring), &[rolled], &[1.0; 48]).unwrap();
    let file = place.path("model.tables");
    model_file::write(&file, &frames.ring.name, &extended.tables).unwrap();
    let model = request(&place, &["model", text(&file)]);
    assert!(said(&model).contains("the tables are now"), "{}", said(&model));
    line.write_all(&frames.wire(347)).unwrap();
    let other = listening(&mut subscriber, 1).pop().unwrap();
    assert_eq!((other.frames, other.tables), (347, Some(extended.tables.digest::<LINE>())));
    assert_ne!(other.tables, before.tables);
    let wrong = request(&place, &["model", text(&place.path("config.toml"))]);
    assert!(said(&wrong).contains("refused: "), "{}", said(&wrong));
    let reset = request(&place, &["reset"]);
    assert!(reset.status.success() && said(&reset).contains("the core is at its prior"), "{}", said(&reset));
    line.write_all(&frames.wire(348)).unwrap();
    let after = listening(&mut subscriber, 1).pop().unwrap();
    assert_eq!(after.frames, 1);
    assert!(after.sigma[0] > 2.0 * before.sigma[0], "{} {}", after.sigma[0], before.sigma[0]);
    assert!(after.monitor_state.iter().all(|state| *state == MonitorState::Ok));
    let start = Instant::now();
    let health = loop {
        assert!(start.elapsed() < SOON, "no health after the reset");
        match health.newest().unwrap() {
            Some(record) if record.frames == 1 => break record,
            _ => thread::sleep(Duration::from_millis(5)),
        }
    };
    assert_eq!([health.monitors.len(), health.correctors.len()], [33, 48]);
    assert!(health.monitors.iter().all(|condition| condition.state == State::Ok), "after the reset");
    daemon.stop();
}
