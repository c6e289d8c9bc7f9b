//! `orbitcal compare`: what changed between two measurements of one machine.

use inference::{BatchFit, TuneUse};
use measured::departure::clear;
use measured::{Folder, Straightened};

use super::{CommandError, campaign, check_outputs, deliver, machine_with, matrix, recording};
use crate::cli::Compare;
use crate::matrix_page;
use crate::matrix_result::{ChangeOfOne, Comparison, OtherChange};
use crate::result::FitResult;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Compare) -> Result<(), CommandError> {
    check_outputs([options.common.json.as_deref(), options.report.as_deref()])?;
    let compared = match [&options.before, &options.after].map(|path| Folder::is_one(path)) {
        [true, true] => of_matrices(options)?,
        [false, false] => Comparison::of(of_recordings(options)?, Vec::new()),
        _ => {
            let (a, b) = (options.before.display(), options.after.display());
            return Err(CommandError::Input(format!(
                "of {a} and {b} one is a measured matrix, one a recording of frames"
            )));
        }
    };
    if let Some(path) = &options.report {
        let names = [&options.before, &options.after]
            .map(|path| path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned());
        matrix::write(path, &matrix_page::page_of(&compared, [&names[0], &names[1]]))?;
    }
    deliver(&options.common, &compared)
}

fn of_matrices(options: &Compare) -> Result<Comparison, CommandError> {
    let settings = matrix::settings(None, &options.priors)?;
    let (as_measured, after) = (Folder::read(&options.before)?, Folder::read(&options.after)?);
    let Straightened { folder: before, cables, fit } = matrix::fitted(&as_measured, &settings, &options.common)?;
    let spinner = matrix::spinner(&options.common);
    let changes = measured::compare((&before, &cables, &fit), &after, &settings, &mut |what| {
        spinner.set_message(format!("{}: {what}", after.name))
    });
    spinner.finish_and_clear();
    let mut all = Vec::new();
    let changes = changes?;
    for one in &changes.gradients {
        all.extend(one.rows.iter().map(|&row| ChangeOfOne {
            name: before.element(row),
            index: Some(row),
            relative: one.relative,
            sigma: one.sigma,
            changed: one.has_changed,
            identifiable: one.is_identifiable,
        }));
    }
    all.sort_by_key(|one| one.index);
    let cables = changes.wiring.iter().map(|one| OtherChange::of_cable(&before, one));
    Ok(Comparison::of(all, cables.chain(changes.others.iter().map(OtherChange::of)).collect()))
}

/// Each recording is fitted by itself; where a var is known no better than half its prior, the prior would hide a change.
fn of_recordings(options: &Compare) -> Result<Vec<ChangeOfOne>, CommandError> {
    let ring = machine_with(options.common.machine.as_deref(), &options.priors)?;
    let vars = |path: &std::path::Path| -> Result<_, CommandError> {
        let campaign = campaign(&ring, &recording(path, &ring)?)?;
        let fit = BatchFit::of(&campaign, TuneUse::Readings, |_| ())?;
        Ok(FitResult::of_fit(&campaign, &fit).vars)
    };
    let (before, after) = (vars(&options.before)?, vars(&options.after)?);
    let widths = ring.parameters.iter().map(|parameter| parameter.prior.width);
    let change = |((one, other), width): ((_, _), f64)| {
        let (one, other): (crate::result::Var, crate::result::Var) = (one, other);
        let (relative, sigma) = (other.mean / one.mean - 1.0, (one.sigma / one.mean).hypot(other.sigma / other.mean));
        ChangeOfOne {
            relative,
            sigma,
            changed: relative.abs() > clear(ring.parameters.len()) * sigma,
            identifiable: one.sigma.max(other.sigma) < 0.5 * width,
            name: one.name,
            index: None,
        }
    };
    Ok(before.into_iter().zip(after).zip(widths).map(change).collect())
}
