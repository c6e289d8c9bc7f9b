//! Recordings with an answer key beside them, diagnosed and scored.

use std::path::{Path, PathBuf};
use std::time::Instant;

use diagnosis::{DataError, Diagnosis, Finding, Verdict};
use inference::Recording;
use schemars::JsonSchema;
use serde::Serialize;
use twin::Ring;

use crate::score::{Grade, Truth};

/// Scores of recordings. Field names are those of the JSON of `orbitcal challenge`.
#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct Challenge {
    pub recordings: Vec<Scored>,
    /// Those that could not be diagnosed, and why.
    pub refused: Vec<String>,
    /// Number of recordings by grade.
    pub right: usize,
    pub partial: usize,
    pub listed: usize,
    pub open: usize,
    pub missed: usize,
    pub wrong: usize,
    /// Sum of squares of the pulls of all named amplitudes, and their number.
    pub amplitude_chi2: f64,
    pub amplitudes: usize,
}

/// One recording, scored.
#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct Scored {
    pub recording: String,
    pub verdict: Verdict,
    pub sentence: String,
    pub found: Vec<String>,
    pub truth: Vec<String>,
    pub oracle_gain: Option<f64>,
    pub grade: Grade,
    pub amplitude_pulls: Vec<f64>,
    pub nees_per_var_before: f64,
    pub nees_per_var_after: f64,
    pub elpd_gain: [f64; 2],
    pub seconds: f64,
}

/// Why a folder has nothing to score.
#[derive(Debug, thiserror::Error)]
#[error("{}: {what}", .folder.display())]
pub struct FolderError {
    folder: PathBuf,
    what: String,
}

/// Folders below (or the folder itself) that hold a recording and its key, sorted.
///
/// # Errors
/// [`FolderError`], also if there is none.
pub fn folders(root: &Path) -> Result<Vec<PathBuf>, FolderError> {
    let mut found = Vec::new();
    descend(root, &mut found)?;
    found.sort();
    if found.is_empty() {
        let what = "expected folders with frames.csv and truth.json, found none";
        return Err(FolderError { folder: root.to_owned(), what: what.into() });
    }
    Ok(found)
}

fn descend(folder: &Path, found: &mut Vec<PathBuf>) -> Result<(), FolderError> {
    let wrong = |error: std::io::Error| FolderError { folder: folder.to_owned(), what: twin::unreadable(&error) };
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
    /// Of a recording that is diagnosed now.
    ///
    /// # Errors
    /// [`DataError`].
    pub fn of(ring: &Ring, recording: &Recording, truth: &Truth) -> Result<Self, DataError> {
        let started = Instant::now();
        let diagnosis = &Diagnosis::from_recording(ring, recording, |_| {})?;
        let seconds = started.elapsed().as_secs_f64();
        let names = ring.var_names();
        Ok(Self {
            recording: recording.name.clone(),
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
        })
    }

    /// What was concealed, and how much an oracle gains that knows it [nat].
    pub fn truth(&self) -> String {
        let gain = self.oracle_gain.map_or_else(String::new, |gain| format!(" (oracle gain {gain:.1})"));
        if self.truth.is_empty() { "nothing".into() } else { self.truth.join(" + ") + &gain }
    }
}

impl Challenge {
    /// Of those that were scored, and why others were not.
    pub fn of(recordings: Vec<Scored>, refused: Vec<String>) -> Self {
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
