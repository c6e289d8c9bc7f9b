//! `orbitcal challenge`: every recording below a folder diagnosed, and scored against the answer key beside it.

use core::fmt;
use std::path::{Path, PathBuf};
use std::time::Instant;

use diagnosis::{Diagnosis, Finding, Grade, Truth, Verdict};
use serde::Serialize;
use twin::Ring;

use super::{CommandError, check_outputs, deliver, machine, progress, recording};
use crate::cli::Challenge;
use crate::output::{self, fill, table};

/// Field names are those of the command's JSON.
#[derive(Debug, Serialize)]
struct ChallengeResult {
    recordings: Vec<Scored>,
    /// Those that could not be diagnosed, and why.
    refused: Vec<String>,
    /// Number of recordings by grade.
    right: usize,
    partial: usize,
    listed: usize,
    open: usize,
    missed: usize,
    wrong: usize,
    /// Sum of squares of the pulls of all named amplitudes, and their number.
    amplitude_chi2: f64,
    amplitudes: usize,
}

#[derive(Debug, Serialize)]
struct Scored {
    recording: String,
    verdict: Verdict,
    sentence: String,
    found: Vec<String>,
    truth: Vec<String>,
    oracle_gain: Option<f64>,
    grade: Grade,
    amplitude_pulls: Vec<f64>,
    nees_per_var_before: f64,
    nees_per_var_after: f64,
    elpd_gain: [f64; 2],
    seconds: f64,
}

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Challenge) -> Result<(), CommandError> {
    check_outputs([options.common.json.as_deref()])?;
    let ring = machine(options.common.machine.as_deref())?;
    let folders = folders(&options.folder)?;
    let bar = progress(folders.len(), "recordings", options.common.quiet);
    let (mut recordings, mut refused) = (Vec::new(), Vec::new());
    for folder in &folders {
        match scored(&ring, folder) {
            Ok(one) => recordings.push(one),
            // the others are not lost with it
            Err(error) => refused.push(error),
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    let whys: Vec<String> = refused.iter().map(ToString::to_string).collect();
    let all = whys.join("; ");
    if !recordings.is_empty() {
        deliver(&options.common, &ChallengeResult::of(recordings, whys))?;
    }
    // of the sort of the first
    match refused.first() {
        None => Ok(()),
        Some(CommandError::Input(_)) => Err(CommandError::Input(all)),
        Some(CommandError::Other(_)) => Err(CommandError::Other(all)),
    }
}

/// One recording.
fn scored(ring: &Ring, folder: &Path) -> Result<Scored, CommandError> {
    let recording = recording(folder, ring)?;
    let truth = Truth::read(folder, ring).map_err(|error| CommandError::Input(error.to_string()))?;
    let started = Instant::now();
    let diagnosis = Diagnosis::from_recording(ring, &recording, |_| {})?;
    let seconds = started.elapsed().as_secs_f64();
    Ok(Scored::of(ring, &recording.name, &diagnosis, &truth, seconds))
}

/// Folders below (or the folder itself) that hold a recording and its key, sorted.
fn folders(root: &Path) -> Result<Vec<PathBuf>, CommandError> {
    let mut found = Vec::new();
    descend(root, &mut found)?;
    found.sort();
    if found.is_empty() {
        let what = "expected folders with frames.csv and truth.json, found none";
        return Err(CommandError::Input(format!("{}: {what}", root.display())));
    }
    Ok(found)
}

fn descend(folder: &Path, found: &mut Vec<PathBuf>) -> Result<(), CommandError> {
    let wrong =
        |error: std::io::Error| CommandError::Input(format!("{}: {}", folder.display(), output::unreadable(&error)));
    if folder.join("frames.csv").is_file() && folder.join("truth.json").is_file() {
        found.push(folder.to_owned());
    }
    for entry in std::fs::read_dir(folder).map_err(wrong)? {
        let entry = entry.map_err(wrong)?;
        // not by a link, which may lead back here
        if entry.file_type().map_err(wrong)?.is_dir() {
            descend(&entry.path(), found)?;
        }
    }
    Ok(())
}

impl Scored {
    fn of(ring: &Ring, recording: &str, diagnosis: &Diagnosis, truth: &Truth, seconds: f64) -> Self {
        let names = ring.var_names();
        Self {
            recording: recording.into(),
            verdict: diagnosis.verdict,
            sentence: diagnosis.sentence.clone(),
            found: diagnosis.findings.iter().map(Finding::label).collect(),
            truth: truth.effects.iter().map(|effect| effect.label(ring)).collect(),
            oracle_gain: truth.oracle_gain,
            grade: truth.grade(diagnosis),
            amplitude_pulls: truth.pulls(diagnosis),
            nees_per_var_before: truth.nees(&names, &diagnosis.vars_before),
            nees_per_var_after: truth.nees(&names, &diagnosis.vars_after),
            elpd_gain: diagnosis.gain().into(),
            seconds,
        }
    }
}

impl Scored {
    /// What was concealed, and how much an oracle gains that knows it [nat].
    fn truth(&self) -> String {
        let gain = self.oracle_gain.map_or_else(String::new, |gain| format!(" (oracle gain {gain:.1})"));
        if self.truth.is_empty() { "nothing".into() } else { self.truth.join(" + ") + &gain }
    }
}

impl ChallengeResult {
    fn of(recordings: Vec<Scored>, refused: Vec<String>) -> Self {
        let count = |grade| recordings.iter().filter(|scored| scored.grade == grade).count();
        let pulls: Vec<f64> = recordings
            .iter()
            .filter(|scored| scored.verdict == Verdict::Identified)
            .flat_map(|scored| scored.amplitude_pulls.iter().copied())
            .collect();
        Self {
            right: count(Grade::Right),
            partial: count(Grade::Partial),
            listed: count(Grade::Listed),
            open: count(Grade::Open),
            missed: count(Grade::Missed),
            wrong: count(Grade::Wrong),
            amplitude_chi2: pulls.iter().map(|p| p * p).sum(),
            amplitudes: pulls.len(),
            recordings,
            refused,
        }
    }
}

impl fmt::Display for ChallengeResult {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut table = table(["recording", "verdict", "grade", "pull", "NEES/var", "held-out", "s"]);
        for scored in &self.recordings {
            let pulls: Vec<String> = scored.amplitude_pulls.iter().map(|p| format!("{p:+.1}")).collect();
            table.add_row([
                scored.recording.clone(),
                scored.verdict.word().into(),
                format!("{:?}", scored.grade).to_lowercase(),
                pulls.join(" "),
                format!("{:.2}, {:.2}", scored.nees_per_var_before, scored.nees_per_var_after),
                format!("{:.1} ± {:.1}", scored.elpd_gain[0], scored.elpd_gain[1]),
                format!("{:.1}", scored.seconds),
            ]);
        }
        writeln!(f, "{table}\n")?;
        for scored in &self.recordings {
            let found = if scored.found.is_empty() { "nothing".into() } else { scored.found.join(" + ") };
            writeln!(f, "{}", fill(&format!("{}: found {found}; concealed {}", scored.recording, scored.truth())))?;
        }
        writeln!(f)?;
        let summary = format!(
            "{} right, {} in part, {} undecided with the truth listed, {} left open, {} missed, {} wrong; amplitudes: sum of \
             squared pulls {:.1} of {}",
            self.right,
            self.partial,
            self.listed,
            self.open,
            self.missed,
            self.wrong,
            self.amplitude_chi2,
            self.amplitudes
        );
        write!(
            f,
            "{}\n{}",
            fill(&summary),
            fill(
                "NEES, normalised estimation error squared of the vars: before and after what was found is in the model. Oracle gain: \
                 of ln posterior [nat] when kind, place and size are given."
            )
        )
    }
}
