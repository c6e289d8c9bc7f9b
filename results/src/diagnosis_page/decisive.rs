//! The decisive picture of each finding.

use diagnosis::{Cause, Diagnosis, Finding, FitError, Fitted, Location, Term};
use report::Figure;

use super::partial::Partial;
use super::{limits, slope, tunes, unmodelled};

/// Share of what tells of an effect from which on the tunes decide.
const DECIDE: f64 = 0.5;

/// For each finding the readings against its signature, or the tunes where these decide, or the residuals at the place of what is unmodelled; the
/// detection limits where there is no finding.
///
/// # Errors
/// [`FitError`].
pub fn figures(diagnosis: &Diagnosis) -> Result<Vec<(String, Figure)>, FitError> {
    if diagnosis.findings.is_empty() {
        return Ok(limits::figures(diagnosis));
    }
    let mut all = Vec::new();
    for finding in &diagnosis.findings {
        if let Some(passing) = diagnosis.transients.iter().find(|one| one.is_of(&finding.cause)) {
            let is_unsteady =
                matches!(&finding.cause, Cause::Unmodelled(one) if matches!(one.at, Location::UnsteadyCorrector(_)));
            let figure = if is_unsteady { slope::of_each_frame } else { slope::of_first_frames };
            all.push(figure(finding, &passing.shown));
            continue;
        }
        all.extend(match &finding.cause {
            Cause::Effect(term) => of_effect(diagnosis, finding, term)?,
            Cause::Unmodelled(one) => unmodelled::figures(diagnosis, one)?,
        });
    }
    Ok(all)
}

fn of_effect(diagnosis: &Diagnosis, finding: &Finding, term: &Term) -> Result<Vec<(String, Figure)>, FitError> {
    let Some((fitted, index)) = fit_with(diagnosis, term) else { return Ok(Vec::new()) };
    // a machine that keeps no beam without the effect has no readings to compare with
    let Ok(partial) = Partial::of(&diagnosis.found.data, fitted, |one| one == term) else { return Ok(Vec::new()) };
    let of_tunes = tunes::figures(finding, &partial)?;
    if !of_tunes.is_empty() && partial.share_of_tunes(index)? > DECIDE {
        return Ok(of_tunes);
    }
    Ok(vec![slope::figure(finding, &partial)])
}

/// The fit that has an effect in it, and the effect's index there: the one of all findings, or that of an open one.
fn fit_with<'d>(diagnosis: &'d Diagnosis, term: &Term) -> Option<(&'d Fitted, usize)> {
    let found = &diagnosis.found;
    let open =
        found.next.alternatives.iter().filter(|one| one.term() == Some(term)).find_map(|one| one.fitted.as_ref());
    let index = |fitted: &Fitted| fitted.hypothesis.terms.iter().position(|one| one == term);
    [Some(&found.best), open].into_iter().flatten().find_map(|fitted| Some((fitted, index(fitted)?)))
}
