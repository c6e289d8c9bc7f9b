//! From all candidates to the few that the data speak for, the price of the search paid.
//!
//! Prior: nothing is missing in half of all campaigns. Where something is, it is one effect, or more with odds of 1 to 4 each; it
//! is something that the library does not hold with 15 %, else each kind is as likely as the other, and each place of a kind.
//! The posterior weight of a candidate is its prior times its evidence: exact twin, everything refitted, for the leaders; first
//! order for the rest.
//!
//! Forward: the best candidate is taken up as long as "one more" is clearly more likely than "no more". Backward: each is taken out
//! again and all candidates compete for its competition, given the others; one that need not be there is dropped. Where something
//! without a class is the most likely, one more effect is still tried: two strong ones may need each other.

use std::collections::BTreeMap;

use nalgebra::DVector;
use twin::EffectKind;

use super::alternatives::{Alternative, Competition};
use super::data::Data;
use super::discrepancy::{self, Discrepancy};
use super::fit::{FitError, Fitted};
use super::hypothesis::{Hypothesis, Scatter, Term, members};
use super::location::SORTS;
use super::scan::{Candidate, scan};
use inference::bounded::softplus;

/// Prior odds of one (more) effect.
const ODDS: f64 = 1.0;
const ODDS_FURTHER: f64 = 0.25;
/// Share of what the library does not hold.
const UNMODELLED: f64 = 0.15;
/// Rounds of competition for all competitions, and the gain of `ln` posterior that is worth another one.
const ROUNDS: usize = 3;
const BETTER: f64 = 0.1;
/// Effects at most.
const MOST: usize = 4;
/// Leaders that are refitted exactly, and how far behind the first a candidate may be, in nat and relative to the first.
const LEADERS: usize = 8;
const BEHIND: f64 = 6.0;
const BEHIND_SHARE: f64 = 0.3;
/// `ln` Bayes factor below which first order will do.
const WORTH: f64 = 3.0;

/// Passes of straightening at most, and the chi-square of what one changes from which on the next is worth it.
const PASSES: usize = 4;
const CURVED: f64 = 4.0;

/// What the search found.
#[derive(Debug, Clone)]
pub struct Found {
    /// The recording, its curvature taken from the machine that was found.
    pub data: Data,
    /// The fit without any effect (ordinary scatter included).
    pub null: Fitted,
    /// The fit with all that were taken up.
    pub best: Fitted,
    /// One for each effect of `best`, in its order.
    pub competitions: Vec<Competition>,
    /// Who would be next.
    pub next: Competition,
}

impl Found {
    /// Probability that nothing is missing.
    pub fn nothing(&self) -> f64 {
        self.competitions.iter().fold(self.next.nothing, |least, competition| least.min(competition.nothing))
    }
}

/// Prior odds of one more beside some effects.
fn odds(effects: usize) -> f64 {
    if effects == 0 { ODDS } else { ODDS_FURTHER }
}

/// `ln` prior of each candidate, given that the library holds the effect.
fn log_prior(terms: &[Term]) -> Vec<f64> {
    let mut count: BTreeMap<EffectKind, usize> = BTreeMap::new();
    terms.iter().for_each(|term| *count.entry(term.kind).or_default() += 1);
    let kinds = count.len() as f64;
    terms.iter().map(|term| -(kinds * count[&term.kind] as f64).ln()).collect()
}

/// The price of a first search: what a `ln` Bayes factor has to exceed for even odds, of each candidate.
pub fn corrections(terms: &[Term]) -> Vec<f64> {
    log_prior(terms).into_iter().map(|prior| -(prior + ((1.0 - UNMODELLED) * ODDS).ln())).collect()
}

/// The same of something without a class.
pub fn correction_of(discrepancy: &Discrepancy) -> f64 {
    -(UNMODELLED * ODDS / (SORTS * discrepancy.sites) as f64).ln()
}

/// The candidates of a recording, and what they are worth beforehand.
pub struct Search {
    terms: Vec<Term>,
    /// `ln` prior of each candidate, given that the library holds the effect.
    log_prior: Vec<f64>,
}

impl Search {
    /// A search among candidates.
    pub fn new(terms: Vec<Term>) -> Self {
        let log_prior = log_prior(&terms);
        Self { terms, log_prior }
    }

    /// Search.
    ///
    /// # Errors
    /// [`FitError`].
    pub fn run(&self, data: Data) -> Result<Found, FitError> {
        let mut found = self.without_effects(data)?;
        // effects can put each other out, so that there may be more steps than effects
        for _ in 0..2 * MOST {
            if found.competitions.len() >= MOST || !found.next.is_suspicious() {
                break;
            }
            let Some(leader) = found.next.leader() else { break };
            // a trial that leads to no stable machine is not taken
            let Ok(further) = self.further(&found, leader) else { break };
            // back where it was: one effect has put another out
            let gained = self.log_posterior(&further.best) - self.log_posterior(&found.best);
            if further.competitions.len() <= found.competitions.len() && gained < BETTER {
                break;
            }
            // something without a class may say it better than one more effect, but not than two that need each other
            if found.next.library() <= found.next.unknown() && self.log_weight(&further) < self.log_weight(&found) {
                break;
            }
            found = further;
        }
        Ok(found)
    }

    /// Nothing but vars, and the ordinary scatter of a family if there is any.
    fn without_effects(&self, mut data: Data) -> Result<Found, FitError> {
        let zero = DVector::zeros(data.units.len());
        let mut null = fit_linearised(&mut data, &Hypothesis::default(), &zero)?;
        let mut next = self.one_more(&data, &null)?;
        if let Ok(Some(scatter)) = scatter(&data, &null, &next) {
            let mut scattered = data.clone();
            if let Ok(fitted) = fit_linearised(&mut scattered, &Hypothesis { scatter, ..Hypothesis::default() }, &zero) {
                (data, null) = (scattered, fitted);
                next = self.one_more(&data, &null)?;
            }
        }
        Ok(Found { data, best: null.clone(), null, competitions: Vec::new(), next })
    }

    /// One more effect.
    fn further(&self, found: &Found, leader: Fitted) -> Result<Found, FitError> {
        let mut data = found.data.clone();
        let mut null = found.null.clone();
        let (mut best, mut competitions) = self.settle(&data, leader, &found.next)?;
        // orbits that the effects have changed are curved in another way; without them the readings would be curved as before, by
        // less than what decides where there is so much to straighten
        if data.linearise_about(&best.machine(&data)?.0).is_ok_and(|moved| moved > CURVED) {
            best = fit_linearised(&mut data, &best.hypothesis, &best.u)?;
            null = Fitted::of(&data, &null.hypothesis, &null.u)?;
            competitions = (0..competitions.len()).map(|i| self.without(&data, &best, i)).collect::<Result<_, _>>()?;
        } else {
            data = found.data.clone();
        }
        let next = self.one_more(&data, &best)?;
        Ok(Found { data, null, best, competitions, next })
    }

    /// `ln` posterior of the effects of a fit, with or without something beside them.
    fn log_weight(&self, found: &Found) -> f64 {
        let odds: f64 = (0..found.competitions.len()).map(|i| ((1.0 - UNMODELLED) * odds(i)).ln()).sum();
        self.log_posterior(&found.best) - found.null.log_evidence + odds + softplus(found.next.log_odds)
    }

    /// `ln` posterior of a fit among those with as many effects.
    fn log_posterior(&self, fitted: &Fitted) -> f64 {
        let prior_of = |term: &Term| self.terms.iter().position(|one| one == term).map_or(0.0, |at| self.log_prior[at]);
        fitted.log_evidence + fitted.hypothesis.terms.iter().map(prior_of).sum::<f64>()
    }

    /// Let all candidates compete for each competition, given the others, until the best one is in each; what then need not be there is
    /// taken out. The last effect of the fit has just won the competition for its competition.
    fn settle(&self, data: &Data, fitted: Fitted, won: &Competition) -> Result<(Fitted, Vec<Competition>), FitError> {
        let (mut best, mut competitions) = self.compete(data, fitted, Some(won))?;
        while let Some(idle) =
            competitions.iter().filter(|competition| !competition.is_suspicious()).max_by(|a, b| a.nothing.total_cmp(&b.nothing))
            && competitions.len() > 1
        {
            (best, competitions) = self.compete(data, idle.without.clone(), None)?;
        }
        Ok((best, competitions))
    }

    /// The competition for every competition, again where a better one has got into one of them.
    fn compete(&self, data: &Data, fitted: Fitted, won: Option<&Competition>) -> Result<(Fitted, Vec<Competition>), FitError> {
        let mut best = fitted;
        let last = best.hypothesis.terms.len() - 1;
        let mut competitions = Vec::new();
        for round in 0.. {
            let mut changed = false;
            competitions.clear();
            for i in 0..=last {
                let known = won.filter(|_| round == 0 && i == last && !changed);
                let competition = known.map_or_else(|| self.without(data, &best, i), |won| Ok(won.clone()))?;
                // the same effects may have been fitted better from elsewhere
                if let Some(other) = competition.leader()
                    && self.log_posterior(&other) > self.log_posterior(&best) + BETTER
                    && round < ROUNDS
                {
                    (best, changed) = (other, true);
                }
                competitions.push(competition);
            }
            if !changed {
                break;
            }
        }
        Ok((best, competitions))
    }

    /// The competition for one of the effects of a fit.
    fn without(&self, data: &Data, fitted: &Fitted, term: usize) -> Result<Competition, FitError> {
        let rest = super::heldout::reduced(data, fitted, term)?;
        let present = Alternative::exact(data, &rest, fitted.clone(), term);
        self.competition(data, &rest, Some(present))
    }

    /// The competition for one more effect beside those of a fit.
    fn one_more(&self, data: &Data, fitted: &Fitted) -> Result<Competition, FitError> {
        self.competition(data, fitted, None)
    }

    /// The same, where one of the candidates has been fitted already.
    fn competition(&self, data: &Data, fitted: &Fitted, present: Option<Alternative>) -> Result<Competition, FitError> {
        let odds = odds(fitted.hypothesis.terms.len());
        let scanned = scan(fitted.data(data), fitted, &self.terms)?;
        let prior_of = |i: usize| self.log_prior[i] + ((1.0 - UNMODELLED) * odds).ln();
        let leaders = self.leaders(data, fitted, &scanned)?;
        let mut weights: Vec<(Alternative, f64)> = Vec::new();
        let mut least = f64::INFINITY;
        for (i, candidate) in scanned.iter().enumerate() {
            if fitted.hypothesis.terms.contains(&candidate.term) {
                continue;
            }
            let known = present.clone().filter(|present| present.term() == Some(&candidate.term));
            let alternative = match leaders.contains(&i) {
                true => refit(data, fitted, candidate, least),
                false => Alternative::of(candidate),
            };
            let alternative = known.filter(|known| known.log_gain > alternative.log_gain).unwrap_or(alternative);
            // the costs of drifting baselines are of other numbers
            if let Some(fitted) = alternative.fitted.as_ref().filter(|_| !candidate.term.kind.moves_baselines()) {
                least = least.min(fitted.cost);
            }
            let weight = alternative.log_gain + prior_of(i);
            weights.push((alternative, weight));
        }
        for discrepancy in discrepancy::scan(data, fitted)? {
            let prior = (UNMODELLED * odds / (SORTS * discrepancy.sites) as f64).ln();
            let weight = discrepancy.log_bayes + prior;
            weights.push((Alternative::unmodelled(discrepancy), weight));
        }
        Ok(Competition::of(weights, fitted.clone(), scanned))
    }

    /// The candidates that are worth an exact fit. Where the fit is far off, its vars are bent out of shape and mislead: those
    /// that lead at the prior's mean are then taken too.
    fn leaders(&self, data: &Data, fitted: &Fitted, scanned: &[Candidate]) -> Result<Vec<usize>, FitError> {
        let mut leaders = self.first(scanned, &fitted.hypothesis);
        if fitted.is_gross() {
            let at_mean = Fitted::unfitted(data, &fitted.hypothesis).and_then(|start| scan(data, &start, &self.terms));
            leaders.extend(at_mean.map_or_else(|_| Vec::new(), |scanned| self.first(&scanned, &fitted.hypothesis)));
        }
        Ok(leaders)
    }

    /// Those near the first of a scan.
    fn first(&self, scanned: &[Candidate], hypothesis: &Hypothesis) -> Vec<usize> {
        let weight = |i: usize| scanned[i].log_bayes + self.log_prior[i];
        let mut order: Vec<usize> =
            (0..scanned.len()).filter(|&i| !hypothesis.terms.contains(&scanned[i].term)).collect();
        order.sort_by(|&one, &other| weight(other).total_cmp(&weight(one)));
        let Some(&best) = order.first() else { return order };
        let behind = BEHIND.max(BEHIND_SHARE * scanned[best].log_bayes);
        order.retain(|&i| weight(i) > weight(best) - behind && scanned[i].log_bayes > WORTH);
        order.truncate(LEADERS);
        order
    }
}

/// Fit, and straighten the readings by the machine that was found, until that changes them no more.
fn fit_linearised(data: &mut Data, hypothesis: &Hypothesis, guess: &DVector<f64>) -> Result<Fitted, FitError> {
    let mut fitted = Fitted::of(data, hypothesis, guess)?;
    if !fitted.is_gross() {
        data.trim(&fitted.residual);
        fitted = Fitted::of(data, hypothesis, &fitted.u)?;
    }
    for _ in 0..PASSES {
        // a machine that keeps no beam in one of the settings is not the one that was recorded
        let Ok(moved) = data.linearise_about(&fitted.machine(data)?.0) else { break };
        let Ok(again) = Fitted::of(data, hypothesis, &fitted.u) else { break };
        fitted = again;
        if moved < CURVED {
            break;
        }
    }
    Ok(fitted)
}

/// The exact fit with a candidate, given up where it stays far behind the least cost of its rivals.
fn refit(data: &Data, fitted: &Fitted, candidate: &Candidate, least: f64) -> Alternative {
    let hypothesis = fitted.hypothesis.with(candidate.term);
    let vars = fitted.params.len();
    // the new unknowns of a term stand before those of scatter
    let at = vars + fitted.hypothesis.unknowns(data).len() - fitted.hypothesis.members(data);
    let new = hypothesis.unknowns(data).len() - fitted.hypothesis.unknowns(data).len();
    let mut guess = fitted.u.clone().insert_rows(at, new, 0.0);
    if new > 0 {
        guess[at] = candidate.amplitude;
    }
    let mut guesses = vec![guess];
    if fitted.is_gross() {
        guesses.push(DVector::zeros(vars));
    }
    let fits = guesses.iter().filter_map(|guess| Fitted::against(data, &hypothesis, guess, least).ok());
    // a candidate that leads to no stable machine is none
    let Some(refitted) = fits.max_by(|one, other| one.log_evidence.total_cmp(&other.log_evidence)) else {
        return Alternative { log_gain: f64::NEG_INFINITY, ..Alternative::of(candidate) };
    };
    Alternative::exact(data, fitted, refitted, fitted.hypothesis.terms.len())
}

/// Families of instruments or magnets that scatter, if that explains the data better than any single effect.
fn scatter(data: &Data, fitted: &Fitted, next: &Competition) -> Result<Option<Vec<Scatter>>, FitError> {
    let single = next.log_odds;
    let mut best: Option<(Scatter, f64)> = None;
    for &(kind, name, widths) in &FAMILIES {
        let terms = members(kind, data);
        let logs = super::scan::family(data, fitted, &terms, widths)?;
        for (&width, log_bayes) in widths.iter().zip(logs) {
            if best.as_ref().is_none_or(|(_, largest)| log_bayes > *largest) {
                best = Some((Scatter { kind, name, width }, log_bayes));
            }
        }
    }
    let correction = ((FAMILIES.len() * WIDTHS) as f64).ln() + CLEARLY;
    Ok(best.filter(|(_, log_bayes)| *log_bayes > correction && *log_bayes - correction > single).map(|(one, _)| vec![one]))
}

/// Widths that are tried of each family.
const WIDTHS: usize = 3;
/// By how much scatter of a whole family has to describe the readings better than any single effect [nat]: where rolls imitate each
/// other a family can stand in for any of them.
const CLEARLY: f64 = 6.0;
/// Families whose members all scatter a little, and the widths tried, in the unit of the kind.
///
/// Source: alignment and calibration tolerances, from good to poor (1 to 5 % of gain, 5 to 30 mrad; 1 to 5 mrad of a quadrupole).
const FAMILIES: [(EffectKind, &str, &[f64]); 5] = [
    (EffectKind::BpmGain, "BPM gains", &[0.01, 0.02, 0.04]),
    (EffectKind::CorrectorGain, "corrector gains", &[0.01, 0.02, 0.04]),
    (EffectKind::BpmRoll, "BPM rolls", &[0.01, 0.02, 0.04]),
    (EffectKind::CorrectorRoll, "corrector rolls", &[0.01, 0.02, 0.04]),
    (EffectKind::QuadRoll, "quadrupole rolls", &[0.001, 0.002, 0.004]),
];
