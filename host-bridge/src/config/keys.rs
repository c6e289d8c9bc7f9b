//! Every key of the configuration with its default, unit and range, and the check of a file against them.

use core::net::SocketAddr;

use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::{Lines, Problem};
use crate::source::origin::Origin;

/// A key.
#[derive(Debug)]
pub struct Key {
    pub section: &'static str,
    pub name: &'static str,
    /// What it is.
    pub doc: &'static str,
    /// The values that it may have, with their unit.
    pub range: &'static str,
    /// As it is written in TOML.
    pub default: Option<&'static str>,
    pub is_required: bool,
    kind: Kind,
}

/// Which values are right.
#[derive(Debug)]
enum Kind {
    Whole(i64, i64),
    Number(f64, f64),
    Text(fn(&str) -> bool),
    Flag,
    Names,
}

/// All of them, in the order of `config/booster.toml`.
pub const KEYS: &[Key] = &[
    Key {
        section: "machine",
        name: "file",
        doc: "Machine file; without it, the built-in AGS Booster",
        range: "a path",
        default: None,
        is_required: false,
        kind: Kind::Text(is_path),
    },
    Key {
        section: "machine",
        name: "recording",
        doc: "Recording whose header states calibration, noise and ramp, or that header alone",
        range: "a path",
        default: None,
        is_required: true,
        kind: Kind::Text(is_path),
    },
    Key {
        section: "machine",
        name: "model_file",
        doc: "Tables that a diagnosis has extended; without it, those of the design",
        range: "a path",
        default: None,
        is_required: false,
        kind: Kind::Text(is_path),
    },
    Key {
        section: "source",
        name: "address",
        doc: "Where raw frames come from: a socket, a serial line, a recording, shared memory or the channels of a measurement plan",
        range: "tcp://HOST:PORT, unix:PATH, serial:PATH[@BAUD], replay:RECORDING, iceoryx2:SERVICE or epics:PLAN.toml",
        default: None,
        is_required: true,
        kind: Kind::Text(is_origin),
    },
    Key {
        section: "source",
        name: "role",
        doc: "Whether the daemon connects to the front end's socket, or listens for it",
        range: "\"connect\" or \"listen\"",
        default: Some("\"connect\""),
        is_required: false,
        kind: Kind::Text(|word| ["connect", "listen"].contains(&word)),
    },
    Key {
        section: "source",
        name: "rate_hz",
        doc: "Rate at which a recording is replayed; 0 is as fast as the core takes its frames",
        range: "a number from 0 to 1000000 (Hz)",
        default: Some("0.0"),
        is_required: false,
        kind: Kind::Number(0.0, 1e6),
    },
    Key {
        section: "source",
        name: "timeout_ms",
        doc: "Silence after which the connection is given up",
        range: "a whole number from 100 to 600000 (ms)",
        default: Some("5000"),
        is_required: false,
        kind: Kind::Whole(100, 600_000),
    },
    Key {
        section: "source",
        name: "backoff_first_ms",
        doc: "First wait between two attempts to connect; each further one is twice as long",
        range: "a whole number from 10 to 60000 (ms)",
        default: Some("100"),
        is_required: false,
        kind: Kind::Whole(10, 60_000),
    },
    Key {
        section: "source",
        name: "backoff_most_ms",
        doc: "Longest wait between two attempts to connect",
        range: "a whole number from 10 to 600000 (ms)",
        default: Some("10000"),
        is_required: false,
        kind: Kind::Whole(10, 600_000),
    },
    Key {
        section: "source",
        name: "buffer_frames",
        doc: "Frames that may wait for the core",
        range: "a whole number from 1 to 100000 (frames)",
        default: Some("1000"),
        is_required: false,
        kind: Kind::Whole(1, 100_000),
    },
    Key {
        section: "source",
        name: "when_full",
        doc: "With a full buffer, the oldest frame of a line is dropped and counted, or the sender waits",
        range: "\"drop\" or \"wait\"",
        default: Some("\"drop\""),
        is_required: false,
        kind: Kind::Text(|word| ["drop", "wait"].contains(&word)),
    },
    Key {
        section: "source",
        name: "program",
        doc: "Program that speaks EPICS; one with a / in it is taken from the folder of the configuration",
        range: "a path",
        default: Some("\"orbitcal-epics-source\""),
        is_required: false,
        kind: Kind::Text(is_path),
    },
    Key {
        section: "source",
        name: "late_ms",
        doc: "How long a cycle of EPICS channels waits for values that are missing",
        range: "a whole number from 0 to 60000 (ms)",
        default: Some("200"),
        is_required: false,
        kind: Kind::Whole(0, 60_000),
    },
    Key {
        section: "walk",
        name: "params_per_root_second",
        doc: "Random walk of each ln var",
        range: "a number from 0 to 0.1 (1/sqrt(s))",
        default: Some("1.5e-4"),
        is_required: false,
        kind: Kind::Number(0.0, 0.1),
    },
    Key {
        section: "walk",
        name: "baselines_um_per_root_second",
        doc: "Random walk of the baseline of each monitor",
        range: "a number from 0 to 1000 (um/sqrt(s))",
        default: Some("2.0"),
        is_required: false,
        kind: Kind::Number(0.0, 1000.0),
    },
    Key {
        section: "publish",
        name: "service",
        doc: "Shared-memory service of the estimates",
        range: NAME,
        default: Some("\"orbitcal/estimate\""),
        is_required: false,
        kind: Kind::Text(is_name),
    },
    Key {
        section: "publish",
        name: "name",
        doc: "Name of the publisher, which `orbitcal watch` shows",
        range: NAME,
        default: Some("\"orbitcal\""),
        is_required: false,
        kind: Kind::Text(is_name),
    },
    Key {
        section: "publish",
        name: "frames",
        doc: "Shared-memory service of the raw frames that were taken; without it, they are not published",
        range: NAME,
        default: None,
        is_required: false,
        kind: Kind::Text(is_name),
    },
    Key {
        section: "feedback",
        name: "on",
        doc: "Whether the orbit feedback is on from the start: set points of the correctors are computed and published",
        range: "true or false",
        default: Some("false"),
        is_required: false,
        kind: Kind::Flag,
    },
    Key {
        section: "feedback",
        name: "correctors",
        doc: "Correctors that the feedback moves; without it, all",
        range: "names of correctors",
        default: None,
        is_required: false,
        kind: Kind::Names,
    },
    Key {
        section: "feedback",
        name: "orbit_file",
        doc: "Wanted readings in mm as JSON, such as {\"x_C6\": 1.5}, 0 of monitors that are not named; without it, all 0",
        range: "a path",
        default: None,
        is_required: false,
        kind: Kind::Text(is_path),
    },
    Key {
        section: "feedback",
        name: "limit_A",
        doc: "Largest current of a corrector",
        range: "a number from 0.001 to 10000 (A)",
        default: Some("20.0"),
        is_required: false,
        kind: Kind::Number(0.001, 1e4),
    },
    Key {
        section: "feedback",
        name: "rate_A",
        doc: "Largest change of a set point in a frame",
        range: "a number from 0.001 to 10000 (A)",
        default: Some("2.0"),
        is_required: false,
        kind: Kind::Number(0.001, 1e4),
    },
    Key {
        section: "feedback",
        name: "probe_A",
        doc: "By how much each corrector is moved while the model is in doubt",
        range: "a number from 0 to 1000 (A)",
        default: Some("1.0"),
        is_required: false,
        kind: Kind::Number(0.0, 1e3),
    },
    Key {
        section: "feedback",
        name: "close_A",
        doc: "Read-backs this close to their set points follow them",
        range: "a number from 0.0001 to 1000 (A)",
        default: Some("0.3"),
        is_required: false,
        kind: Kind::Number(1e-4, 1e3),
    },
    Key {
        section: "feedback",
        name: "step_mrad",
        doc: "Kick in a frame that costs as much as an orbit of one standard deviation at one monitor",
        range: "a number from 0.00001 to 100 (mrad)",
        default: Some("0.02"),
        is_required: false,
        kind: Kind::Number(1e-5, 100.0),
    },
    Key {
        section: "feedback",
        name: "total_mrad",
        doc: "The same of the whole kick of a corrector",
        range: "a number from 0.00001 to 100 (mrad)",
        default: Some("1.0"),
        is_required: false,
        kind: Kind::Number(1e-5, 100.0),
    },
    Key {
        section: "feedback",
        name: "walk_um_per_root_second",
        doc: "Random walk of the orbit by itself at a monitor",
        range: "a number from 0.001 to 100000 (um/sqrt(s))",
        default: Some("5.0"),
        is_required: false,
        kind: Kind::Number(0.001, 1e5),
    },
    Key {
        section: "feedback",
        name: "patience_ms",
        doc: "Frames further apart than this do not belong together",
        range: "a whole number from 1 to 3600000 (ms)",
        default: Some("2000"),
        is_required: false,
        kind: Kind::Whole(1, 3_600_000),
    },
    Key {
        section: "requests",
        name: "snapshot",
        doc: "Whether a checkpoint of now may be asked for, which changes nothing",
        range: "true or false",
        default: Some("true"),
        is_required: false,
        kind: Kind::Flag,
    },
    Key {
        section: "requests",
        name: "reset",
        doc: "Whether the core may be put back to its prior",
        range: "true or false",
        default: Some("false"),
        is_required: false,
        kind: Kind::Flag,
    },
    Key {
        section: "requests",
        name: "model",
        doc: "Whether the daemon's tables may be changed for those of a file",
        range: "true or false",
        default: Some("false"),
        is_required: false,
        kind: Kind::Flag,
    },
    Key {
        section: "requests",
        name: "feedback",
        doc: "Whether the orbit feedback may be switched on and off",
        range: "true or false",
        default: Some("false"),
        is_required: false,
        kind: Kind::Flag,
    },
    Key {
        section: "checkpoint",
        name: "file",
        doc: "Checkpoint; without it, every start is at the prior",
        range: "a path",
        default: None,
        is_required: false,
        kind: Kind::Text(is_path),
    },
    Key {
        section: "checkpoint",
        name: "checkpoint_every_frames",
        doc: "Frames from one checkpoint to the next",
        range: "a whole number from 1 to 1000000000 (frames)",
        default: Some("1000"),
        is_required: false,
        kind: Kind::Whole(1, 1_000_000_000),
    },
    Key {
        section: "history",
        name: "folder",
        doc: "Folder of the history of estimates, made if it is not there; without it, none is kept",
        range: "a path",
        default: None,
        is_required: false,
        kind: Kind::Text(is_path),
    },
    Key {
        section: "history",
        name: "fine_ms",
        doc: "An estimate is left out of the history if the one before in it is not as old as this",
        range: "a whole number from 1 to 60000 (ms)",
        default: Some("100"),
        is_required: false,
        kind: Kind::Whole(1, 60_000),
    },
    Key {
        section: "history",
        name: "fine_hours",
        doc: "How long all others are kept",
        range: "a whole number from 1 to 744 (h)",
        default: Some("1"),
        is_required: false,
        kind: Kind::Whole(1, 744),
    },
    Key {
        section: "history",
        name: "minutes_days",
        doc: "How long one a minute is kept",
        range: "a whole number from 1 to 3653 (days)",
        default: Some("31"),
        is_required: false,
        kind: Kind::Whole(1, 3653),
    },
    Key {
        section: "history",
        name: "hours_days",
        doc: "How long one an hour is kept",
        range: "a whole number from 1 to 36525 (days)",
        default: Some("1826"),
        is_required: false,
        kind: Kind::Whole(1, 36_525),
    },
    Key {
        section: "page",
        name: "address",
        doc: "Where the live page and the metrics are served; without it, they are not",
        range: "a loopback address and a port, as 127.0.0.1:9464",
        default: None,
        is_required: false,
        kind: Kind::Text(is_loopback),
    },
    Key {
        section: "logs",
        name: "form",
        doc: "Form of what is said on stderr",
        range: "\"plain\" or \"json\"",
        default: Some("\"plain\""),
        is_required: false,
        kind: Kind::Text(|word| ["plain", "json"].contains(&word)),
    },
];

const NAME: &str = "1 to 127 printable ASCII characters, not beginning with iox2://";

fn is_path(text: &str) -> bool {
    !text.is_empty()
}

fn is_origin(text: &str) -> bool {
    match text.parse::<Origin>() {
        Ok(Origin::SharedMemory(service)) => is_name(&service),
        origin => origin.is_ok(),
    }
}

fn is_loopback(text: &str) -> bool {
    text.parse().is_ok_and(|address: SocketAddr| address.ip().is_loopback())
}

fn is_name(text: &str) -> bool {
    let is_printable = text.chars().all(|c| (' '..='~').contains(&c));
    (1..=127).contains(&text.len()) && is_printable && !text.starts_with("iox2://")
}

impl Kind {
    fn allows(&self, value: &DeValue<'_>) -> bool {
        match (self, value) {
            (Self::Whole(low, high), DeValue::Integer(number)) => {
                i64::from_str_radix(number.as_str(), number.radix()).is_ok_and(|v| (*low..=*high).contains(&v))
            }
            (Self::Number(low, high), DeValue::Integer(number)) => {
                i64::from_str_radix(number.as_str(), number.radix()).is_ok_and(|v| (*low..=*high).contains(&(v as f64)))
            }
            (Self::Number(low, high), DeValue::Float(number)) => {
                number.as_str().parse().is_ok_and(|v: f64| (*low..=*high).contains(&v))
            }
            (Self::Flag, DeValue::Boolean(_)) => true,
            (Self::Names, DeValue::Array(names)) => {
                !names.is_empty() && names.iter().all(|name| matches!(name.get_ref(), DeValue::String(_)))
            }
            (Self::Text(is_right), DeValue::String(text)) => is_right(text),
            _ => false,
        }
    }
}

/// Everything that is wrong with the values of a file.
pub(super) fn check(lines: &Lines<'_>, file: &DeTable<'_>) -> Vec<Problem> {
    let mut problems = missing(file);
    for (section, value) in file {
        let name: &str = section.get_ref();
        let at = lines.line(section.span().start);
        let problem = |what| Problem { line: at, what };
        match value.get_ref() {
            _ if KEYS.iter().all(|key| key.section != name) => {
                problems.push(problem(format!("{name}: no such section")))
            }
            DeValue::Table(table) => {
                problems.extend(table.iter().filter_map(|(key, value)| wrong(lines, name, key, value)))
            }
            _ => problems.push(problem(format!("{name} = {}: expected a section", written(lines, value)))),
        }
    }
    problems
}

/// The keys without which there is no daemon.
fn missing(file: &DeTable<'_>) -> Vec<Problem> {
    let has = |key: &Key| {
        let section = file.iter().find(|(name, _)| name.get_ref() == key.section);
        let table = section.and_then(|(_, value)| value.get_ref().as_table());
        table.is_some_and(|table| table.iter().any(|(name, _)| name.get_ref() == key.name))
    };
    let absent = KEYS.iter().filter(|key| key.is_required && !has(key));
    let what = |key: &Key| format!("{}.{} is missing: {}, {}", key.section, key.name, key.doc, key.range);
    absent.map(|key| Problem { line: 0, what: what(key) }).collect()
}

fn wrong(
    lines: &Lines<'_>,
    section: &str,
    name: &Spanned<impl AsRef<str>>,
    value: &Spanned<DeValue<'_>>,
) -> Option<Problem> {
    let (at, name) = (lines.line(name.span().start), name.get_ref().as_ref());
    let Some(key) = KEYS.iter().find(|key| key.section == section && key.name == name) else {
        return Some(Problem { line: at, what: format!("{section}.{name}: no such key") });
    };
    let default = key.default.map_or_else(String::new, |default| format!("; default {default}"));
    let what = || format!("{section}.{name} = {}: expected {}{default}", written(lines, value), key.range);
    (!key.kind.allows(value.get_ref())).then(|| Problem { line: at, what: what() })
}

/// A value as it is written.
fn written<'t>(lines: &Lines<'t>, value: &Spanned<DeValue<'_>>) -> &'t str {
    lines.text.get(value.span()).unwrap_or_default()
}
