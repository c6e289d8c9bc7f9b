//! Several daemons on one host, several users, the end under load, and logs for programs.

use std::fs;
use std::io::Write;
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::process::{Command, Output};
use std::thread;

use serde_json::Value;
use shared_memory::Subscriber;

use crate::place::{Frames, Place, connected, listening, port, told};

/// A change of a configuration's text.
type Edit<'e> = &'e dyn Fn(String) -> String;

/// A daemon that listens, with more in its configuration.
fn place(test: &str, more: &str) -> (Place, u16) {
    let port = port();
    (Place::new(test, &format!("tcp://127.0.0.1:{port}"), "listen", more), port)
}

/// What a daemon says that does not start.
fn refused(place: &Place) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_orbitcal"));
    let output = command.arg("serve").arg(place.path("config.toml")).output().unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stderr).unwrap()
}

#[test]
fn two_daemons_run_side_by_side_and_what_collides_is_refused() {
    let page = port();
    let more = format!("[history]\nfolder = \"history\"\n[page]\naddress = \"127.0.0.1:{page}\"\n");
    let (first, frames_port) = place("first", &more);
    let config = |place: &Place, change: &dyn Fn(String) -> String| {
        let file = place.path("config.toml");
        fs::write(&file, change(fs::read_to_string(&file).unwrap())).unwrap();
    };
    let add_frames =
        |text: String| text.replace("[checkpoint]", &format!("frames = \"{}/frames\"\n[checkpoint]", first.service));
    config(&first, &add_frames);
    let mut daemon = first.start();
    first.hear("takes frames from");
    let shared = |name: &str| first.path(name).display().to_string();
    let cases: [(&str, Edit, &str); 5] = [
        (
            "same-service",
            &|text| {
                text.replace(&format!("{}/same-service", std::process::id()), &format!("{}/first", std::process::id()))
            },
            "another daemon publishes there",
        ),
        ("same-frames", &add_frames, "another daemon publishes there"),
        (
            "same-checkpoint",
            &|text: String| text.replace("\"checkpoint\"", &format!("{:?}", shared("checkpoint"))),
            "another daemon keeps it",
        ),
        (
            "same-history",
            &|text: String| text + &format!("[history]\nfolder = {:?}\n", shared("history")),
            "another daemon writes its history there",
        ),
        (
            "same-page",
            &|text: String| text + &format!("[page]\naddress = \"127.0.0.1:{page}\"\n"),
            "the page cannot be served",
        ),
    ];
    for (test, change, words) in cases {
        let (second, _) = place(test, "");
        config(&second, change);
        let said = refused(&second);
        assert!(said.contains(words), "{test}: {said}");
    }
    // with names of its own the other machine's daemon runs, and each has its own frames
    let (second, other_port) = place("second", "");
    let mut other = second.start();
    let frames = Frames::new();
    for (place, port, sequence) in [(&first, frames_port, 7), (&second, other_port, 9)] {
        let mut subscriber = Subscriber::try_new(&place.service).unwrap();
        connected(|| TcpStream::connect(("127.0.0.1", port))).write_all(&frames.wire(sequence)).unwrap();
        assert_eq!(listening(&mut subscriber, 1)[0].sequence, sequence);
    }
    daemon.stop();
    other.stop();
}

/// More frames than the core takes, from a sender that never waits: the end is orderly, and how long it took is printed.
#[test]
fn an_end_under_load_saves_the_last_checkpoint() {
    let (place, port) = place("load", "[history]\nfolder = \"history\"\nfine_ms = 1\n");
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let mut daemon = place.start();
    let mut line = connected(|| TcpStream::connect(("127.0.0.1", port)));
    let feeder = thread::spawn(move || {
        let frames = Frames::new();
        let _ = (1..).try_for_each(|sequence| line.write_all(&frames.wire(sequence)));
    });
    let last = listening(&mut subscriber, 500).last().unwrap().frames;
    let took = daemon.stop();
    feeder.join().unwrap();
    println!("SIGTERM under load: {} ms", took.as_millis());
    let mut daemon = place.start();
    place.hear("resumed after frame");
    daemon.stop();
    let said = place.said();
    let resumed = said
        .lines()
        .find_map(|line| line.split_once("resumed after frame ")?.1.split_once(": ")?.1.split_once(" frames"));
    assert!(resumed.unwrap().0.parse::<u32>().unwrap() >= last, "{said}");
}

#[test]
fn logs_are_json_where_a_program_reads_them() {
    let (place, _) = place("logs", "[logs]\nform = \"json\"\n");
    let mut daemon = place.start();
    place.hear("takes frames from");
    daemon.stop();
    let lines: Vec<Value> = place.said().lines().map(|line| serde_json::from_str(line).expect(line)).collect();
    assert!(
        !lines.is_empty() && lines.iter().all(|line| line["level"] == "INFO" && line["timestamp"].is_string()),
        "{lines:?}"
    );
    assert!(lines.iter().any(|line| line["message"].as_str().unwrap().contains("takes frames from")), "{lines:?}");
}

/// A user that is neither root nor whoever runs this.
const STRANGER: u32 = 65_534;

/// The program as another user, in a folder of that user's.
fn as_stranger(program: &std::path::Path, folder: &std::path::Path, arguments: &[&str]) -> Option<Output> {
    let mut command = Command::new(program);
    command.args(arguments).current_dir(folder).uid(STRANGER).gid(STRANGER).env("HOME", folder).output().ok()
}

#[test]
fn another_user_neither_reads_nor_disturbs_and_is_told_why() {
    let folder = tempfile::tempdir().unwrap();
    let program = folder.path().join("orbitcal");
    fs::copy(env!("CARGO_BIN_EXE_orbitcal"), &program).unwrap();
    fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o777)).unwrap();
    if as_stranger(&program, folder.path(), &["--version"]).is_none_or(|output| !output.status.success()) {
        eprintln!("not tested: only root runs programs as another user");
        return;
    }
    let (place, port) = place("users", "");
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let mut daemon = place.start();
    place.hear("takes frames from");
    let watch = ["watch", "--service", &place.service, "--idle", "1"];
    let output = as_stranger(&program, folder.path(), &watch).unwrap();
    let said = told(&output);
    assert!(output.status.code() == Some(1) && said.contains("all processes need one user"), "{said}");
    let reset = ["request", "reset", "--service", &place.service];
    let output = as_stranger(&program, folder.path(), &reset).unwrap();
    assert_eq!(output.status.code(), Some(1), "{}", told(&output));
    // with folders of their own both work, each with its own; iceoryx2 changes this process's umask for a moment where it opens a socket
    let own = format!("[global]\nroot-path = {:?}\nprefix = \"stranger_\"\n", folder.path().join("iceoryx2"));
    let (config, file) = (folder.path().join("config"), folder.path().join("config/iceoryx2.toml"));
    fs::create_dir(&config).unwrap();
    fs::write(&file, own).unwrap();
    fs::set_permissions(&config, fs::Permissions::from_mode(0o755)).unwrap();
    fs::set_permissions(&file, fs::Permissions::from_mode(0o644)).unwrap();
    let output = as_stranger(&program, folder.path(), &watch).unwrap();
    let said = told(&output);
    assert!(output.status.success() && said.contains("0 estimates seen"), "{said}");
    connected(|| TcpStream::connect(("127.0.0.1", port))).write_all(&Frames::new().wire(3)).unwrap();
    assert_eq!(listening(&mut subscriber, 1)[0].sequence, 3, "the daemon goes on");
    daemon.stop();
}

/// The unit of systemd names keys that systemd knows, where it is there to say so.
#[test]
fn the_unit_is_one_that_systemd_takes() {
    let unit = fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../contrib/orbitcal.service")).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("orbitcal.service");
    // the program lies elsewhere here
    fs::write(&file, unit.replace("/usr/local/bin/orbitcal", env!("CARGO_BIN_EXE_orbitcal"))).unwrap();
    let Ok(output) = Command::new("systemd-analyze").arg("verify").arg(&file).output() else {
        eprintln!("not tested: there is no systemd-analyze here");
        return;
    };
    let said = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
    let ours: Vec<&str> = said.lines().filter(|line| line.contains("orbitcal.service")).collect();
    assert_eq!(ours, [""; 0], "{said}");
}
