//! The measurement that a diagnosis proposes, as a plan that `orbitcal measure` carries out: the plan at hand with what is changed.

use std::io::Write;
use std::path::{Path, PathBuf};

use control::Plan;
use diagnosis::{Change, Proposal};
use inference::recording::Names;
use toml::{Table, Value};
use twin::Ring;
use twin::limits::SETTINGS;

/// Why there is no next plan.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum NextPlanError {
    /// The plan at hand is none.
    #[error("{}: {}", .0.display(), .1)]
    Plan(PathBuf, String),
    /// No proposal is one that this plan's channels and limits can carry out.
    #[error("the channels and limits of {} can carry out none of what is proposed", .0.display())]
    Impossible(PathBuf),
    /// The file cannot be written.
    #[error("{}: {}", .0.display(), .1)]
    Write(PathBuf, String),
}

/// Write the best proposal that the plan `now` can carry out, within its own limits and without the correctors that it skips; returns
/// its description.
///
/// # Errors
/// [`NextPlanError`].
pub fn write<'p>(now: &Path, to: &Path, ring: &Ring, proposals: &'p [Proposal]) -> Result<&'p str, NextPlanError> {
    let wrong = |why: &dyn core::fmt::Display| NextPlanError::Plan(now.into(), why.to_string());
    Plan::read(now, ring).map_err(|error| wrong(&error))?;
    let text = SETTINGS.text(now).map_err(|error| wrong(&error))?;
    let table: Table = text.parse().map_err(|error| wrong(&error))?;
    let folder = now.parent().unwrap_or(Path::new("")).join(table["header"].as_str().unwrap_or_default());
    let header = folder.canonicalize().map_err(|error| wrong(&error))?;
    for proposal in proposals {
        let Some(mut changed) = changed(&table, &proposal.change, &Names::from_ring(ring)) else { continue };
        changed.insert("header".into(), header.to_string_lossy().into_owned().into());
        let text = format!("# Proposed by orbitcal diagnose: a campaign {}.\n{changed}", proposal.what);
        if put(to, &text, ring).map_err(|error| NextPlanError::Write(to.into(), error.to_string()))? {
            return Ok(&proposal.what);
        }
    }
    Err(NextPlanError::Impossible(now.into()))
}

/// The plan with a change; none if a plan cannot say it.
fn changed(plan: &Table, change: &Change, names: &Names) -> Option<Table> {
    let mut plan = plan.clone();
    let correctors = plan.get_mut("correctors")?.as_table_mut()?;
    match change {
        Change::Same => {}
        Change::Settings(factor) => {
            let amplitude = correctors.get("amplitude_A")?;
            let amplitude = amplitude.as_float().or_else(|| amplitude.as_integer().map(|whole| whole as f64))?;
            correctors.insert("amplitude_A".into(), (amplitude * factor).into());
        }
        Change::Correctors(idle) => {
            // what operators skip is not moved
            let skipped = |name: &str| {
                let skip = correctors.get("skip").and_then(Value::as_array);
                skip.is_some_and(|skip| skip.iter().any(|skipped| skipped.as_str() == Some(name)))
            };
            let used: Vec<Value> = idle
                .iter()
                .map(|c| &names.correctors[*c])
                .filter(|name| !skipped(name))
                .map(|name| Value::from(name.as_str()))
                .collect();
            if used.is_empty() {
                return None;
            }
            correctors.insert("measure".into(), used.into());
        }
        Change::Machine => return None,
    }
    Some(plan)
}

/// Put a plan in its place if it is a good one.
fn put(to: &Path, text: &str, ring: &Ring) -> std::io::Result<bool> {
    let folder = to.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut file = tempfile::NamedTempFile::new_in(folder)?;
    file.write_all(text.as_bytes())?;
    if Plan::read(file.path(), ring).is_err() {
        return Ok(false);
    }
    file.persist(to).map_err(|error| error.error)?;
    Ok(true)
}

#[cfg(test)]
mod tests {
    use control::Step;

    use std::fs;

    use super::*;

    const NOW: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../config/measure-booster.toml");

    fn proposal(change: Change) -> Proposal {
        Proposal { what: format!("{change:?}"), change, separation: 1.0 }
    }

    /// The plan that comes out, with the number of correctors that it measures and their largest setting [A].
    fn next(now: &Path, proposals: &[Proposal]) -> (String, usize, f64) {
        let (folder, ring) = (tempfile::tempdir().unwrap(), Ring::booster());
        let to = folder.path().join("next.toml");
        let what = write(now, &to, &ring, proposals).unwrap().to_owned();
        let plan = Plan::read(&to, &ring).unwrap();
        let settings = plan.steps.iter().filter_map(|step| match step {
            Step::Corrector { current, .. } => Some(*current),
            Step::Rf { .. } => None,
        });
        let settings: Vec<f64> = settings.collect();
        (what, settings.len() / 3, settings.iter().copied().fold(0.0, f64::max))
    }

    #[test]
    fn the_best_proposal_that_the_plan_can_carry_out_is_written() {
        let all =
            [Change::Machine, Change::Settings(2.0), Change::Correctors(vec![26, 27]), Change::Same].map(proposal);
        // 44 A are beyond its limits, and the others are among those that it skips
        assert_eq!(next(Path::new(NOW), &all), ("Same".into(), 37, 22.0));
        let (folder, text) = (tempfile::tempdir().unwrap(), fs::read_to_string(NOW).unwrap());
        let header = Path::new(NOW).with_file_name("booster-header.toml");
        let text = text.replace("header = \"booster-header.toml\"", &format!("header = {header:?}"));
        let now = folder.path().join("now.toml");
        fs::write(&now, text.replace("amplitude_A = 22.0", "amplitude_A = 11")).unwrap();
        assert_eq!(next(&now, &all), ("Settings(2.0)".into(), 37, 22.0));
        let unskipped = text.lines().filter(|line| !line.starts_with("skip")).collect::<Vec<_>>().join("\n");
        fs::write(&now, unskipped).unwrap();
        assert_eq!(next(&now, &all), ("Correctors([26, 27])".into(), 2, 22.0));
        let none = write(&now, &folder.path().join("b"), &Ring::booster(), &all[..1]).unwrap_err();
        assert!(none.to_string().ends_with("can carry out none of what is proposed"), "{none}");
        assert!(!folder.path().join("b").exists());
    }
}
