//! The search for the effects that the data support, corrected for the number of candidates tried.
//!
//! Prior: in half of all campaigns the model is complete. Otherwise one effect is missing, and each further one with odds of 1 to 4. With
//! 15 % it is physics that the library does not hold, two in five of which are too small to be seen; else all kinds are equally likely, and all places of
//! a kind.
//! The posterior weight of a candidate is its prior times its evidence: exact twin, everything refitted, for the leaders; first
//! order for the rest.
//!
//! Forward: the best candidate is added as long as one more effect is clearly more likely than none. Backward: each effect is removed
//! in turn and competes with all candidates, given the others; one that is not needed is dropped. Where an unmodelled discrepancy is
//! the most likely, one more effect is still tried: two strong effects may show only together. Where it is an unknown element in the end, the search goes on
//! with that in the model (`search/element.rs`).

mod element;
mod refit;
mod wandering;

use core::cell::Cell;

use nalgebra::DVector;
use twin::Ring;

use super::alternatives::{Alternative, Competition, least_weight};
use super::data::Data;
use super::discrepancy::{self, Discrepancy};
use super::element::Element;
use super::fit::{FitError, Fitted};
use super::heldout::lessened;
use super::hypothesis::Hypothesis;
use super::linearisation::{self, CURVED};
use super::odds::{ODDS, TOO_SMALL, UNMODELLED, log_prior, log_prior_unmodelled, odds_beside};
use super::scan::{Candidate, scan};
use super::term::Term;
use super::widths;
use element::weigh_elements;
use inference::softplus;
use refit::{
    BEHIND, BEHIND_SHARE, BETTER, WORTH, first_of, fitted_to, null_beside, refit, relearn, relearnt, settled,
    with_ordinary,
};
use wandering::wandering;

/// Rounds over all competitions.
const ROUNDS: usize = 3;
/// Effects at most.
const MOST: usize = 4;
/// Competitions after which no further effect is tried: so many are held where effects replace each other and none explains the recording.
const COMPETITIONS: usize = 40;
/// Places of an unknown element that are tried in the model, where the next search finds it elsewhere.
const PLACES: usize = 3;
/// Number of candidates that are refitted exactly.
const LEADERS: usize = 8;

/// The result of the search.
#[derive(Debug, Clone)]
pub struct Found {
    /// The recording, linearised about the machine that was found.
    pub data: Data,
    /// The fit without any effect.
    pub null: Fitted,
    /// The fit with all effects found.
    pub best: Fitted,
    /// The alternatives of each effect of `best`, in its order.
    pub competitions: Vec<Competition>,
    /// The alternatives of one more effect.
    pub next: Competition,
}

impl Found {
    /// Probability that the model without effects is complete.
    pub fn nothing(&self) -> f64 {
        self.competitions.iter().fold(self.next.nothing, |least, competition| least.min(competition.nothing))
    }

    /// True if the best fit has anything that the one without effects has not.
    pub fn has_more(&self) -> bool {
        !self.competitions.is_empty() || self.best.hypothesis.element.is_some()
    }
}

/// The competition of the one effect that was added to those found, if it is not needed, and neither is a further one.
fn not_needed(found: &Found, further: &Found) -> Option<Competition> {
    let is_new = |(_, term): &(&Competition, &Term)| !found.best.hypothesis.terms.contains(term);
    let all = further.competitions.iter().zip(&further.best.hypothesis.terms);
    let new: Vec<(&Competition, &Term)> = all.filter(is_new).collect();
    let [(added, _)] = new[..] else { return None };
    let is_one_more = further.competitions.len() == found.competitions.len() + 1;
    let is_idle = is_one_more && !added.is_suspicious() && !further.next.is_suspicious();
    is_idle.then(|| added.clone().keeping(&further.data))
}

/// Correction of a first search for an unmodelled discrepancy: the `ln` Bayes factor that gives even odds.
pub fn correction_of(discrepancy: &Discrepancy) -> f64 {
    -log_prior_unmodelled(ODDS, discrepancy.sites)
}

/// The candidates of a recording, with their prior.
pub struct Search {
    terms: Vec<Term>,
    /// `ln` prior of each candidate, given that the library holds the effect.
    log_prior: Vec<f64>,
    /// Competitions held so far.
    held: Cell<usize>,
}

impl Search {
    /// A search among candidates.
    pub fn new(terms: Vec<Term>) -> Self {
        let log_prior = log_prior(&terms);
        Self { terms, log_prior, held: Cell::new(0) }
    }

    /// Search.
    pub fn run(&self, data: Data) -> Result<Found, FitError> {
        let found = self.grown(self.with_noise(self.without_effects(data)?)?)?;
        // where that fails the search stands as it is
        let beside = self.searched_with_element(&found).unwrap_or(None);
        Ok(beside.unwrap_or(found))
    }

    /// One effect after the other, as long as one more is likely to be needed.
    fn grown(&self, mut found: Found) -> Result<Found, FitError> {
        // one effect can make another unnecessary, so that there may be more steps than effects
        for _ in 0..2 * MOST {
            let is_over = found.competitions.len() >= MOST || self.held.get() >= COMPETITIONS;
            if is_over || !found.next.is_suspicious() {
                break;
            }
            let Some(leader) = found.next.leader() else { break };
            // a trial without a stable machine is discarded
            let Ok(further) = self.further(&found, leader) else { break };
            // by readings that are linearised about the machine with it, it is not needed, nor is another one: nothing more is missing, and how likely that is
            // those readings say
            if let Some(added) = not_needed(&found, &further) {
                found.next = added;
                break;
            }
            // no progress: the new effect has only replaced another
            let gained = self.log_posterior(&further.best) - self.log_posterior(&found.best);
            if further.competitions.len() <= found.competitions.len() && gained < BETTER {
                break;
            }
            // an unmodelled discrepancy may be better than one more effect, but worse than two that show only together
            if found.next.library() <= found.next.unknown_seen() && self.log_weight(&further) < self.log_weight(&found)
            {
                break;
            }
            found = self.with_noise(further)?;
        }
        Ok(found)
    }

    /// The same, begun anew with monitors that wander as long as that is the most likely of what is left: what was found without knowing of them has to
    /// be found again.
    fn with_noise(&self, mut found: Found) -> Result<Found, FitError> {
        while let Some(wandering) = wandering(&found)? {
            self.held.set(0);
            found = self.without_effects(wandering)?;
        }
        Ok(found)
    }

    /// The fit of the vars and of what is ordinary. What makes a fit poor is not: ordinary imperfections, small by their nature, are then left out
    /// until a fit with them is good.
    fn without_effects(&self, mut data: Data) -> Result<Found, FitError> {
        data.is_about_effects = false;
        let (plain, start) = (Hypothesis::plain(), DVector::zeros(data.units.len()));
        let first = first_of(&data, &plain)?;
        let bare = || Hypothesis { ordinary: Vec::new(), ..plain };
        let hypothesis = if first.is_poor() { bare() } else { widths::learnt(&data, &first) };
        let guess = first.guess(&data, &hypothesis);
        let fitted = linearisation::fit(&mut data, &hypothesis, &guess).ok().filter(|fitted| fitted.is_stable(&data));
        let null = fitted.map_or_else(|| linearisation::fit(&mut data, &Hypothesis::default(), &start), Ok)?;
        let null = settled(&data, null);
        let next = self.one_more(&data, &null)?;
        Ok(Found { data, best: null.clone(), null, competitions: Vec::new(), next })
    }

    /// One more effect.
    fn further(&self, found: &Found, leader: Fitted) -> Result<Found, FitError> {
        let mut data = found.data.clone();
        // what is ordinary is no longer as wide as the effect had made it
        let again = settled(&data, leader.clone());
        // nor does a competition stand in which only the leaders had what is ordinary
        let is_alike = leader.hypothesis.ordinary.is_empty() == found.next.without.hypothesis.ordinary.is_empty();
        let won = (is_alike && again.log_evidence < leader.log_evidence + BETTER).then_some(&found.next);
        let (mut best, competitions) = self.settle(&data, won.map_or(again, |_| leader), won)?;
        // the effects change the orbits' higher orders, so that the readings are linearised about the new machine
        if data.linearise_each(&best).is_ok_and(|moved| moved > CURVED) {
            best = linearisation::fit(&mut data, &best.hypothesis, &best.u)?;
            if best.hypothesis.ordinary.is_empty() {
                best = with_ordinary(&mut data, best);
            }
            return self.about_effects(found, data, best);
        }
        let next = self.one_more(&found.data, &best)?;
        Ok(Found { data: found.data.clone(), null: found.null.clone(), best, competitions, next })
    }

    /// With readings that are linearised about the machine of a fit with effects, and that fit.
    fn about_effects(&self, found: &Found, mut data: Data, best: Fitted) -> Result<Found, FitError> {
        data.is_about_effects = true;
        let null = null_beside(&data, found.null.clone(), &found.data);
        let (best, competitions) = self.compete(&data, best, None)?;
        let next = self.one_more(&data, &best)?;
        Ok(Found { data, null, best, competitions, next })
    }

    /// `ln` posterior of the effects of a fit, with or without something beside them.
    fn log_weight(&self, found: &Found) -> f64 {
        let first = usize::from(found.best.hypothesis.element.is_some());
        let of_each = (0..found.competitions.len()).map(|i| ((1.0 - UNMODELLED) * odds_beside(first + i)).ln());
        let odds: f64 = of_each.sum();
        self.log_posterior(&found.best) - found.null.log_evidence + odds + softplus(found.next.log_odds)
    }

    /// `ln` posterior of a fit among those with as many effects.
    fn log_posterior(&self, fitted: &Fitted) -> f64 {
        let prior_of = |term: &Term| self.terms.iter().position(|one| one == term).map_or(0.0, |at| self.log_prior[at]);
        fitted.log_evidence + fitted.hypothesis.terms.iter().map(prior_of).sum::<f64>()
    }

    /// Let each effect compete with all candidates, given the others, until the best one stands in each place; effects that are then
    /// not needed are removed. The last effect of the fit may just have won its competition.
    fn settle(
        &self,
        data: &Data,
        fitted: Fitted,
        won: Option<&Competition>,
    ) -> Result<(Fitted, Vec<Competition>), FitError> {
        let least = if fitted.hypothesis.element.is_some() { 0 } else { 1 };
        let (mut best, mut competitions) = self.compete(data, fitted, won)?;
        while let Some(idle) = competitions
            .iter()
            .filter(|competition| !competition.is_suspicious())
            .max_by(|a, b| a.nothing.total_cmp(&b.nothing))
            && competitions.len() > least
        {
            (best, competitions) = self.compete(data, idle.without.clone(), None)?;
        }
        Ok((best, competitions))
    }

    /// The competitions of all effects, repeated while one of them is won by another candidate.
    fn compete(
        &self,
        data: &Data,
        fitted: Fitted,
        won: Option<&Competition>,
    ) -> Result<(Fitted, Vec<Competition>), FitError> {
        let mut best = fitted;
        let mut competitions = Vec::new();
        let Some(last) = best.hypothesis.terms.len().checked_sub(1) else { return Ok((best, competitions)) };
        for round in 0.. {
            let mut changed = false;
            competitions.clear();
            for i in 0..=last {
                let known = won.filter(|_| round == 0 && i == last && !changed);
                let competition = known.map_or_else(|| self.without(data, &best, i), |won| Ok(won.clone()))?;
                // the leader may be the same effects, better fitted from another start
                if round < ROUNDS
                    && self.held.get() < COMPETITIONS
                    && let Some(other) = competition.leader()
                    && self.is_better(&other, &best)
                    && let Some(other) = fitted_to(data, other)
                    && self.is_better(&other, &best)
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

    /// True for the more likely of two fits with as many effects.
    fn is_better(&self, one: &Fitted, other: &Fitted) -> bool {
        self.log_posterior(one) > self.log_posterior(other) + BETTER
    }

    /// The competition of one of the effects of a fit.
    fn without(&self, data: &Data, fitted: &Fitted, term: usize) -> Result<Competition, FitError> {
        let rest = relearnt(data, lessened(data, fitted, fitted.hypothesis.without(term))?);
        // the others are fitted to the readings of the rest
        let present = if data.is_about_effects { fitted.clone().keeping(data) } else { fitted.clone() };
        let present = Alternative::exact(data, &rest, present, term);
        self.competition(rest.data(data), &rest, Some(present))
    }

    /// The competition for one more effect beside those of a fit.
    fn one_more(&self, data: &Data, fitted: &Fitted) -> Result<Competition, FitError> {
        self.competition(data, fitted, None)
    }

    /// The same, where one of the candidates has been fitted already.
    fn competition(&self, data: &Data, fitted: &Fitted, present: Option<Alternative>) -> Result<Competition, FitError> {
        self.held.set(self.held.get() + 1);
        let odds = odds_beside(fitted.hypothesis.count());
        let scanned = scan(fitted.data(data), fitted, &self.terms)?;
        let prior_of = |i: usize| self.log_prior[i] + ((1.0 - UNMODELLED) * odds).ln();
        let outstanding = widths::outstanding(data, fitted);
        let mut leaders = self.leaders(data, fitted, &scanned)?;
        leaders.extend((0..scanned.len()).filter(|&i| outstanding.contains(&scanned[i].term)));
        let mut weights: Vec<(Alternative, f64)> = Vec::new();
        // the costs of drifting baselines are of other numbers
        let cost = |one: &Alternative| {
            let is_comparable = one.term().is_some_and(|term| !term.kind.moves_baselines());
            one.fitted.as_ref().filter(|_| is_comparable).map_or(f64::INFINITY, |fitted| fitted.cost)
        };
        let mut least = present.as_ref().map_or(f64::INFINITY, cost);
        // the best first, beside which fits of the others are abandoned
        let mut order: Vec<usize> = (0..scanned.len()).collect();
        order.retain(|&i| !fitted.hypothesis.holds(&scanned[i].term, &data.ring));
        order.sort_by(|&one, &other| scanned[other].log_bayes.total_cmp(&scanned[one].log_bayes));
        for i in order {
            let candidate = &scanned[i];
            let alternative = match present.as_ref().filter(|present| present.term() == Some(&candidate.term)) {
                // it has been fitted to readings that are linearised about it
                Some(known) if data.is_about_effects => known.clone(),
                known => {
                    let again = match leaders.contains(&i) {
                        true => refit(data, fitted, candidate, least),
                        false => Alternative::from_candidate(candidate),
                    };
                    known.filter(|known| known.log_gain > again.log_gain).cloned().unwrap_or(again)
                }
            };
            least = least.min(cost(&alternative));
            let weight = alternative.log_gain + prior_of(i);
            weights.push((alternative, weight));
        }
        relearn(data, fitted, &mut weights, &outstanding);
        // by its prior each weighs less than its evidence
        for discrepancy in discrepancy::scan(data, fitted, least_weight(&weights))? {
            let weight = discrepancy.log_bayes + log_prior_unmodelled(odds, discrepancy.sites);
            weights.push((Alternative::unmodelled(discrepancy), weight));
        }
        weigh_elements(data, fitted, &mut weights)?;
        Ok(Competition::from_log_weights(weights, TOO_SMALL * UNMODELLED * odds, fitted.clone(), scanned))
    }

    /// The candidates for an exact fit. Where the fit is poor its vars are strongly biased, and so is a scan about them: the leaders of a
    /// scan at the prior's mean are then added.
    fn leaders(&self, data: &Data, fitted: &Fitted, scanned: &[Candidate]) -> Result<Vec<usize>, FitError> {
        let ring = &data.ring;
        let mut leaders = self.first(ring, scanned, &fitted.hypothesis);
        if fitted.is_poor() {
            let at_mean = Fitted::unfitted(data, &fitted.hypothesis).and_then(|start| scan(data, &start, &self.terms));
            leaders
                .extend(at_mean.map_or_else(|_| Vec::new(), |scanned| self.first(ring, &scanned, &fitted.hypothesis)));
        }
        Ok(leaders)
    }

    /// The candidates near the best of a scan.
    fn first(&self, ring: &Ring, scanned: &[Candidate], hypothesis: &Hypothesis) -> Vec<usize> {
        let weight = |i: usize| scanned[i].log_bayes + self.log_prior[i];
        let mut order: Vec<usize> = (0..scanned.len()).filter(|&i| !hypothesis.holds(&scanned[i].term, ring)).collect();
        order.sort_by(|&one, &other| weight(other).total_cmp(&weight(one)));
        let Some(&best) = order.first() else { return order };
        let behind = BEHIND.max(BEHIND_SHARE * scanned[best].log_bayes);
        order.retain(|&i| weight(i) > weight(best) - behind && scanned[i].log_bayes > WORTH);
        order.truncate(LEADERS);
        order
    }

    /// The search beside an unknown element, where there is one. None where, beside what was then found, it is no longer the most likely of what is left:
    /// the first search is as good.
    fn searched_with_element(&self, found: &Found) -> Result<Option<Found>, FitError> {
        let Some(element) = found.unknown_element()? else { return Ok(None) };
        self.held.set(0);
        let whole = self.without_parts(found, &element)?;
        let Some(mut element) = whole.unknown_element()? else { return Ok(None) };
        for _ in 0..PLACES {
            let Some(beside) = self.with_element(&whole, element.clone())? else { return Ok(None) };
            if beside.best.hypothesis.element.is_none() {
                // a monitor wanders, and all was begun anew
                return Ok(Some(self.searched_with_element(&beside)?.unwrap_or(beside)));
            }
            let data = &beside.data;
            let rest = relearnt(data, lessened(data, &beside.best, beside.best.hypothesis.without_element())?);
            let next = self.one_more(rest.data(data), &rest)?;
            let beside = Found { next, ..beside };
            match beside.unknown_element()? {
                Some(leading) if leading.is_like(&element) => return Ok(Some(beside)),
                Some(leading) => element = leading,
                None => return Ok(None),
            }
        }
        // its place is not decided, so that none is in the model
        Ok(Some(whole))
    }

    /// With an unknown element in the model, and what else shows beside it; none where the machine keeps no beam.
    fn with_element(&self, whole: &Found, element: Element) -> Result<Option<Found>, FitError> {
        let Found { data, null, best, .. } = whole;
        let less = best.hypothesis.without_terms(|term| element.holds(term, &data.ring));
        let hypothesis = Hypothesis { element: Some(element), ..less };
        let with = relearnt(data, Fitted::from_guess(data, &hypothesis, &best.guess(data, &hypothesis))?);
        if !with.is_stable(data) {
            return Ok(None);
        }
        let (best, competitions) = self.settle(data, with, None)?;
        let next = self.one_more(data, &best)?;
        Ok(Some(self.grown(Found { data: data.clone(), null: null.clone(), best, competitions, next })?))
    }

    /// The same without the effects that are parts of an unknown element.
    fn without_parts(&self, found: &Found, element: &Element) -> Result<Found, FitError> {
        let (best, ring) = (&found.best, &found.data.ring);
        let hypothesis = best.hypothesis.without_terms(|term| element.holds(term, ring));
        let mut data = found.data.clone();
        if hypothesis.terms.len() == best.hypothesis.terms.len() {
            return Ok(found.clone());
        }
        if hypothesis.terms.is_empty() {
            return self.without_effects(data);
        }
        let less = linearisation::fit(&mut data, &hypothesis, &best.guess(&found.data, &hypothesis))?;
        let less = relearnt(&data, less);
        self.about_effects(found, data, less)
    }
}
