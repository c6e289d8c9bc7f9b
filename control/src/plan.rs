//! `PLAN.toml`: what is measured, by which channels, within which limits. The page is `docs/control-system.md`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use inference::RecordingError;
use inference::recording::{Format, Header, Names};
use serde::{Deserialize, Serialize};
use twin::Ring;
use twin::limits::{FINITE, FRAMES, NOT_NEGATIVE, Range, SECONDS, SETTINGS};

use crate::step::Step;

/// A plan whose names are those of the machine and whose numbers are in their ranges.
#[derive(Debug, Clone)]
pub struct Plan {
    /// Header of the recording that is made.
    pub header: Header,
    /// Its file as it stands.
    pub header_text: String,
    /// Channels of the control system.
    pub channels: Channels,
    /// Correctors of the machine by the names of recordings `[C]`.
    pub corrector_names: Vec<String>,
    /// Settings in their order.
    pub steps: Vec<Step>,
    /// Frames of each setting.
    pub repeats: usize,
    /// Time in the cycle at which orbits are read [s].
    pub cycle_time: f64,
    /// Correctors: largest distance of a read-back from its set point [A].
    pub corrector_tolerance: f64,
    /// Smallest and largest current that is written [A].
    pub corrector_limits: [f64; 2],
    /// The same of the RF frequency [Hz].
    pub rf_tolerance: f64,
    /// Smallest and largest RF frequency that is written [Hz].
    pub rf_limits: [f64; 2],
    /// RF frequency whose offset is 0 in a live frame [Hz]; without one it always is.
    pub rf_nominal: Option<f64>,
    /// How long a read-back stays at its set point before frames are taken [s].
    pub settle: f64,
    /// How long is waited for anything [s].
    pub timeout: f64,
    /// Largest difference between the time stamps of one cycle [s].
    pub match_window: f64,
}

/// Names of channels.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Channels {
    /// Counts machine cycles; its time stamp is the cycle's.
    pub cycle: String,
    /// Waveforms of the horizontal and vertical monitors.
    pub monitors: [Waveform; 2],
    /// Set points of the correctors `[C]`.
    pub corrector_set: Vec<String>,
    /// Read-backs of the correctors `[C]`.
    pub corrector_read: Vec<String>,
    /// Read-backs of the quadrupole supplies `[F]`.
    pub supply_read: Vec<String>,
    /// Read-back of the dipoles.
    pub dipole_read: Option<String>,
    /// Set point and read-back of the RF frequency.
    pub rf: Option<[String; 2]>,
    /// Fractional tunes x and y.
    pub tunes: Option<[String; 2]>,
}

/// Monitors that one channel holds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Waveform {
    /// The channel.
    pub name: String,
    /// Which read monitor of the machine each number belongs to.
    pub monitors: Vec<usize>,
}

/// What is wrong with a plan.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlanError {
    /// The file cannot be read.
    #[error("{}: {}", .0.display(), .1)]
    Unreadable(PathBuf, String),
    /// It is not written as a plan is.
    #[error("{}, line {line}: {what}", .file.display())]
    Written {
        /// The plan.
        file: PathBuf,
        /// Where.
        line: usize,
        /// What.
        what: String,
    },
    /// Some of its values cannot be.
    #[error("{}: {}", .0.display(), .1.join("; "))]
    Values(PathBuf, Vec<String>),
    /// Its header is none.
    #[error(transparent)]
    Header(#[from] RecordingError),
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PlanFile {
    header: PathBuf,
    channels: ChannelsFile,
    correctors: CorrectorsFile,
    rf: Option<RfFile>,
    frames: FramesFile,
    timing: TimingFile,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ChannelsFile {
    cycle: String,
    x_mm: String,
    y_mm: String,
    x_monitors: Option<Vec<String>>,
    y_monitors: Option<Vec<String>>,
    #[serde(rename = "corrector_set_A")]
    corrector_set: String,
    #[serde(rename = "corrector_read_A")]
    corrector_read: String,
    #[serde(rename = "supply_read_A")]
    supply_read: String,
    #[serde(rename = "dipole_read_A")]
    dipole_read: Option<String>,
    #[serde(rename = "rf_set_Hz")]
    rf_set: Option<String>,
    #[serde(rename = "rf_read_Hz")]
    rf_read: Option<String>,
    tune_x: Option<String>,
    tune_y: Option<String>,
    #[serde(default)]
    devices: BTreeMap<String, String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CorrectorsFile {
    measure: Option<Vec<String>>,
    #[serde(default)]
    skip: Vec<String>,
    #[serde(rename = "amplitude_A")]
    amplitude: f64,
    #[serde(rename = "limits_A")]
    limits: [f64; 2],
    #[serde(rename = "tolerance_A")]
    tolerance: f64,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RfFile {
    steps_relative: Vec<f64>,
    #[serde(rename = "limits_Hz")]
    limits: [f64; 2],
    #[serde(rename = "tolerance_Hz")]
    tolerance: f64,
    #[serde(rename = "nominal_Hz")]
    nominal: Option<f64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct FramesFile {
    repeats: usize,
    time_in_cycle_ms: f64,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct TimingFile {
    settle_s: f64,
    timeout_s: f64,
    match_window_s: f64,
}

/// Currents that are set and told apart.
const AMPERES: Range = Range::new(1e-6, 1e6, "A");
/// Frequencies, and steps of them.
const HERTZ: Range = Range::new(1e-6, 1e12, "Hz");

/// What stands for the name of a device in a channel's name.
const DEVICE: &str = "{device}";

impl Plan {
    /// Read a plan and the header that it names, relative to itself.
    ///
    /// # Errors
    /// [`PlanError`]; values that cannot be are all told at once.
    pub fn read(file: &Path, ring: &Ring) -> Result<Self, PlanError> {
        let unreadable =
            |path: &Path, error: std::io::Error| PlanError::Unreadable(path.into(), twin::unreadable(&error));
        let text = SETTINGS.text(file).map_err(|error| unreadable(file, error))?;
        let plan: PlanFile = toml::from_str(&text).map_err(|error| written(file, &text, &error))?;
        let header_file = file.parent().unwrap_or(Path::new("")).join(&plan.header);
        let header = Header::read(&header_file, ring)?;
        let header_text = SETTINGS.text(&header_file).map_err(|error| unreadable(&header_file, error))?;
        let mut check = Check { ring, names: Names::from_ring(ring), wrong: Vec::new() };
        check.expect(header.format == Format::Two, || format!("{}: expected format = 2", header_file.display()));
        let resolved = check.plan(&plan, header, header_text);
        if check.wrong.is_empty() { Ok(resolved) } else { Err(PlanError::Values(file.into(), check.wrong)) }
    }
}

fn written(file: &Path, text: &str, error: &toml::de::Error) -> PlanError {
    let before = &text[..error.span().map_or(0, |span| span.start).min(text.len())];
    let what = error.message().replace('\n', " ");
    PlanError::Written { file: file.into(), line: 1 + before.matches('\n').count(), what }
}

/// A plan being resolved, and what was found wrong so far.
struct Check<'r> {
    ring: &'r Ring,
    names: Names,
    wrong: Vec<String>,
}

impl Check<'_> {
    fn expect(&mut self, holds: bool, otherwise: impl FnOnce() -> String) {
        if !holds {
            self.wrong.push(otherwise());
        }
    }

    fn within(&mut self, range: Range, key: &str, value: f64) {
        self.wrong.extend(range.check(value).err().map(|problem| format!("{key}: {problem}")));
    }

    fn plan(&mut self, file: &PlanFile, header: Header, header_text: String) -> Plan {
        let channels = self.channels(&file.channels, header.nominal_dipole.is_some());
        let correctors = self.correctors(&file.correctors);
        let timing = &file.timing;
        self.within(SECONDS, "timing.settle_s", timing.settle_s);
        self.within(SECONDS, "timing.timeout_s", timing.timeout_s);
        self.within(SECONDS, "timing.match_window_s", timing.match_window_s);
        let time = file.frames.time_in_cycle_ms;
        self.within(NOT_NEGATIVE, "frames.time_in_cycle_ms", time);
        let mut steps = correctors;
        if let Some(rf) = &file.rf {
            self.expect(channels.rf.is_some(), || "rf: expected channels.rf_set_Hz and rf_read_Hz".into());
            steps.extend(self.rf(rf));
        }
        self.expect(!steps.is_empty(), || "correctors.measure: expected a corrector or RF steps, found none".into());
        let repeats = file.frames.repeats;
        self.expect(repeats > 0, || "frames.repeats: expected 1 or more, found 0".into());
        let frames = FRAMES.check((steps.len() as u64).saturating_mul(repeats as u64));
        self.wrong.extend(frames.err().map(|exceeded| format!("frames.repeats: {exceeded}")));
        let rf = file.rf.as_ref();
        Plan {
            header,
            header_text,
            channels,
            corrector_names: self.names.correctors.clone(),
            steps,
            repeats,
            cycle_time: time / 1000.0,
            corrector_tolerance: file.correctors.tolerance,
            corrector_limits: file.correctors.limits,
            rf_tolerance: rf.map_or(0.0, |rf| rf.tolerance),
            rf_limits: rf.map_or([0.0; 2], |rf| rf.limits),
            rf_nominal: rf.and_then(|rf| rf.nominal),
            settle: timing.settle_s,
            timeout: timing.timeout_s,
            match_window: timing.match_window_s,
        }
    }

    /// Each corrector at 0 and at plus and minus the amplitude.
    fn correctors(&mut self, file: &CorrectorsFile) -> Vec<Step> {
        let (amplitude, [low, high]) = (file.amplitude, file.limits);
        self.within(AMPERES, "correctors.amplitude_A", amplitude);
        self.within(AMPERES, "correctors.tolerance_A", file.tolerance);
        [low, high].iter().for_each(|limit| self.within(FINITE, "correctors.limits_A", *limit));
        self.expect(low <= -amplitude && amplitude <= high, || {
            format!("correctors.limits_A: expected -{amplitude:?} to {amplitude:?} A within them, found {low:?} to {high:?} A")
        });
        self.expect(file.tolerance < amplitude, || {
            format!(
                "correctors.tolerance_A: expected less than amplitude_A = {amplitude:?}, found {:?}",
                file.tolerance
            )
        });
        let all = self.names.correctors.clone();
        let measured = file.measure.as_ref().unwrap_or(&all);
        let skipped = self.indices("correctors.skip", &file.skip);
        let measured: Vec<usize> = self.indices("correctors.measure", measured);
        let steps = |&c: &usize| {
            let corrector = self.names.correctors[c].clone();
            [0.0, amplitude, -amplitude].map(move |current| Step::Corrector { corrector: corrector.clone(), current })
        };
        measured.iter().filter(|c| !skipped.contains(c)).flat_map(steps).collect()
    }

    fn indices(&mut self, key: &str, names: &[String]) -> Vec<usize> {
        let mut indices = Vec::new();
        for name in names {
            match self.names.corrector(name) {
                Some(c) if indices.contains(&c) => self.wrong.push(format!("{key}: {name} stands twice")),
                Some(c) => indices.push(c),
                None => self.wrong.push(format!("{key}: expected correctors of {}, found {name:?}", self.ring.name)),
            }
        }
        indices
    }

    /// The frequency as it is, and each step.
    fn rf(&mut self, file: &RfFile) -> Vec<Step> {
        self.within(HERTZ, "rf.tolerance_Hz", file.tolerance);
        let [low, high] = file.limits;
        [low, high].iter().for_each(|limit| self.within(HERTZ, "rf.limits_Hz", *limit));
        self.expect(0.0 < low && low < high, || {
            format!("rf.limits_Hz: expected two rising numbers, found {low}, {high}")
        });
        file.nominal.iter().for_each(|nominal| self.within(HERTZ, "rf.nominal_Hz", *nominal));
        for step in &file.steps_relative {
            self.expect(*step != 0.0 && step.abs() <= 0.01, || {
                format!("rf.steps_relative: expected numbers from -0.01 to 0.01 without 0, found {step}")
            });
        }
        [0.0].iter().chain(&file.steps_relative).map(|&offset| Step::Rf { offset }).collect()
    }

    fn channels(&mut self, file: &ChannelsFile, has_dipole: bool) -> Channels {
        let known = |device: &String| self.names.correctors.contains(device) || self.names.supplies.contains(device);
        let unknown: Vec<&String> = file.devices.keys().filter(|device| !known(device)).collect();
        let wrong = unknown.iter().map(|device| {
            format!("channels.devices: expected correctors and supplies of {}, found {device:?}", self.ring.name)
        });
        let wrong: Vec<String> = wrong.collect();
        self.wrong.extend(wrong);
        for (key, pattern) in [
            ("corrector_set_A", &file.corrector_set),
            ("corrector_read_A", &file.corrector_read),
            ("supply_read_A", &file.supply_read),
        ] {
            self.expect(pattern.contains(DEVICE), || {
                format!("channels.{key}: expected {DEVICE} in it, found {pattern:?}")
            });
        }
        let of = |pattern: &str, devices: &[String]| -> Vec<String> {
            let name = |device: &String| pattern.replace(DEVICE, file.devices.get(device).unwrap_or(device));
            devices.iter().map(name).collect()
        };
        self.expect(file.dipole_read.is_some() == has_dipole, || {
            "channels.dipole_read_A: expected if, and only if, the header's nominal_A has a dipole".into()
        });
        let mut pair = |keys: &str, one: &Option<String>, other: &Option<String>| {
            self.expect(one.is_some() == other.is_some(), || format!("channels.{keys}: expected both or none"));
            one.clone().zip(other.clone()).map(|(one, other)| [one, other])
        };
        let rf = pair("rf_set_Hz, rf_read_Hz", &file.rf_set, &file.rf_read);
        let tunes = pair("tune_x, tune_y", &file.tune_x, &file.tune_y);
        let horizontal = self.ring.horizontal_monitors();
        let all = self.names.monitors.len();
        Channels {
            cycle: file.cycle.clone(),
            monitors: [
                self.waveform("x", &file.x_mm, &file.x_monitors, 0..horizontal),
                self.waveform("y", &file.y_mm, &file.y_monitors, horizontal..all),
            ],
            corrector_set: of(&file.corrector_set, &self.names.correctors),
            corrector_read: of(&file.corrector_read, &self.names.correctors),
            supply_read: of(&file.supply_read, &self.names.supplies),
            dipole_read: file.dipole_read.clone(),
            rf,
            tunes,
        }
    }

    fn waveform(
        &mut self,
        plane: &str,
        name: &str,
        order: &Option<Vec<String>>,
        own: core::ops::Range<usize>,
    ) -> Waveform {
        let Some(order) = order else { return Waveform { name: name.into(), monitors: own.collect() } };
        let mut monitors = Vec::new();
        for monitor in order {
            match self.names.monitor(&format!("{plane}_{monitor}")).or(self.names.monitor(monitor)) {
                Some(b) if own.contains(&b) && !monitors.contains(&b) => monitors.push(b),
                _ => self.wrong.push(format!(
                    "channels.{plane}_monitors: expected monitors of that plane, each once, found {monitor:?}"
                )),
            }
        }
        Waveform { name: name.into(), monitors }
    }
}
