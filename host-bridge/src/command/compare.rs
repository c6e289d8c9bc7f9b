//! `orbitcal compare`: what changed between two measurements of one machine.

use inference::{BatchFit, TuneUse};
use measured::Folder;

use super::{CommandError, campaign, check_outputs, deliver, machine_with, matrix, recording};
use crate::cli::Compare;
use crate::matrix_result::{ChangeOfOne, Comparison};
use crate::result::FitResult;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Compare) -> Result<(), CommandError> {
    check_outputs([options.common.json.as_deref()])?;
    let changes = match [&options.before, &options.after].map(|path| Folder::is_one(path)) {
        [true, true] => of_matrices(options)?,
        [false, false] => of_recordings(options)?,
        _ => {
            let (a, b) = (options.before.display(), options.after.display());
            return Err(CommandError::Input(format!(
                "of {a} and {b} one is a measured matrix, one a recording of frames"
            )));
        }
    };
    deliver(&options.common, &Comparison::of(changes))
}

fn of_matrices(options: &Compare) -> Result<Vec<ChangeOfOne>, CommandError> {
    let settings = matrix::settings(None, &options.priors)?;
    let read = |path| -> Result<_, CommandError> { Ok(measured::straightened(&Folder::read(path)?, &settings)?.0) };
    let (before, after) = (read(&options.before)?, read(&options.after)?);
    let fitted = matrix::fitted(&before, &settings, &options.common)?;
    let spinner = matrix::spinner(&options.common);
    let changes = measured::compare(&before, &fitted, &after, &settings, &mut |what| {
        spinner.set_message(format!("{}: {what}", after.name))
    });
    spinner.finish_and_clear();
    let mut all = Vec::new();
    for one in changes? {
        all.extend(one.rows.iter().map(|&row| ChangeOfOne {
            name: before.element(row),
            index: Some(row),
            relative: one.relative,
            sigma: one.sigma,
            identifiable: one.is_identifiable,
        }));
    }
    all.sort_by_key(|one| one.index);
    Ok(all)
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
        ChangeOfOne {
            relative: other.mean / one.mean - 1.0,
            sigma: (one.sigma / one.mean).hypot(other.sigma / other.mean),
            identifiable: one.sigma.max(other.sigma) < 0.5 * width,
            name: one.name,
            index: None,
        }
    };
    Ok(before.into_iter().zip(after).zip(widths).map(change).collect())
}
