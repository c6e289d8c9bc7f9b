//! `orbitcal compare`: what changed between two measurements of one machine.

use inference::{BatchFit, Recording, TuneUse};
use measured::departure::clear;
use measured::{Folder, Settings, Straightened};
use twin::Ring;

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
        [true, true] => {
            let settings = matrix::settings(None, &options.priors)?;
            let [before, after] = [&options.before, &options.after].map(|path| Folder::read(path));
            let spinner = matrix::spinner(&options.common);
            let compared =
                of_matrices([&before?, &after?], &settings, &mut |what| spinner.set_message(what.to_owned()));
            spinner.finish_and_clear();
            compared?
        }
        [false, false] => {
            let ring = machine_with(options.common.machine.as_deref(), &options.priors)?;
            let [before, after] = [&options.before, &options.after].map(|path| recording(path, &ring));
            of_recordings(&ring, [&before?, &after?], |_| ())?
        }
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

/// Two measured matrices of one ring; `say` hears what is done.
///
/// # Errors
/// [`CommandError`].
pub fn of_matrices(
    [as_measured, after]: [&Folder; 2],
    settings: &Settings,
    say: &mut dyn FnMut(&str),
) -> Result<Comparison, CommandError> {
    let Straightened { folder: before, cables, fit } =
        Straightened::of(as_measured, settings, &mut |what| say(&format!("{}: {what}", as_measured.name)))?;
    let changes = measured::compare((&before, &cables, &fit), after, settings, &mut |what| {
        say(&format!("{}: {what}", after.name));
    })?;
    let mut all = Vec::new();
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

/// Two recordings of a ring; `progress` hears the number of each step. Each is fitted by itself; where a var is known no better than half its prior, the prior would hide a change.
///
/// # Errors
/// [`CommandError`].
pub fn of_recordings(
    ring: &Ring,
    [before, after]: [&Recording; 2],
    mut progress: impl FnMut(usize),
) -> Result<Comparison, CommandError> {
    let mut vars = |recording: &Recording| -> Result<_, CommandError> {
        let campaign = campaign(ring, recording)?;
        let fit = BatchFit::best(&campaign, TuneUse::Readings, &mut progress)?;
        Ok(FitResult::of_fit(&campaign, &fit).vars)
    };
    let (before, after) = (vars(before)?, vars(after)?);
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
    Ok(Comparison::of(before.into_iter().zip(after).zip(widths).map(change).collect(), Vec::new()))
}
