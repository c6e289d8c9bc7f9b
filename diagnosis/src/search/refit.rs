//! Exact fits of the search: of candidates, from several starts, and with the ordinary widths that the recording shows beside them.

use nalgebra::DVector;

use crate::alternatives::Alternative;
use crate::data::Data;
use crate::family::Family;
use crate::fit::{FitError, Fitted};
use crate::hypothesis::Hypothesis;
use crate::linearisation::{self, about_itself};
use crate::scan::Candidate;
use crate::term::Term;
use crate::unknown::Quantity;
use crate::widths;

/// Gain of `ln` posterior that calls for another round of competitions, or of widths.
pub const BETTER: f64 = 0.1;
/// Largest distance from the best of candidates that are refitted exactly, in nat and relative to the best.
pub const BEHIND: f64 = 6.0;
pub const BEHIND_SHARE: f64 = 0.3;
/// `ln` Bayes factor below which first order suffices.
pub const WORTH: f64 = 3.0;
/// Most steps of the widths of what is ordinary, or of a fit that is begun anew.
const PASSES: usize = 4;
/// Way of all vars together, in prior standard deviations, that leaves the evidence as it is to 0.3 nat.
const STILL: f64 = 0.3;

/// The first fit of a hypothesis with all that is ordinary. Where it is poor the ordinary imperfections may be so large that about none of them
/// they are not of first order, or lead to another minimum: it is then begun anew where it ended, or where the
/// vars alone come to rest, which absorb most of that.
pub fn first_of(data: &Data, plain: &Hypothesis) -> Result<Fitted, FitError> {
    let start = DVector::zeros(data.units.len());
    let first = Fitted::from_guess(data, plain, &start)?;
    if !first.is_poor() {
        return Ok(first);
    }
    let of_vars = Fitted::from_guess(data, &Hypothesis::default(), &start).ok();
    let begun = [of_vars.map(|fitted| fitted.guess(data, plain)), first.is_stable(data).then(|| first.u.clone())];
    let mut fits: Vec<Fitted> = Vec::new();
    for mut guess in begun.into_iter().flatten() {
        for _ in 0..PASSES {
            let Ok(fitted) = Fitted::from_guess(data, plain, &guess) else { break };
            guess = fitted.u.clone();
            fits.push(fitted);
        }
    }
    let best = fits.into_iter().filter(|fitted| fitted.is_stable(data)).min_by(|a, b| a.cost.total_cmp(&b.cost));
    Ok(best.filter(|best| best.cost < first.cost).unwrap_or(first))
}

/// The fit without effects beside readings that are linearised about a machine with some: to readings of its own. Where further ones were dropped from
/// those, it is fitted to as many.
pub fn null_beside(data: &Data, null: Fitted, before: &Data) -> Fitted {
    if data.whole_size() == null.data(before).whole_size() {
        return null.keeping(before);
    }
    let again = Fitted::from_guess(data, &null.hypothesis, &null.u).ok().filter(|fitted| fitted.is_stable(data));
    again.map_or_else(|| null.keeping(before), |again| about_itself(data, again))
}

/// A fit to the readings at hand, where they are linearised about a machine with effects that it may not have.
pub fn fitted_to(data: &Data, fitted: Fitted) -> Option<Fitted> {
    if !data.is_about_effects {
        return Some(fitted);
    }
    Fitted::from_guess(data, &fitted.hypothesis, &fitted.u).ok().map(|fitted| about_itself(data, fitted))
}

/// The same with what is ordinary, which was left out where it kept no beam about the former machine.
pub fn with_ordinary(data: &mut Data, best: Fitted) -> Fitted {
    let learnt = relearnt(data, best.clone());
    if learnt.hypothesis.ordinary.is_empty() {
        return best;
    }
    let mut relinearised = data.clone();
    let again = linearisation::fit(&mut relinearised, &learnt.hypothesis, &learnt.u)
        .ok()
        .filter(|again| again.is_stable(&relinearised));
    let Some(again) = again else { return best };
    *data = relinearised;
    again
}

/// A fit whose ordinary widths no longer grow in evidence: what is left to gain would be given to the first effect that is tried.
pub fn settled(data: &Data, mut fitted: Fitted) -> Fitted {
    for _ in 0..PASSES {
        let before = fitted.log_evidence;
        fitted = relearnt(data, fitted);
        if fitted.log_evidence < before + BETTER {
            break;
        }
    }
    fitted
}

/// The exact fit with a candidate, abandoned where its cost stays far above the least of its rivals.
pub fn refit(data: &Data, fitted: &Fitted, candidate: &Candidate, least: f64) -> Alternative {
    let hypothesis = fitted.hypothesis.with(candidate.term);
    let mut guess = fitted.guess(data, &hypothesis);
    let unknowns = hypothesis.unknowns(data);
    let last = hypothesis.terms.len() - 1;
    let amplitude = Quantity::Amplitude(candidate.term);
    if let Some(at) = unknowns.iter().position(|unknown| unknown.quantity == amplitude) {
        guess[fitted.params.len() + at] = candidate.amplitude;
    }
    let mut guesses = vec![guess];
    // what is ordinary may have gone where a reversed or exchanged instrument leaves it
    if fitted.is_poor() || candidate.term.kind.is_switch() {
        guesses.push(DVector::zeros(fitted.params.len()));
    }
    let fits = guesses.iter().filter_map(|guess| at_rest(data, &hypothesis, guess, least).ok());
    let fits = fits.filter(|fitted| fitted.is_stable(data));
    // a candidate without a stable machine is excluded
    let Some(refitted) = fits.max_by(|one, other| one.log_evidence.total_cmp(&other.log_evidence)) else {
        return Alternative { log_gain: f64::NEG_INFINITY, ..Alternative::from_candidate(candidate) };
    };
    Alternative::exact(data, fitted, gross(data, refitted, last), last)
}

/// A fit begun anew where it ended, as long as its vars move: ordinary imperfections are linearised about the start, and near an integer tune vars
/// that move by two prior standard deviations change its evidence by ten nat.
fn at_rest(data: &Data, hypothesis: &Hypothesis, guess: &DVector<f64>, rival: f64) -> Result<Fitted, FitError> {
    let mut fitted = Fitted::against(data, hypothesis, guess, rival)?;
    let vars = fitted.params.len();
    let mut start = guess.rows(0, vars).into_owned();
    for _ in 1..PASSES {
        let is_at_rest = (fitted.u.rows(0, vars) - &start).norm() < STILL;
        if is_at_rest || fitted.is_poor() || hypothesis.ordinary.is_empty() {
            break;
        }
        start = fitted.u.rows(0, vars).into_owned();
        fitted = Fitted::against(data, hypothesis, &fitted.u, rival)?;
    }
    Ok(fitted)
}

/// The same fit, or with one of its effects gross where that is the better.
fn gross(data: &Data, fitted: Fitted, term: usize) -> Fitted {
    let stands_out = |(at, _): (usize, f64)| fitted.u[at].abs() > widths::STANDS_OUT;
    if !fitted.unknown(data, term).is_some_and(stands_out) {
        return fitted;
    }
    let hypothesis = fitted.hypothesis.with_gross(term);
    let again = hypothesis.and_then(|gross| Fitted::from_guess(data, &gross, &fitted.guess(data, &gross)).ok());
    again.filter(|again| again.log_evidence > fitted.log_evidence && again.is_stable(data)).unwrap_or(fitted)
}

/// Refit the best of some weighted candidates, and those that stand out of their family, with the ordinary widths that the recording shows
/// beside each; what changes the ring, where the best is more likely than nothing, to readings that are linearised about it.
pub fn relearn(data: &Data, without: &Fitted, weights: &mut [(Alternative, f64)], outstanding: &[Term]) {
    let best = weights.iter().map(|(_, weight)| *weight).fold(f64::NEG_INFINITY, f64::max);
    let is_near = |(one, weight): &&mut (Alternative, f64)| {
        let stands_out = one.term().is_some_and(|term| outstanding.contains(term));
        stands_out || (*weight > best - BEHIND && one.log_gain > WORTH)
    };
    for (alternative, weight) in weights.iter_mut().filter(is_near) {
        let place = |fitted: &Fitted| fitted.hypothesis.terms.iter().position(|term| Some(term) == alternative.term());
        let Some((fitted, term)) = alternative.fitted.clone().and_then(|f| place(&f).map(|at| (f, at))) else {
            continue;
        };
        let mut again = relearnt(data, fitted);
        let kind = again.hypothesis.terms[term].kind;
        if best > 0.0 && !kind.is_of_a_monitor() && !kind.is_of_a_corrector() {
            again = about_itself(data, again);
        }
        let again = Alternative::exact(data, without, again, term);
        *weight += again.log_gain - alternative.log_gain;
        *alternative = again;
    }
}

/// The same fit with the ordinary widths that the recording then shows, if it is the better and keeps a beam: as wide as that, imperfections
/// that are of first order in the fit may leave none. One without any ordinary imperfections gets them, where it is then not poor; another poor one
/// stays as it is. One that has readings of its own keeps them.
pub fn relearnt(data: &Data, fitted: Fitted) -> Fitted {
    let lacks_all = fitted.hypothesis.ordinary.is_empty();
    if fitted.is_poor() && !lacks_all {
        return fitted;
    }
    let kept = fitted.own.as_deref().cloned();
    let data = kept.as_ref().unwrap_or(data);
    let again =
        |hypothesis: Hypothesis, from: &Fitted| Fitted::from_guess(data, &hypothesis, &from.guess(data, &hypothesis));
    let with_all = || Hypothesis { ordinary: Family::all(), ..fitted.hypothesis.clone() };
    let begun = if lacks_all { again(with_all(), &fitted) } else { Ok(fitted.clone()) };
    let begun = begun.ok().filter(|begun| !begun.is_poor());
    let learnt = begun.and_then(|begun| again(widths::learnt(begun.data(data), &begun), &begun).ok());
    let is_better = |learnt: &Fitted| !learnt.is_poor() && (lacks_all || learnt.log_evidence > fitted.log_evidence);
    let best = learnt.filter(|learnt| is_better(learnt) && learnt.is_stable(data)).unwrap_or(fitted);
    if kept.is_some() { best.keeping(data) } else { best }
}
