//! Blind campaigns on all cores, whose outcomes are written down as they come; a stopped run resumes.

use core::sync::atomic::{AtomicUsize, Ordering};
use std::collections::BTreeMap;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use diagnosis::DataError;
use inference::Recording;
use twin::Ring;

use crate::case::Case;
use crate::outcome::{Outcome, run};

/// Why campaigns end before their end.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CampaignError {
    /// A line of the file of outcomes is none of this program's.
    #[error("{}, line {line}: expected an outcome of this program's version; remove the file to begin anew", .path.display())]
    Line {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
    },
    /// The file of outcomes cannot be written.
    #[error("{}: {source}", .path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// A campaign cannot be diagnosed.
    #[error("campaign {index}: {source}")]
    Data {
        /// Its number.
        index: usize,
        /// Why.
        source: DataError,
    },
}

/// What has been run before with this template and seed.
///
/// # Errors
/// [`CampaignError::Line`].
pub fn known(path: &Path, key: &str) -> Result<BTreeMap<usize, Outcome>, CampaignError> {
    let Ok(text) = fs::read_to_string(path) else { return Ok(BTreeMap::new()) };
    let mut known = BTreeMap::new();
    for (number, line) in text.lines().enumerate() {
        // a line that a stop cut short is run again
        let Ok((of_key, outcome)) = serde_json::from_str::<(String, Outcome)>(line) else {
            if !line.ends_with('}') && !line.ends_with(']') || number + 1 == text.lines().count() {
                continue;
            }
            return Err(CampaignError::Line { path: path.to_owned(), line: number + 1 });
        };
        if of_key == key {
            known.insert(outcome.index, outcome);
        }
    }
    Ok(known)
}

/// Run cases on all cores, writing each outcome down as it comes.
///
/// # Errors
/// [`CampaignError`].
///
/// # Panics
/// If a campaign panics.
pub fn run_all(
    ring: &Ring,
    template: &Recording,
    cases: &[&Case],
    path: &Path,
    key: &str,
    done: &(dyn Fn() + Sync),
) -> Result<Vec<Outcome>, CampaignError> {
    let wrong = |source: io::Error| CampaignError::Write { path: path.to_owned(), source };
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).map_err(wrong)?;
    }
    // a line that a stop cut short is ended, so that it spoils no other
    let cut = fs::read(path).is_ok_and(|bytes| bytes.last().is_some_and(|last| *last != b'\n'));
    let file = Mutex::new(OpenOptions::new().create(true).append(true).open(path).map_err(wrong)?);
    if cut {
        file.lock().expect("no thread panics with it").write_all(b"\n").map_err(wrong)?;
    }
    let (next, outcomes) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    let work = || -> Result<(), CampaignError> {
        while let Some(case) = cases.get(next.fetch_add(1, Ordering::Relaxed)) {
            let index = case.index;
            let outcome = run(ring, template, case).map_err(|source| CampaignError::Data { index, source })?;
            if let Some(outcome) = outcome {
                append(&file, key, &outcome).map_err(wrong)?;
                outcomes.lock().expect("no thread panics with it").push(outcome);
            }
            done();
        }
        Ok(())
    };
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..cores).map(|_| scope.spawn(work)).collect();
        threads.into_iter().try_for_each(|thread| thread.join().expect("a panic is a bug and stops the run"))
    })?;
    Ok(outcomes.into_inner().expect("no thread panics with it"))
}

fn append(file: &Mutex<File>, key: &str, outcome: &Outcome) -> io::Result<()> {
    let mut line = serde_json::to_string(&(key, outcome))?;
    line.push('\n');
    file.lock().expect("no thread panics with it").write_all(line.as_bytes())
}
