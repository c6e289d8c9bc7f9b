//! What the daemon and a measurement read: configurations, plans, journals, histories, checkpoints, and replies of the process that speaks
//! EPICS.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::sync::LazyLock;

use control::{Control, Epics, Journal, Plan, Setting};
use crc::{CRC_32_ISO_HDLC, Crc};
use host_bridge::config::Config;
use host_bridge::history::{self, Columns, Row, Span};
use host_bridge::source::queue::Faults;
use host_bridge::{Checkpoint, Head, Health, Model};
use results::Remarked;
use twin::Ring;

use super::packets::{CORES, hear_a_good_frame};
use super::{Target, file, repository, with_file};

pub(super) const TARGETS: [Target; 6] = [
    Target { name: "config", seeds: || vec![file("config/booster.toml")], read: config },
    Target { name: "plan", seeds: || vec![file("config/measure-booster.toml")], read: plan },
    Target { name: "journal", seeds: || vec![JOURNAL.clone()], read: journal },
    Target { name: "history", seeds: || vec![rows()], read: history },
    Target { name: "checkpoint", seeds: || vec![checkpoint_body()], read: checkpoint },
    Target { name: "epics", seeds: replies, read: epics },
];

const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);
const MODEL: Model = Model { tables: 1, setup: 2, layout: 3 };

static RING: LazyLock<Ring> = LazyLock::new(Ring::booster);
static PLAN: LazyLock<Plan> = LazyLock::new(|| {
    Plan::read(&repository().join("config/measure-booster.toml"), &RING).expect("a plan that ships with the repository")
});
static JOURNAL: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let folder = tempfile::tempdir().expect("the system has room for a file");
    let path = folder.path().join("journal");
    let mut journal = Journal::open(&path, &PLAN).expect("a new journal");
    journal.original(vec![Setting { channel: "BOOSTER:A2:SET".into(), value: 1.0 }]).expect("room for a line");
    journal.taken(PLAN.steps[0].clone(), Vec::new()).expect("room for a line");
    fs::read(&path).expect("it was written")
});

fn config(bytes: &[u8]) -> bool {
    with_file("config.toml", bytes, |path| Config::read(path).is_ok())
}

/// As `orbitcal measure --dry-run` before it asks the control system, and `orbitcal simulate` for a cycle.
fn plan(bytes: &[u8]) -> bool {
    with_file("plan.toml", bytes, |path| {
        fs::write(path.with_file_name("booster-header.toml"), file("config/booster-header.toml"))
            .expect("room for a file");
        let used = |plan: Plan| !plan.set_points().is_empty() | plan.channels.of_a_frame().is_empty();
        Plan::read(path, &RING).is_ok_and(used)
    })
}

/// As a measurement that resumes, and `orbitcal measure --restore`.
fn journal(bytes: &[u8]) -> bool {
    let restored = |path: &Path| Journal::existing(path).is_ok_and(|journal| journal.pending().is_some());
    let resumed = |path: &Path| Journal::open(path, &PLAN).is_ok_and(|journal| journal.frames().count() > 0);
    with_file("journal", bytes, restored) | with_file("journal", bytes, resumed)
}

fn rows() -> Vec<u8> {
    let columns = Columns { vars: vec!["A2".into(), "D8".into()], instruments: vec!["x_E4".into()] };
    let row = |number: u32| Row {
        time_ms: 1000 * u64::from(number),
        sequence: number,
        frames: number,
        is_usable: true,
        mismatch: false,
        chi_square: [1.0; 2],
        nis_per_reading: 1.0,
        vars: vec![[1.0, 0.1]; 2],
        states: vec![shared_memory::State::Ok],
    };
    (columns.header() + &(0..20).map(|number| row(number).line()).collect::<String>()).into_bytes()
}

/// As it stands, and with the check sum of every line made right.
fn history(bytes: &[u8]) -> bool {
    let sealed = |line: &[u8]| {
        let rest = &line[..line.iter().rposition(|byte| *byte == b',').unwrap_or(line.len())];
        [rest, format!(",{:08x}\n", CRC.checksum(rest)).as_bytes()].concat()
    };
    let mut lines = bytes.split(|byte| *byte == b'\n');
    let header = lines.next().unwrap_or_default();
    let sealed = [header, b"\n", &lines.flat_map(sealed).collect::<Vec<u8>>()].concat();
    let read = |path: &Path| history::read(path.parent().expect("it is in a folder"), &Span::default());
    let has_rows = |path: &Path| read(path).is_ok_and(|history| !history.rows.is_empty());
    with_file("fine-1.csv", bytes, has_rows) | with_file("fine-1.csv", &sealed, has_rows)
}

fn checkpoint_body() -> Vec<u8> {
    let mut state = Vec::new();
    CORES[1].clone().save(&mut state).expect("memory takes any state");
    let head = Head::new(MODEL, [7, 8], Remarked::default(), Faults::default(), Health::new(&[1e-4; 33], 48));
    let mut bytes = Checkpoint { head, state }.encode();
    bytes.truncate(bytes.len() - 4);
    bytes
}

/// With its check sum made right; a state that the core takes is used for a frame.
fn checkpoint(bytes: &[u8]) -> bool {
    let sealed = [bytes, &CRC.checksum(bytes).to_le_bytes()].concat();
    let Ok(checkpoint) = Checkpoint::decode(&sealed, &MODEL) else { return false };
    let mut core = CORES[0].clone();
    core.load(&checkpoint.state).is_ok() && hear_a_good_frame(&mut core)
}

fn replies() -> Vec<Vec<u8>> {
    let all: [&str; 4] = [
        r#"{"id": 1, "channels": [{"connected": true, "readable": true, "writable": true, "count": 1, "limits": [0.0, 1.0]}]}"#,
        r#"{"id": 1, "samples": [{"sample": {"value": [1.5], "time_s": 2.5, "invalid": false}}]}"#,
        r#"{"id": 1, "samples": [{"error": "no"}]}"#,
        r#"{"id": 1}"#,
    ];
    all.map(|line| format!("{line}\n").into_bytes()).to_vec()
}

/// The bytes as what the process says to a description, a reading and a setting.
fn epics(bytes: &[u8]) -> bool {
    with_file("reply", bytes, |path| {
        let program = path.with_file_name("program");
        fs::write(&program, format!("#!/bin/sh\nread request; cat '{}'\n", path.display())).expect("room for a file");
        fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).expect("its own file");
        let mut process = |_| Epics::start(&program, 1.0).expect("a program that is there");
        let [mut described, mut sampled, mut written] = [0, 1, 2].map(&mut process);
        let (described, sampled) = (described.describe(&["A"]), sampled.sample(&["A"]));
        described.is_ok() | sampled.is_ok() | written.write("A", 1.0).is_ok()
    })
}
