//! What is believed before any data: prior odds of missing physics, and the probabilities at which something counts.

use std::collections::BTreeMap;

use twin::EffectKind;

use super::term::Term;

/// Probability at which a cause counts as decided.
pub const DECISIVE: f64 = 0.95;
/// Probability of missing physics that can be seen above which a recording is not consistent. A lower limit would call too many recordings without
/// missing physics ambiguous.
pub const SUSPICIOUS: f64 = 0.6;

/// Prior odds of one (more) effect.
pub const ODDS: f64 = 1.0;
const ODDS_FURTHER: f64 = 0.25;
/// Prior probability of physics that the library does not hold.
pub const UNMODELLED: f64 = 0.15;
/// Share of it that is too small to be seen. Nothing is known of its size, so that it is taken to hide as often as the library's effects do: these are 0.43 times
/// as likely as before where nothing is found, on average of 1186 simulated empty campaigns.
pub const TOO_SMALL: f64 = 0.4;
/// Prior probability of what can be seen of it.
const UNMODELLED_SEEN: f64 = (1.0 - TOO_SMALL) * UNMODELLED;
/// Number of sorts of location that compete with each other, equally likely a priori.
const SORTS: usize = 15;

/// Prior odds of one more beside some effects.
pub fn odds_beside(effects: usize) -> f64 {
    if effects == 0 { ODDS } else { ODDS_FURTHER }
}

/// `ln` prior of each candidate, given that the library holds the effect.
pub fn log_prior(terms: &[Term]) -> Vec<f64> {
    let mut count: BTreeMap<EffectKind, usize> = BTreeMap::new();
    terms.iter().for_each(|term| *count.entry(term.kind).or_default() += 1);
    let kinds = count.len() as f64;
    terms.iter().map(|term| -(kinds * count[&term.kind] as f64).ln()).collect()
}

/// Correction of a first search for the number of candidates: the `ln` Bayes factor of each that gives even odds.
pub fn corrections(terms: &[Term]) -> Vec<f64> {
    log_prior(terms).into_iter().map(|prior| -(prior + ((1.0 - UNMODELLED) * ODDS).ln())).collect()
}

/// The same for one sort of unmodelled discrepancy that has no sites.
pub fn correction_of_sort() -> f64 {
    -log_prior_unmodelled(ODDS, 1)
}

/// `ln` prior odds of an unmodelled discrepancy at one of some sites over none, by those of one (more) cause.
pub fn log_prior_unmodelled(odds: f64, sites: usize) -> f64 {
    (UNMODELLED_SEEN * odds / (SORTS * sites) as f64).ln()
}
