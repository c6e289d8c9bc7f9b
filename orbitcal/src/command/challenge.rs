//! `orbitcal challenge`: every recording below a folder diagnosed, and scored against the answer key beside it.

use core::fmt;
use std::path::Path;

use results::output::{fill, table};
use results::{CommandError, recording};
use schemars::JsonSchema;
use serde::Serialize;
use validation::{Challenge, Scored, Truth, folders};

use super::{check_outputs, deliver, machine_for, progress};
use crate::cli;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &cli::Challenge) -> Result<(), CommandError> {
    check_outputs([options.common.json.as_deref()])?;
    let folders = folders(&options.folder).map_err(|error| CommandError::Input(error.to_string()))?;
    let bar = progress(folders.len(), "recordings", options.common.quiet);
    let (mut recordings, mut refused) = (Vec::new(), Vec::new());
    for folder in &folders {
        match scored(options.common.machine.as_deref(), folder) {
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
        deliver(&options.common, &Shown(Challenge::of(recordings, whys)))?;
    }
    // of the sort of the first
    match refused.first() {
        None => Ok(()),
        Some(CommandError::Input(_)) => Err(CommandError::Input(all)),
        Some(CommandError::Other(_)) => Err(CommandError::Other(all)),
    }
}

/// One recording.
fn scored(machine: Option<&Path>, folder: &Path) -> Result<Scored, CommandError> {
    let ring = machine_for(folder, machine)?;
    let recording = recording(folder, &ring)?;
    let truth = Truth::read(folder, &ring).map_err(|error| CommandError::Input(error.to_string()))?;
    Ok(Scored::of(&ring, &recording, &truth)?)
}

/// Scores for a person.
#[derive(Serialize, JsonSchema)]
#[serde(transparent)]
struct Shown(Challenge);

impl fmt::Display for Shown {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(scores) = self;
        let mut table = table(["recording", "verdict", "grade", "pull", "NEES/var", "held-out", "s"]);
        for scored in &scores.recordings {
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
        for scored in &scores.recordings {
            let found = if scored.found.is_empty() { "nothing".into() } else { scored.found.join(" + ") };
            writeln!(f, "{}", fill(&format!("{}: found {found}; concealed {}", scored.recording, scored.truth())))?;
        }
        writeln!(f)?;
        let summary = format!(
            "{} right, {} in part, {} undecided with the truth listed, {} left open, {} missed, {} wrong; amplitudes: sum of \
             squared pulls {:.1} of {}",
            scores.right,
            scores.partial,
            scores.listed,
            scores.open,
            scores.missed,
            scores.wrong,
            scores.amplitude_chi2,
            scores.amplitudes
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
