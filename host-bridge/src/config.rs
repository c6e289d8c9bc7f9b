//! What an operator may change of the daemon: one TOML file. `config/booster.toml` shows every key; `config/keys.rs` their ranges.

mod feedback;
mod keys;

use core::fmt;
use core::net::SocketAddr;
use core::time::Duration;
use std::path::{Path, PathBuf};

use results::CommandError;
use serde::Deserialize;
use toml::de::DeTable;
use twin::limits::SETTINGS;

pub use feedback::Feedback;

use shared_memory::{PUBLISHER, SERVICE};

use crate::history::Plan;
use crate::logs::Form;
use crate::source::Rate;
use crate::source::origin::Origin;

/// The daemon's configuration.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Which ring, and how it is calibrated.
    pub machine: Machine,
    /// Where frames come from.
    pub source: Source,
    /// How fast what is estimated may change.
    #[serde(default)]
    pub walk: Walk,
    /// Where estimates go.
    #[serde(default)]
    pub publish: Publish,
    /// What is wanted of the orbit.
    #[serde(default)]
    pub feedback: Feedback,
    /// What may be asked of the running daemon.
    #[serde(default)]
    pub requests: Requests,
    /// What a restart begins with.
    #[serde(default)]
    pub checkpoint: Checkpoint,
    /// What is kept of the estimates.
    #[serde(default)]
    pub history: History,
    /// The live page and the metrics.
    #[serde(default)]
    pub page: Page,
    /// What is said on stderr.
    #[serde(default)]
    pub logs: Logs,
}

/// `[machine]`
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Machine {
    /// Machine file; none is the built-in AGS Booster.
    pub file: Option<PathBuf>,
    /// Recording whose header has calibration, noise and ramp.
    pub recording: PathBuf,
    /// Tables of a machine with the physics that a diagnosis found.
    pub model_file: Option<PathBuf>,
}

/// Who connects to whom.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// The daemon connects to the front end.
    Connect,
    /// The front end connects to the daemon.
    Listen,
}

/// What is done with a frame for which the buffer has no room.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum WhenFull {
    /// The oldest in the buffer is dropped: estimates are of now.
    Drop,
    /// Whoever sends it waits: no frame is lost.
    Wait,
}

/// `[source]`
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Source {
    /// Line, recording or shared memory.
    #[serde(deserialize_with = "origin")]
    pub address: Origin,
    /// Who connects a socket.
    #[serde(default = "default_role")]
    pub role: Role,
    /// Frames a second of a recording; 0 is as fast as possible [Hz].
    #[serde(default)]
    rate_hz: f64,
    /// Silence after which a connection is given up [ms].
    #[serde(default = "default_timeout_ms")]
    timeout_ms: u64,
    /// First wait between two attempts to connect; each further one is twice as long [ms].
    #[serde(default = "default_backoff_first_ms")]
    backoff_first_ms: u64,
    /// Longest wait between two attempts [ms].
    #[serde(default = "default_backoff_most_ms")]
    backoff_most_ms: u64,
    /// Frames that wait for the core.
    #[serde(default = "default_buffer_frames")]
    pub buffer_frames: usize,
    /// What is done with one for which there is no room.
    #[serde(default = "default_when_full")]
    pub when_full: WhenFull,
    /// Program that speaks EPICS.
    #[serde(default = "default_program")]
    pub program: PathBuf,
    /// How long a cycle waits for values that are missing [ms].
    #[serde(default = "default_late_ms")]
    late_ms: u64,
}

fn default_program() -> PathBuf {
    "orbitcal-epics-source".into()
}

fn default_late_ms() -> u64 {
    200
}

fn default_role() -> Role {
    Role::Connect
}

fn default_when_full() -> WhenFull {
    WhenFull::Drop
}

fn default_timeout_ms() -> u64 {
    5_000
}

fn default_backoff_first_ms() -> u64 {
    100
}

fn default_backoff_most_ms() -> u64 {
    10_000
}

fn default_buffer_frames() -> usize {
    1_000
}

impl Source {
    /// Silence after which a connection is given up.
    pub fn timeout(&self) -> Duration {
        Duration::from_millis(self.timeout_ms)
    }

    /// How long a cycle of a control system waits for values that are missing [s].
    pub fn late(&self) -> f64 {
        Duration::from_millis(self.late_ms).as_secs_f64()
    }

    /// How fast a recording is replayed.
    pub fn rate(&self) -> Rate {
        if self.rate_hz == 0.0 { Rate::Max } else { Rate::Hertz(self.rate_hz) }
    }

    /// First and longest wait between two attempts to connect.
    pub fn backoff(&self) -> [Duration; 2] {
        [self.backoff_first_ms, self.backoff_most_ms].map(Duration::from_millis)
    }
}

/// `[walk]`
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Walk {
    /// Of each `ln var`, in the root of a second [1].
    params_per_root_second: f32,
    /// Of each baseline, in the root of a second [um].
    baselines_um_per_root_second: f32,
}

impl Default for Walk {
    fn default() -> Self {
        Self { params_per_root_second: 1.5e-4, baselines_um_per_root_second: 2.0 }
    }
}

impl From<Walk> for estimator::Walk {
    fn from(walk: Walk) -> Self {
        Self { params: walk.params_per_root_second, baselines: walk.baselines_um_per_root_second * 1e-6 }
    }
}

/// `[publish]`
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Publish {
    /// Shared-memory service.
    pub service: String,
    /// Publisher, which `orbitcal watch` shows.
    pub name: String,
    /// Shared-memory service of the raw frames that were taken; none, and they are not published.
    pub frames: Option<String>,
}

impl Default for Publish {
    fn default() -> Self {
        Self { service: SERVICE.into(), name: PUBLISHER.into(), frames: None }
    }
}

/// `[requests]`
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Requests {
    /// A checkpoint may be asked for: that changes nothing.
    pub snapshot: bool,
    /// The core may be put back to its prior.
    pub reset: bool,
    /// The tables may be changed.
    pub model: bool,
    /// The orbit feedback may be switched on and off.
    pub feedback: bool,
}

impl Default for Requests {
    fn default() -> Self {
        Self { snapshot: true, reset: false, model: false, feedback: false }
    }
}

/// `[checkpoint]`
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Checkpoint {
    /// The file; none, and every start is at the prior.
    pub file: Option<PathBuf>,
    /// Frames from one checkpoint to the next.
    pub checkpoint_every_frames: u32,
}

impl Default for Checkpoint {
    fn default() -> Self {
        Self { file: None, checkpoint_every_frames: 1_000 }
    }
}

/// `[history]`
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct History {
    /// Its folder; none, and nothing is kept.
    pub folder: Option<PathBuf>,
    /// An estimate is left out if the one before is not as old as this [ms].
    fine_ms: u64,
    /// How long these are kept [h].
    fine_hours: u64,
    /// How long one a minute is kept [d].
    minutes_days: u64,
    /// How long one an hour is kept [d].
    hours_days: u64,
}

impl Default for History {
    fn default() -> Self {
        Self { folder: None, fine_ms: 100, fine_hours: 1, minutes_days: 31, hours_days: 1826 }
    }
}

impl History {
    /// What is kept of it.
    pub fn plan(&self) -> Plan {
        Plan::new(Duration::from_millis(self.fine_ms), self.fine_hours, [self.minutes_days, self.hours_days])
    }
}

/// `[page]`
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Page {
    /// Loopback address on which it is served; none, and there is none.
    pub address: Option<SocketAddr>,
}

/// `[logs]`
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Logs {
    /// Form of a line on stderr.
    pub form: Form,
}

impl Default for Logs {
    fn default() -> Self {
        Self { form: Form::Plain }
    }
}

fn origin<'de, D: serde::Deserializer<'de>>(value: D) -> Result<Origin, D::Error> {
    String::deserialize(value)?.parse().map_err(serde::de::Error::custom)
}

/// What is wrong with a configuration, all of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConfigError {
    file: PathBuf,
    problems: Vec<Problem>,
}

/// One thing that is wrong.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Problem {
    /// Counted from 1; 0 where no line is at fault.
    line: usize,
    what: String,
}

/// A line for each problem, in the order of the file.
impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let file = self.file.display();
        for (i, Problem { line, what }) in self.problems.iter().enumerate() {
            let end = if i == 0 { "" } else { "\n" };
            let line = if *line == 0 { String::new() } else { format!(", line {line}") };
            write!(f, "{end}{file}{line}: {what}")?;
        }
        Ok(())
    }
}

impl core::error::Error for ConfigError {}

impl Config {
    /// Read a configuration; its paths are taken from the folder that it is in.
    ///
    /// # Errors
    /// [`ConfigError`] with everything that is wrong.
    pub fn read(file: &Path) -> Result<Self, ConfigError> {
        let unread = |reason: std::io::Error| vec![Problem { line: 0, what: reason.to_string() }];
        let parsed = SETTINGS.text(file).map_err(unread).and_then(|text| Self::parse(&text));
        let mut config = parsed.map_err(|problems| ConfigError { file: file.to_owned(), problems })?;
        let folder = file.parent().unwrap_or(Path::new(""));
        let Self { machine, source, checkpoint, feedback, history, .. } = &mut config;
        let replayed = match &mut source.address {
            Origin::Recording(path) | Origin::Epics(path) => Some(path),
            Origin::Line(_) | Origin::SharedMemory(_) => None,
        };
        if source.program.components().count() > 1 {
            source.program = folder.join(&source.program);
        }
        let optional = [
            &mut machine.file,
            &mut machine.model_file,
            &mut checkpoint.file,
            &mut feedback.orbit_file,
            &mut history.folder,
        ];
        let paths = optional.into_iter().flatten().chain([&mut machine.recording]).chain(replayed);
        paths.for_each(|path| *path = folder.join(&*path));
        Ok(config)
    }

    fn parse(text: &str) -> Result<Self, Vec<Problem>> {
        let lines = Lines::new(text);
        let (table, errors) = DeTable::parse_recoverable(text);
        let mut problems: Vec<Problem> = errors.iter().map(|error| of_toml(&lines, error)).collect();
        if problems.is_empty() {
            problems = keys::check(&lines, table.get_ref());
        }
        if problems.is_empty() {
            let config: Self = toml::from_str(text).map_err(|error| vec![of_toml(&lines, &error)])?;
            return config.expect_no_circle();
        }
        problems.sort();
        Err(problems)
    }
}

impl Config {
    /// Frames that are published do not come back as those of a front end.
    fn expect_no_circle(self) -> Result<Self, Vec<Problem>> {
        match (&self.source.address, &self.publish.frames) {
            (Origin::SharedMemory(from), Some(to)) if from == to => {
                let what = format!("publish.frames = {to:?}: the frames of source.address come from there");
                Err(vec![Problem { line: 0, what }])
            }
            _ => Ok(self),
        }
    }
}

fn of_toml(lines: &Lines<'_>, error: &toml::de::Error) -> Problem {
    Problem { line: error.span().map_or(0, |span| lines.line(span.start)), what: error.message().to_owned() }
}

/// A text and where its lines end: a file may have as many problems as bytes, and none of them counts the lines anew.
struct Lines<'t> {
    text: &'t str,
    ends: Vec<usize>,
}

impl<'t> Lines<'t> {
    fn new(text: &'t str) -> Self {
        Self { text, ends: text.match_indices('\n').map(|(at, _)| at).collect() }
    }

    /// Line of a byte, counted from 1.
    fn line(&self, at: usize) -> usize {
        1 + self.ends.partition_point(|end| *end < at)
    }
}

impl From<ConfigError> for CommandError {
    fn from(error: ConfigError) -> Self {
        Self::Input(error.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EXAMPLE: &str = include_str!("../../config/booster.toml");
    const DOCS: &str = include_str!("../../docs/daemon.md");
    const LEAST: &str = "[machine]\nrecording = \"night\"\n[source]\naddress = \"tcp://:5000\"\n";

    fn said(text: &str) -> Vec<String> {
        let problems = Config::parse(text).unwrap_err();
        problems.into_iter().map(|Problem { line, what }| format!("{line}: {what}")).collect()
    }

    #[test]
    fn every_wrong_value_is_said_at_once_with_key_range_and_line() {
        let text = "[machine]\nfile = 3\n[source]\naddress = \"serial:\"\nrole = \"both\"\ntimeout_ms = 0\n\
                    buffer_frame = 7\n[walk]\nparams_per_root_second = nan\n[publish]\nservice = \"\"\n\
                    [page]\naddress = \"0.0.0.0:80\"\n[graphs]\ncolour = 1\n";
        assert_eq!(
            said(text),
            [
                "0: machine.recording is missing: Recording whose header states calibration, noise and ramp, or that header alone, a path",
                "2: machine.file = 3: expected a path",
                "4: source.address = \"serial:\": expected tcp://HOST:PORT, unix:PATH, serial:PATH[@BAUD], replay:RECORDING, \
                 iceoryx2:SERVICE or epics:PLAN.toml",
                "5: source.role = \"both\": expected \"connect\" or \"listen\"; default \"connect\"",
                "6: source.timeout_ms = 0: expected a whole number from 100 to 600000 (ms); default 5000",
                "7: source.buffer_frame: no such key",
                "9: walk.params_per_root_second = nan: expected a number from 0 to 0.1 (1/sqrt(s)); default 1.5e-4",
                "11: publish.service = \"\": expected 1 to 127 printable ASCII characters, not beginning with iox2://; default \
                 \"orbitcal/estimate\"",
                "13: page.address = \"0.0.0.0:80\": expected a loopback address and a port, as 127.0.0.1:9464",
                "14: graphs: no such section",
            ]
        );
    }

    #[test]
    fn frames_do_not_go_where_they_come_from() {
        let text = LEAST.replace("tcp://:5000", "iceoryx2:a") + "[publish]\nframes = \"a\"\n";
        assert_eq!(said(&text), ["0: publish.frames = \"a\": the frames of source.address come from there"]);
        assert!(Config::parse(&text.replace("frames = \"a\"", "frames = \"b\"")).is_ok());
    }

    #[test]
    fn text_that_is_no_toml_is_said_with_its_line() {
        let problems = said("[machine]\nrecording = \n");
        assert!(problems[0].starts_with("2: "), "{problems:?}");
        assert_eq!(said("machine = 3\n[source]\n")[2], "1: machine = 3: expected a section");
        assert_eq!(said("").len(), 2);
    }

    /// A text of the most bytes, all of it wrong: 80,000 problems, each with its line.
    #[test]
    fn problems_without_number_are_said_with_their_lines() {
        let text = "[machine]\n".to_owned() + &"a = 1\na = 2\n".repeat(80_000);
        let problems = said(&text);
        assert!(problems.len() >= 80_000);
        assert_eq!(problems.last().unwrap(), "160001: duplicate key");
    }

    #[test]
    fn what_is_left_out_has_the_default_that_is_stated() {
        let written: String =
            ["machine", "source", "walk", "publish", "feedback", "requests", "checkpoint", "history", "page", "logs"]
                .iter()
                .map(|section| {
                    let own = keys::KEYS.iter().filter(|key| key.section == *section);
                    let lines: String =
                        own.filter_map(|key| Some(format!("{} = {}\n", key.name, key.default?))).collect();
                    format!("[{section}]\n{lines}")
                })
                .collect();
        let required = written
            .replace("[machine]\n", "[machine]\nrecording = \"night\"\n")
            .replace("[source]\n", "[source]\naddress = \"tcp://:5000\"\n");
        assert_eq!(Config::parse(&required), Config::parse(LEAST));
        assert!(Config::parse(LEAST).is_ok());
        let walk = Config::parse(LEAST).unwrap().walk;
        assert_eq!(estimator::Walk::from(walk), inference::stream::FOLLOW);
    }

    #[test]
    fn the_example_and_the_documentation_have_every_key_with_default_unit_and_range() {
        Config::parse(EXAMPLE).unwrap();
        for key in keys::KEYS {
            let default = key.default.unwrap_or(if key.is_required { "required" } else { "none" });
            let comment = format!("# {} ({}; default: {default})\n", key.doc, key.range);
            assert!(EXAMPLE.contains(&comment), "{comment}");
            let default = if key.default.is_some() { format!("`{default}`") } else { default.to_owned() };
            let row = format!("| `{}.{}` | {} | {} | {default} |\n", key.section, key.name, key.doc, key.range);
            assert!(DOCS.contains(&row), "{row}");
        }
    }

    #[test]
    fn paths_are_taken_from_the_folder_of_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a.toml");
        std::fs::write(&file, format!("{LEAST}[checkpoint]\nfile = \"/var/lib/c\"\n")).unwrap();
        let config = Config::read(&file).unwrap();
        assert_eq!(config.machine.recording, folder.path().join("night"));
        assert_eq!(config.checkpoint.file.as_deref(), Some(Path::new("/var/lib/c")));
        let missing = Config::read(&folder.path().join("b.toml")).unwrap_err().to_string();
        assert!(missing.contains("b.toml: No such file"), "{missing}");
    }
}
