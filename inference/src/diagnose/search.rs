//! From all candidates to the few that the data speak for, the price of the search paid.
//!
//! Prior: nothing is missing in half of all campaigns. Where something is, it is one effect, or more with odds of 1 to 4 each; it
//! is something that the library does not hold with 15 %, else each kind is as likely as the other, and each place of a kind.
//! The posterior weight of a candidate is its prior times its evidence: exact twin, everything refitted, for the leaders; first
//! order for the rest.
//!
//! Forward: the best candidate is taken up as long as "one more" is clearly more likely than "no more". Backward: each is taken out
//! again and all candidates compete for its slot, given the others.

use std::collections::BTreeMap;

use nalgebra::DVector;
use twin::{EffectError, EffectKind};

use super::SUSPICIOUS;
use super::data::Data;
use super::discrepancy::{self, Discrepancy, SORTS};
use super::fit::Fitted;
use super::hypothesis::{Hypothesis, Scatter, Term, members};
use super::scan::{Candidate, scan};

/// Prior odds of one (more) effect.
const ODDS: f64 = 1.0;
const ODDS_FURTHER: f64 = 0.25;
/// Share of what the library does not hold.
const UNKNOWN: f64 = 0.15;
/// Rounds of competition for all slots.
const ROUNDS: usize = 2;
/// Effects at most.
const MOST: usize = 4;
/// Leaders that are refitted exactly, and how far behind the first a candidate may be, in nat and relative to the first.
const LEADERS: usize = 8;
const BEHIND: f64 = 6.0;
const BEHIND_SHARE: f64 = 0.3;
/// `ln` Bayes factor below which first order will do.
const WORTH: f64 = 3.0;

/// What may fill a slot.
#[derive(Debug, Clone)]
pub enum Cause {
    /// An effect of the library.
    Effect(Term),
    /// Something else.
    Unknown(Discrepancy),
}

/// One cause that competes for a slot.
#[derive(Debug, Clone)]
pub struct Alternative {
    /// The cause.
    pub cause: Cause,
    /// `ln` evidence over the fit without it.
    pub log_gain: f64,
    /// Posterior probability within the slot.
    pub probability: f64,
    /// Amplitude and its standard deviation, in the unit of the kind.
    pub amplitude: (f64, f64),
    /// How the vars and other unknowns adapt to it, to first order, in units of their prior standard deviations.
    pub adapting: DVector<f64>,
    /// The exact fit with it, for the leaders.
    pub fitted: Option<Fitted>,
}

/// One effect, given the others: who competes for it.
#[derive(Debug, Clone)]
pub struct Slot {
    /// Most likely first; those of any weight.
    pub alternatives: Vec<Alternative>,
    /// Probability that nothing fills it.
    pub nothing: f64,
    /// `ln` posterior odds of something over nothing.
    pub log_odds: f64,
    /// All candidates, to first order.
    pub scanned: Vec<Candidate>,
    /// The fit without it.
    pub without: Fitted,
}

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
    pub slots: Vec<Slot>,
    /// Who would be next.
    pub next: Slot,
}

impl Found {
    /// Probability that nothing is missing.
    pub fn nothing(&self) -> f64 {
        self.slots.iter().fold(self.next.nothing, |least, slot| least.min(slot.nothing))
    }
}

/// `ln` prior of each candidate, given that the library holds the effect.
fn log_prior(terms: &[Term]) -> Vec<f64> {
    let mut count: BTreeMap<&str, usize> = BTreeMap::new();
    terms.iter().for_each(|term| *count.entry(term.kind.word()).or_default() += 1);
    let kinds = count.len() as f64;
    terms.iter().map(|term| -(kinds * count[term.kind.word()] as f64).ln()).collect()
}

/// The price of a first search: what a `ln` Bayes factor has to exceed for even odds, of each candidate.
pub fn prices(terms: &[Term]) -> Vec<f64> {
    log_prior(terms).into_iter().map(|prior| -(prior + ((1.0 - UNKNOWN) * ODDS).ln())).collect()
}

/// The same of something without a class.
pub fn price_of(discrepancy: &Discrepancy) -> f64 {
    -(UNKNOWN * ODDS / (SORTS * discrepancy.sites) as f64).ln()
}

/// The candidates of a recording, and what they are worth beforehand.
pub struct Search {
    data: Data,
    terms: Vec<Term>,
    /// `ln` prior of each candidate, given that the library holds the effect.
    log_prior: Vec<f64>,
}

impl Search {
    /// A search among candidates.
    pub fn new(data: Data, terms: Vec<Term>) -> Self {
        let log_prior = log_prior(&terms);
        Self { data, terms, log_prior }
    }

    /// Search.
    ///
    /// # Errors
    /// [`EffectError`].
    pub fn run(mut self) -> Result<Found, EffectError> {
        let mut null = self.straighten(&Hypothesis::default())?;
        let mut next = self.slot(&null, 0)?;
        if let Some(scatter) = self.scatter(&null, &next)? {
            null = self.straighten(&Hypothesis { scatter, ..Hypothesis::default() })?;
            next = self.slot(&null, 0)?;
        }
        let (mut best, mut slots) = (null.clone(), Vec::new());
        while best.hypothesis.terms.len() < MOST && next.nothing < 1.0 - SUSPICIOUS && next.library() > next.unknown() {
            let Some(fitted) = next.leader() else { break };
            let reversed = best.hypothesis.reversed_correctors();
            (best, slots) = self.settle(fitted, next)?;
            if best.hypothesis.reversed_correctors() != reversed {
                best = self.straighten(&best.hypothesis)?;
                null = Fitted::of(&self.data, &null.hypothesis, &null.u)?;
                slots = (0..best.hypothesis.terms.len()).map(|i| self.without(&best, i)).collect::<Result<_, _>>()?;
            }
            next = self.slot(&best, best.hypothesis.terms.len())?;
        }
        Ok(Found { data: self.data, null, best, slots, next })
    }

    /// Fit, and straighten the readings by the machine that was found.
    fn straighten(&mut self, hypothesis: &Hypothesis) -> Result<Fitted, EffectError> {
        let zero = DVector::zeros(self.data.ring.quadrupoles.len());
        let mut fitted = Fitted::of(&self.data, hypothesis, &zero)?;
        if !fitted.is_gross() {
            self.data.trim(&fitted.residual);
            fitted = Fitted::of(&self.data, hypothesis, &fitted.u)?;
        }
        let machine = hypothesis.reversed_correctors().machine(&self.data, &fitted.params, &[])?.0;
        // a machine that keeps no beam in one of the settings is not the one that was recorded
        if self.data.straighten(&machine).is_err() {
            return Ok(fitted);
        }
        Fitted::of(&self.data, hypothesis, &fitted.u)
    }

    /// Let all candidates compete for each slot, given the others, until the best one is in each. The only effect of a fit has
    /// just won its competition.
    fn settle(&self, fitted: Fitted, won: Slot) -> Result<(Fitted, Vec<Slot>), EffectError> {
        let mut best = fitted;
        if best.hypothesis.terms.len() == 1 {
            return Ok((best, vec![won]));
        }
        for _ in 0..ROUNDS {
            let mut slots = Vec::new();
            let mut changed = false;
            for i in 0..best.hypothesis.terms.len() {
                let slot = self.without(&best, i)?;
                if let Some(fitted) = slot.leader()
                    && fitted.hypothesis.terms.last() != best.hypothesis.terms.get(i)
                {
                    (best, changed) = (fitted, true);
                }
                slots.push(slot);
            }
            if !changed {
                return Ok((best, slots));
            }
        }
        let slots = (0..best.hypothesis.terms.len()).map(|i| self.without(&best, i)).collect::<Result<_, _>>()?;
        Ok((best, slots))
    }

    /// The competition for one of the effects of a fit.
    fn without(&self, fitted: &Fitted, term: usize) -> Result<Slot, EffectError> {
        let rest = super::heldout::reduced(&self.data, fitted, term)?;
        self.slot(&rest, fitted.hypothesis.terms.len() - 1)
    }

    /// The competition for one more effect beside those of a fit.
    fn slot(&self, fitted: &Fitted, effects: usize) -> Result<Slot, EffectError> {
        let odds = if effects == 0 { ODDS } else { ODDS_FURTHER };
        let scanned = scan(fitted.data(&self.data), fitted, &self.terms)?;
        let prior_of = |i: usize| self.log_prior[i] + ((1.0 - UNKNOWN) * odds).ln();
        let leaders = self.leaders(fitted, &scanned)?;
        let mut weights: Vec<(Alternative, f64)> = Vec::new();
        for (i, candidate) in scanned.iter().enumerate() {
            if fitted.hypothesis.terms.contains(&candidate.term) {
                continue;
            }
            let alternative =
                if leaders.contains(&i) { self.refit(fitted, candidate) } else { Alternative::of(candidate) };
            let weight = alternative.log_gain + prior_of(i);
            weights.push((alternative, weight));
        }
        for discrepancy in discrepancy::scan(&self.data, fitted)? {
            let prior = (UNKNOWN * odds / (SORTS * discrepancy.sites) as f64).ln();
            let weight = discrepancy.log_bayes + prior;
            weights.push((Alternative::unknown(discrepancy), weight));
        }
        Ok(Slot::of(weights, fitted.clone(), scanned))
    }

    /// The candidates that are worth an exact fit. Where the fit is far off, its vars are bent out of shape and mislead: those
    /// that lead at the prior's mean are then taken too.
    fn leaders(&self, fitted: &Fitted, scanned: &[Candidate]) -> Result<Vec<usize>, EffectError> {
        let mut leaders = self.first(scanned, &fitted.hypothesis);
        if fitted.is_gross() {
            let start = Fitted::unfitted(&self.data, &fitted.hypothesis)?;
            leaders.extend(self.first(&scan(&self.data, &start, &self.terms)?, &fitted.hypothesis));
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

    fn refit(&self, fitted: &Fitted, candidate: &Candidate) -> Alternative {
        let hypothesis = fitted.hypothesis.with(candidate.term.clone());
        let vars = fitted.params.len();
        // the new unknowns of a term stand before those of scatter
        let at = vars + fitted.hypothesis.unknowns(&self.data).len() - fitted.hypothesis.members(&self.data);
        let new = hypothesis.unknowns(&self.data).len() - fitted.hypothesis.unknowns(&self.data).len();
        let mut guess = fitted.u.clone().insert_rows(at, new, 0.0);
        if new > 0 {
            guess[at] = candidate.amplitude;
        }
        let mut guesses = vec![guess];
        if fitted.is_gross() {
            guesses.push(DVector::zeros(vars));
        }
        let fits = guesses.iter().filter_map(|guess| Fitted::of(&self.data, &hypothesis, guess).ok());
        // a candidate that leads to no stable machine is none
        let Some(refitted) = fits.max_by(|one, other| one.log_evidence.total_cmp(&other.log_evidence)) else {
            return Alternative { log_gain: f64::NEG_INFINITY, ..Alternative::of(candidate) };
        };
        Alternative {
            cause: Cause::Effect(candidate.term.clone()),
            log_gain: refitted.log_evidence - fitted.log_evidence,
            probability: 0.0,
            amplitude: refitted.amplitude(&self.data, fitted.hypothesis.terms.len()),
            adapting: DVector::zeros(0),
            fitted: Some(refitted),
        }
    }

    /// Families of instruments or magnets that scatter, if that explains the data better than any single effect.
    fn scatter(&self, fitted: &Fitted, next: &Slot) -> Result<Option<Vec<Scatter>>, EffectError> {
        let single = next.log_odds;
        let mut best: Option<(Scatter, f64)> = None;
        for &(kind, widths) in &FAMILIES {
            let terms = members(kind, &self.data);
            let logs = super::scan::family(&self.data, fitted, &terms, widths)?;
            for (&width, log_bayes) in widths.iter().zip(logs) {
                if best.as_ref().is_none_or(|(_, largest)| log_bayes > *largest) {
                    best = Some((Scatter { kind, width }, log_bayes));
                }
            }
        }
        let price = ((FAMILIES.len() * WIDTHS) as f64).ln() + CLEARLY;
        Ok(best.filter(|(_, log_bayes)| *log_bayes > price && *log_bayes - price > single).map(|(one, _)| vec![one]))
    }
}

/// Widths that are tried of each family.
const WIDTHS: usize = 3;
/// By how much scatter of a whole family has to describe the readings better than any single effect [nat]: where rolls imitate each
/// other a family can stand in for any of them.
const CLEARLY: f64 = 6.0;
/// Families whose members all scatter a little, and the widths tried, in the unit of the kind.
///
/// Source: alignment and calibration tolerances, from good to poor (1 to 5 % of gain, 5 to 30 mrad; 1 to 5 mrad of a quadrupole).
const FAMILIES: [(EffectKind, &[f64]); 5] = [
    (EffectKind::BpmGain, &[0.01, 0.02, 0.04]),
    (EffectKind::CorrectorGain, &[0.01, 0.02, 0.04]),
    (EffectKind::BpmRoll, &[0.01, 0.02, 0.04]),
    (EffectKind::CorrectorRoll, &[0.01, 0.02, 0.04]),
    (EffectKind::QuadRoll, &[0.001, 0.002, 0.004]),
];

impl Alternative {
    fn of(candidate: &Candidate) -> Self {
        let scale = candidate.term.kind.prior_scale();
        let sigma = scale.map_or(0.0, |scale| scale / (1.0 + candidate.power).sqrt());
        Self {
            amplitude: (candidate.amplitude * scale.unwrap_or(1.0), sigma),
            cause: Cause::Effect(candidate.term.clone()),
            log_gain: candidate.log_bayes,
            probability: 0.0,
            adapting: &candidate.adapting * candidate.amplitude,
            fitted: None,
        }
    }

    fn unknown(discrepancy: Discrepancy) -> Self {
        Self {
            amplitude: (discrepancy.size, 0.0),
            log_gain: discrepancy.log_bayes,
            cause: Cause::Unknown(discrepancy),
            probability: 0.0,
            adapting: DVector::zeros(0),
            fitted: None,
        }
    }

    /// True for an effect of the library.
    pub fn is_of_library(&self) -> bool {
        matches!(self.cause, Cause::Effect(_))
    }
}

/// Probability below which an alternative is not listed.
const LISTED: f64 = 1e-4;

impl Slot {
    /// Normalise posterior weights (`ln`, "nothing" having 0).
    fn of(mut weights: Vec<(Alternative, f64)>, without: Fitted, scanned: Vec<Candidate>) -> Self {
        weights.retain(|(_, weight)| weight.is_finite());
        let largest = weights.iter().map(|(_, weight)| *weight).fold(0.0, f64::max);
        let nothing = (-largest).exp();
        let something: f64 = weights.iter().map(|(_, weight)| (weight - largest).exp()).sum();
        let sum = nothing + something;
        weights.iter_mut().for_each(|(alternative, weight)| alternative.probability = (*weight - largest).exp() / sum);
        let mut alternatives: Vec<Alternative> = weights.into_iter().map(|(alternative, _)| alternative).collect();
        alternatives.sort_by(|one, other| other.probability.total_cmp(&one.probability));
        alternatives.retain(|alternative| alternative.probability > LISTED);
        let log_odds = largest + something.ln();
        Self { alternatives, nothing: nothing / sum, log_odds, scanned, without }
    }

    /// Probability of an effect of the library.
    pub fn library(&self) -> f64 {
        self.alternatives.iter().filter(|a| a.is_of_library()).map(|a| a.probability).sum()
    }

    /// Probability of something else.
    pub fn unknown(&self) -> f64 {
        self.alternatives.iter().filter(|a| !a.is_of_library()).map(|a| a.probability).sum()
    }

    /// The exact fit with the most likely effect of the library.
    fn leader(&self) -> Option<Fitted> {
        self.alternatives.iter().filter(|a| a.is_of_library()).find_map(|a| a.fitted.clone())
    }
}
