//! Damage on the line, on the disk and in the configuration.

use std::fs;
use std::io::Write;
use std::net::TcpStream;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::process::Command;

use shared_memory::Subscriber;

use crate::place::{Frames, Place, connected, listening, port};

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
        drop((line, listener));
        fs::remove_file(&socket).unwrap();
    }
    daemon.stop();
    assert_eq!(place.said().matches(": connected\n").count(), 3, "{}", place.said());
    assert!(place.said().matches("tried again until it works").count() <= 7, "{}", place.said());
}

#[test]
fn a_silent_line_is_given_up() {
    let folder = tempfile::tempdir().unwrap();
    let socket = folder.path().join("front-end");
    let place = Place::new("silence", &format!("unix:{}", socket.display()), "connect", "");
    place.change("timeout_ms = 60000", "timeout_ms = 1000");
    let listener = UnixListener::bind(&socket).unwrap();
    let mut daemon = place.start();
    let _line = listener.accept().unwrap();
    place.hear("connection lost: silent for ");
    daemon.stop();
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
