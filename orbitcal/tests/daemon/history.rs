//! The history over restarts, kills and full disks, read while the daemon runs.

use core::time::Duration;
use std::fs;
use std::io::Write;
use std::net::TcpStream;
use std::path::Path;
use std::process::Command;
use std::thread;
use std::time::Instant;

use serde_json::Value;
use shared_memory::Subscriber;

use crate::place::{Frames, Place, SOON, connected, listening, port};

const KEEPS: &str = "[history]\nfolder = \"history\"\nfine_ms = 1\n";

/// The rows that `orbitcal history` gives.
fn rows(place: &Place, more: &[&str]) -> Vec<Value> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_orbitcal"));
    command.arg("history").arg(place.path("config.toml")).args(["--json", "-"]).args(more);
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let json: Value = serde_json::from_slice(&output.stdout).unwrap();
    json["rows"].as_array().unwrap().clone()
}

fn sequences(rows: &[Value]) -> Vec<u64> {
    rows.iter().map(|row| row["sequence"].as_u64().unwrap()).collect()
}

/// Send frames one by one, each once the one before is estimated: they come more than the millisecond of the history apart, however busy
/// the machine is.
fn feed(subscriber: &mut Subscriber, port: u16, numbers: core::ops::RangeInclusive<u32>) -> TcpStream {
    let (frames, mut line) = (Frames::new(), connected(|| TcpStream::connect(("127.0.0.1", port))));
    for sequence in numbers {
        line.write_all(&frames.wire(sequence)).unwrap();
        assert_eq!(listening(subscriber, 1)[0].sequence, sequence);
        thread::sleep(Duration::from_millis(2));
    }
    line
}

/// Rows appear a moment after their estimates.
fn eventually(place: &Place, expected: &[u64]) -> Vec<Value> {
    let start = Instant::now();
    loop {
        let rows = rows(place, &[]);
        if sequences(&rows) == expected {
            return rows;
        }
        assert!(start.elapsed() < SOON, "{:?}, expected {expected:?}", sequences(&rows));
    }
}

#[test]
fn the_history_goes_on_after_a_kill_and_a_torn_row_is_set_aside() {
    let port = port();
    let place = Place::new("history", &format!("tcp://127.0.0.1:{port}"), "listen", KEEPS);
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let mut daemon = place.start();
    let line = feed(&mut subscriber, port, 1..=5);
    // read while it runs
    let first = eventually(&place, &[1, 2, 3, 4, 5]);
    let d8 = |row: &Value| row["vars"].as_array().unwrap().iter().find(|var| var["name"] == "D8").unwrap().clone();
    assert!(d8(&first[4])["sigma"].as_f64().unwrap() > 0.0, "{}", first[4]);
    daemon.kill();
    drop(line);
    let file = fs::read_dir(place.path("history")).unwrap().flatten().map(|entry| entry.path());
    let file = file.into_iter().find(|path| path.to_string_lossy().contains("fine-")).unwrap();
    let text = fs::read_to_string(&file).unwrap();
    let torn = &text.lines().last().unwrap()[..200];
    fs::File::options().append(true).open(&file).unwrap().write_all(torn.as_bytes()).unwrap();
    let mut daemon = place.start();
    let _line = feed(&mut subscriber, port, 6..=8);
    eventually(&place, &[1, 2, 3, 4, 5, 6, 7, 8]);
    assert!(place.said().contains("200 bytes after its last whole row were set aside"), "{}", place.said());
    assert_eq!(fs::read_to_string(place.path("history/set-aside-00000000")).unwrap(), torn);
    daemon.stop();
    let since = first[2]["time"].as_str().unwrap();
    assert!(sequences(&rows(&place, &["--since", since])).len() >= 5);
    assert_eq!(sequences(&rows(&place, &["--until", "2020-01-01"])), [0; 0]);
    let one = rows(&place, &["--var", "D8"]);
    assert_eq!(one[0]["vars"].as_array().unwrap().len(), 1);
}

#[test]
fn a_table_and_a_wrong_name_are_said_in_words() {
    let port = port();
    let place = Place::new("table", &format!("tcp://127.0.0.1:{port}"), "listen", KEEPS);
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let mut daemon = place.start();
    drop(feed(&mut subscriber, port, 1..=3));
    daemon.stop();
    let history = |more: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_orbitcal"));
        command.arg("history").arg(place.path("history")).args(more).output().unwrap()
    };
    let shown = String::from_utf8(history(&["--var", "D8", "--var", "A2"]).stdout).unwrap();
    assert!(shown.starts_with("3 estimates\n") && shown.contains("D8") && shown.contains('±'), "{shown}");
    assert!(shown.lines().all(|line| line.chars().count() <= 80), "{shown}");
    let csv = String::from_utf8(history(&["--csv", "-"]).stdout).unwrap();
    assert_eq!(csv.lines().count(), 4);
    assert_eq!(csv.lines().next().unwrap().split(',').count(), 8 + 2 * 48);
    for (more, words) in
        [(["--var", "Z9"], "no var Z9 in the history; there are A2, "), (["--since", "soon"], "expected a time")]
    {
        let output = history(&more);
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.code() == Some(2) && said.contains(words), "{said}");
    }
}

/// A file system of its own, as root.
struct Small<'p>(&'p Path);

impl<'p> Small<'p> {
    fn mount(at: &'p Path) -> Option<Self> {
        fs::create_dir_all(at).unwrap();
        let mounted = Command::new("mount").args(["-t", "tmpfs", "-o", "size=1m", "none"]).arg(at).status();
        mounted.is_ok_and(|status| status.success()).then_some(Self(at))
    }
}

impl Drop for Small<'_> {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg(self.0).status();
    }
}

#[test]
fn a_full_disk_ends_neither_the_loop_nor_the_history() {
    let port = port();
    let place = Place::new("history-full", &format!("tcp://127.0.0.1:{port}"), "listen", KEEPS);
    let folder = place.path("history");
    let Some(_small) = Small::mount(&folder) else {
        eprintln!("not tested: no file system can be mounted here");
        return;
    };
    let mut subscriber = Subscriber::try_new(&place.service).unwrap();
    let mut daemon = place.start();
    drop(feed(&mut subscriber, port, 1..=2));
    eventually(&place, &[1, 2]);
    let ballast = folder.join("ballast");
    // as much as there is room for
    let _ = fs::File::create(&ballast).unwrap().write_all(&vec![0; 2 << 20]);
    let start = Instant::now();
    let mut next = 3;
    while !place.said().contains("history not written") {
        drop(feed(&mut subscriber, port, next..=next));
        next += 1;
        assert!(start.elapsed() < SOON, "{}", place.said());
    }
    assert!(place.said().contains("No space left on device"), "{}", place.said());
    fs::remove_file(&ballast).unwrap();
    while !place.said().contains("the history is written again") {
        drop(feed(&mut subscriber, port, next..=next));
        next += 1;
        assert!(start.elapsed() < 2 * SOON, "{}", place.said());
    }
    daemon.stop();
    let kept = sequences(&rows(&place, &[]));
    assert!(kept.starts_with(&[1, 2]) && kept.last() == Some(&u64::from(next - 1)), "{kept:?}");
    assert!(kept.is_sorted(), "{kept:?}");
}
