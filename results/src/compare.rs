//! What changed between two measurements of one machine: the result of `orbitcal compare`.

use inference::{BaseModel, BatchFit, Recording, TuneUse};
use measured::departure::clear;
use measured::{Before, Folder, Settings};
use twin::Ring;

use crate::campaign::campaign;
use crate::error::CommandError;
use crate::fit_result::{FitResult, Var};
use crate::matrix_result::{ChangeOfOne, Comparison, OtherChange};

/// Two measured matrices of one ring; `say` hears what is done.
///
/// # Errors
/// [`CommandError`].
pub fn compare_matrices(
    [before, after]: [&Folder; 2],
    settings: &Settings,
    say: &mut dyn FnMut(&str),
) -> Result<Comparison, CommandError> {
    let (Before { folder, .. }, changes) = measured::compare(before, after, settings, say)?;
    let mut all = Vec::new();
    for one in &changes.gradients {
        all.extend(one.rows.iter().map(|&row| ChangeOfOne {
            name: folder.element(row),
            family: one.family.clone(),
            index: Some(row),
            relative: one.relative,
            sigma: one.sigma,
            changed: one.has_changed,
            identifiable: one.is_identifiable,
        }));
    }
    all.sort_by_key(|one| one.index);
    let cables = changes.wiring.iter().map(|one| OtherChange::of_cable(&folder, one));
    Ok(Comparison::of(all, cables.chain(changes.others.iter().map(OtherChange::of)).collect()))
}

/// Two recordings of a ring; `progress` hears the number of each step. Each is fitted by itself, with a design that
/// is exact, since both share it; where a var is known no better than half its prior, the prior would hide a change.
///
/// # Errors
/// [`CommandError`].
pub fn compare_recordings(
    ring: &Ring,
    [before, after]: [&Recording; 2],
    mut progress: impl FnMut(usize),
) -> Result<Comparison, CommandError> {
    let mut vars = |recording: &Recording| -> Result<_, CommandError> {
        let campaign = campaign(ring, recording)?;
        let fit = BatchFit::best(&campaign, TuneUse::Readings, BaseModel::EXACT, &mut progress)?;
        Ok(FitResult::of_fit(&campaign, &fit, None).vars)
    };
    let (before, after) = (vars(before)?, vars(after)?);
    let widths = ring.parameters.iter().map(|parameter| parameter.prior.width);
    let change = |((one, other), width): ((_, _), f64)| {
        let (one, other): (Var, Var) = (one, other);
        let (relative, sigma) = (other.mean / one.mean - 1.0, (one.sigma / one.mean).hypot(other.sigma / other.mean));
        ChangeOfOne {
            relative,
            sigma,
            changed: relative.abs() > clear(ring.parameters.len()) * sigma,
            identifiable: one.sigma.max(other.sigma) < 0.5 * width,
            family: one.name.clone(),
            name: one.name,
            index: None,
        }
    };
    Ok(Comparison::of(before.into_iter().zip(after).zip(widths).map(change).collect(), Vec::new()))
}
