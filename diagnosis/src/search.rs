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
//! with that in the model (`search/beside.rs`).

mod beside;

use core::cell::Cell;
use std::collections::BTreeMap;

use nalgebra::DVector;
use twin::{EffectKind, Measured, Ring};

use super::alternatives::{Alternative, Cause, Competition};
use super::data::Data;
use super::discrepancy::{self, Discrepancy};
use super::error::FitError;
use super::fit::Fitted;
use super::half_normal::HalfNormal;
use super::heldout::reduced;
use super::hypothesis::{Hypothesis, Term, Unknown};
use super::linearise::{self, CURVED, about_itself};
use super::location::{Location, SORTS};
use super::ordinary::{self, Family};
use super::scan::{Candidate, scan};
use super::slow::OWN;
use inference::softplus;

/// Prior odds of one (more) effect.
pub(super) const ODDS: f64 = 1.0;
const ODDS_FURTHER: f64 = 0.25;
/// Prior probability of physics that the library does not hold.
pub(super) const UNMODELLED: f64 = 0.15;
/// Share of it that is too small to be seen. Nothing is known of its size, so that it is taken to hide as often as the library's effects do: these are 0.43 times
/// as likely as before where nothing is found, on average of 1186 simulated empty campaigns.
const TOO_SMALL: f64 = 0.4;
/// Prior probability of what can be seen of it.
pub(super) const UNMODELLED_SEEN: f64 = (1.0 - TOO_SMALL) * UNMODELLED;
/// Rounds over all competitions, and the gain of `ln` posterior that calls for another round.
const ROUNDS: usize = 3;
const BETTER: f64 = 0.1;
/// Effects at most.
const MOST: usize = 4;
/// Competitions after which no further effect is tried: so many are held where effects replace each other and none explains the recording.
const COMPETITIONS: usize = 40;
/// Number of candidates that are refitted exactly, and their largest distance from the best, in nat and relative to the best.
const LEADERS: usize = 8;
const BEHIND: f64 = 6.0;
const BEHIND_SHARE: f64 = 0.3;
/// `ln` Bayes factor below which first order suffices.
const WORTH: f64 = 3.0;

/// Walks that are tried, and monitors of a recording that may wander by themselves: with more it is something that they share.
const WALKS: usize = 12;
const WANDERERS: usize = 4;
/// `ln` odds of 95 %, by which another change of one monitor has to be more likely than its walk, which is no physics.
const DOUBT: f64 = 2.94;
/// Most steps of the widths of what is ordinary, or of a fit that is begun anew.
const PASSES: usize = 4;
/// Way of all vars together, in prior standard deviations, that leaves the evidence as it is to 0.3 nat.
const STILL: f64 = 0.3;

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
    is_idle.then(|| added.clone().to(&further.data))
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

/// Correction of a first search for the number of candidates: the `ln` Bayes factor of each that gives even odds.
pub fn corrections(terms: &[Term]) -> Vec<f64> {
    log_prior(terms).into_iter().map(|prior| -(prior + ((1.0 - UNMODELLED) * ODDS).ln())).collect()
}

/// The same for an unmodelled discrepancy.
pub fn correction_of(discrepancy: &Discrepancy) -> f64 {
    -(UNMODELLED_SEEN * ODDS / (SORTS * discrepancy.sites) as f64).ln()
}

/// The same for one sort of it that has no sites.
pub fn correction_of_sort() -> f64 {
    -(UNMODELLED_SEEN * ODDS / SORTS as f64).ln()
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
    ///
    /// # Errors
    /// [`FitError`].
    pub fn run(&self, data: Data) -> Result<Found, FitError> {
        let found = self.grown(self.with_noise(self.without_effects(data)?)?)?;
        // where that fails the search stands as it is
        let beside = self.beside_element(&found).unwrap_or(None);
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
        let hypothesis = if first.is_poor() { bare() } else { ordinary::learnt(&data, &first) };
        let guess = first.guess(&data, &hypothesis);
        let fitted = linearise::fit(&mut data, &hypothesis, &guess).ok().filter(|fitted| fitted.is_stable(&data));
        let null = fitted.map_or_else(|| linearise::fit(&mut data, &Hypothesis::default(), &start), Ok)?;
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
        if data.linearise_each(&best.machines(&data)?).is_ok_and(|moved| moved > CURVED) {
            best = linearise::fit(&mut data, &best.hypothesis, &best.u)?;
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
        let of_each = (0..found.competitions.len()).map(|i| ((1.0 - UNMODELLED) * odds(first + i)).ln());
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
        let rest = relearnt(data, reduced(data, fitted, term)?);
        // the others are fitted to the readings of the rest
        let present = if data.is_about_effects { fitted.clone().to(data) } else { fitted.clone() };
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
        let odds = odds(fitted.hypothesis.count());
        let scanned = scan(fitted.data(data), fitted, &self.terms)?;
        let prior_of = |i: usize| self.log_prior[i] + ((1.0 - UNMODELLED) * odds).ln();
        let outstanding = ordinary::outstanding(data, fitted);
        let mut leaders = self.leaders(data, fitted, &scanned)?;
        leaders.extend((0..scanned.len()).filter(|&i| outstanding.contains(&scanned[i].term)));
        let mut weights: Vec<(Alternative, f64)> = Vec::new();
        let mut least = f64::INFINITY;
        for (i, candidate) in scanned.iter().enumerate() {
            if fitted.hypothesis.holds(&candidate.term, &data.ring) {
                continue;
            }
            let known = present.as_ref().filter(|present| present.term() == Some(&candidate.term));
            let alternative = match leaders.contains(&i) {
                true => refit(data, fitted, candidate, least),
                false => Alternative::of(candidate),
            };
            // it has been fitted to readings that are linearised about it
            let better = known.filter(|known| data.is_about_effects || known.log_gain > alternative.log_gain).cloned();
            let alternative = better.unwrap_or(alternative);
            // the costs of drifting baselines are of other numbers
            if let Some(fitted) = alternative.fitted.as_ref().filter(|_| !candidate.term.kind.moves_baselines()) {
                least = least.min(fitted.cost);
            }
            let weight = alternative.log_gain + prior_of(i);
            weights.push((alternative, weight));
        }
        relearn(data, fitted, &mut weights, &outstanding);
        for discrepancy in discrepancy::scan(data, fitted)? {
            let prior = (UNMODELLED_SEEN * odds / (SORTS * discrepancy.sites) as f64).ln();
            let weight = discrepancy.log_bayes + prior;
            weights.push((Alternative::unmodelled(discrepancy), weight));
        }
        beside::weigh_elements(data, fitted, &mut weights)?;
        Ok(Competition::of(weights, TOO_SMALL * UNMODELLED * odds, fitted.clone(), scanned))
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
}

/// The first fit of a hypothesis with all that is ordinary. Where it is poor the ordinary imperfections may be so large that about none of them
/// they are not of first order, or lead to another minimum: it is then begun anew where it ended, or where the
/// vars alone come to rest, which absorb most of that.
fn first_of(data: &Data, plain: &Hypothesis) -> Result<Fitted, FitError> {
    let start = DVector::zeros(data.units.len());
    let first = Fitted::of(data, plain, &start)?;
    if !first.is_poor() {
        return Ok(first);
    }
    let of_vars = Fitted::of(data, &Hypothesis::default(), &start).ok();
    let begun = [of_vars.map(|fitted| fitted.guess(data, plain)), first.is_stable(data).then(|| first.u.clone())];
    let mut fits: Vec<Fitted> = Vec::new();
    for mut guess in begun.into_iter().flatten() {
        for _ in 0..PASSES {
            let Ok(fitted) = Fitted::of(data, plain, &guess) else { break };
            guess = fitted.u.clone();
            fits.push(fitted);
        }
    }
    let best = fits.into_iter().filter(|fitted| fitted.is_stable(data)).min_by(|a, b| a.cost.total_cmp(&b.cost));
    Ok(best.filter(|best| best.cost < first.cost).unwrap_or(first))
}

/// The fit without effects beside readings that are linearised about a machine with some: to readings of its own. Where further ones were dropped from
/// those, it is fitted to as many.
fn null_beside(data: &Data, null: Fitted, before: &Data) -> Fitted {
    if data.whole_size() == null.data(before).whole_size() {
        return null.to(before);
    }
    let again = Fitted::of(data, &null.hypothesis, &null.u).ok().filter(|fitted| fitted.is_stable(data));
    again.map_or_else(|| null.to(before), |again| about_itself(data, again))
}

/// A fit to the readings at hand, where they are linearised about a machine with effects that it may not have.
fn fitted_to(data: &Data, fitted: Fitted) -> Option<Fitted> {
    if !data.is_about_effects {
        return Some(fitted);
    }
    Fitted::of(data, &fitted.hypothesis, &fitted.u).ok().map(|fitted| about_itself(data, fitted))
}

/// The same with what is ordinary, which was left out where it kept no beam about the former machine.
fn with_ordinary(data: &mut Data, best: Fitted) -> Fitted {
    let learnt = relearnt(data, best.clone());
    if learnt.hypothesis.ordinary.is_empty() {
        return best;
    }
    let mut own = data.clone();
    let again = linearise::fit(&mut own, &learnt.hypothesis, &learnt.u).ok().filter(|again| again.is_stable(&own));
    let Some(again) = again else { return best };
    *data = own;
    again
}

/// A fit whose ordinary widths no longer grow in evidence: what is left to gain would be given to the first effect that is tried.
fn settled(data: &Data, mut fitted: Fitted) -> Fitted {
    for _ in 0..PASSES {
        let before = fitted.log_evidence;
        fitted = relearnt(data, fitted);
        if fitted.log_evidence < before + BETTER {
            break;
        }
    }
    fitted
}

/// Which monitors wander.
enum Wander {
    All,
    /// One, in one of several recordings.
    One(usize, usize),
}

impl Wander {
    /// Those that the leading cause of what is left is about, where nothing is known of their walk yet and repeats say what is ordinary.
    fn of(data: &Data, leading: &Discrepancy) -> Option<Self> {
        let noise = &data.campaign(leading.campaign).noise;
        let is_known = |b: usize| noise.wandering.iter().any(|(at, _)| *at == b);
        let steady = data.campaigns().all(|own| own.noise.slow.walk.value == 0.0);
        match leading.at {
            _ if noise.ordinary_walk <= 0.0 => None,
            Location::Time if steady => Some(Self::All),
            Location::MonitorInTime(b) if !is_known(b) && noise.wandering.len() < WANDERERS => {
                Some(Self::One(leading.campaign, b))
            }
            _ => None,
        }
    }

    fn with(&self, data: &Data, walk: Measured) -> Data {
        match *self {
            Self::All => data.wandering(walk),
            Self::One(campaign, b) => data.with_wandering(campaign, b, walk),
        }
    }

    /// `ln` prior odds against none, and `ln` odds by which another cause has to be more likely.
    fn odds(&self) -> (f64, f64) {
        match self {
            Self::All => (0.0, 0.0),
            Self::One(..) => (OWN.ln(), DOUBT),
        }
    }
}

/// The recordings with monitors that wander, all or one, where that is more likely than none and than any other cause. A walk too small to be seen
/// in repeats shows in what a fit leaves, since it then has all settings to compare.
fn wandering(found: &Found) -> Result<Option<Data>, FitError> {
    let Found { data, best, next, .. } = found;
    let leader = next.alternatives.first().filter(|_| next.is_suspicious() && !best.is_poor());
    let Some(Alternative { cause: Cause::Unmodelled(leading), probability, .. }) = leader else { return Ok(None) };
    let Some(wander) = Wander::of(data, leading) else { return Ok(None) };
    let log_likelihood = |value: f64| {
        let wandering = wander.with(best.data(data), Measured { value, sigma: 0.0 });
        let fitted = Fitted::of(&wandering, &best.hypothesis, &best.u);
        fitted.map_or(f64::NEG_INFINITY, |fitted| fitted.log_evidence)
    };
    let posterior = HalfNormal::of(log_likelihood, data.campaign(leading.campaign).noise.ordinary_walk, WALKS);
    let (prior, doubt) = wander.odds();
    let of_walk = posterior.log_evidence - best.log_evidence + prior;
    let of_leader = (probability / next.nothing.max(f64::MIN_POSITIVE)).ln();
    let walk = Measured { value: posterior.mean, sigma: posterior.sigma() };
    Ok((of_walk > (of_leader - doubt).max(0.0)).then(|| wander.with(data, walk)))
}

/// The exact fit with a candidate, abandoned where its cost stays far above the least of its rivals.
fn refit(data: &Data, fitted: &Fitted, candidate: &Candidate, least: f64) -> Alternative {
    let hypothesis = fitted.hypothesis.with(candidate.term);
    let mut guess = fitted.guess(data, &hypothesis);
    let unknowns = hypothesis.unknowns(data);
    let last = hypothesis.terms.len() - 1;
    if let Some(at) = unknowns.iter().position(|unknown| matches!(unknown, Unknown::Amplitude(i, _) if *i == last)) {
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
        return Alternative { log_gain: f64::NEG_INFINITY, ..Alternative::of(candidate) };
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
    let stands_out = |(at, _): (usize, f64)| fitted.u[at].abs() > ordinary::STANDS_OUT;
    if !fitted.unknown(data, term).is_some_and(stands_out) {
        return fitted;
    }
    let hypothesis = fitted.hypothesis.with_gross(term);
    let again = hypothesis.and_then(|gross| Fitted::of(data, &gross, &fitted.guess(data, &gross)).ok());
    again.filter(|again| again.log_evidence > fitted.log_evidence && again.is_stable(data)).unwrap_or(fitted)
}

/// Refit the best of some weighted candidates, and those that stand out of their family, with the ordinary widths that the recording shows
/// beside each; what changes the ring, where the best is more likely than nothing, to readings that are linearised about it.
fn relearn(data: &Data, without: &Fitted, weights: &mut [(Alternative, f64)], outstanding: &[Term]) {
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
fn relearnt(data: &Data, fitted: Fitted) -> Fitted {
    let lacks_all = fitted.hypothesis.ordinary.is_empty();
    if fitted.is_poor() && !lacks_all {
        return fitted;
    }
    let own = fitted.has_own().then(|| fitted.data(data).clone());
    let data = own.as_ref().unwrap_or(data);
    let again = |hypothesis: Hypothesis, from: &Fitted| Fitted::of(data, &hypothesis, &from.guess(data, &hypothesis));
    let with_all = || Hypothesis { ordinary: Family::all(), ..fitted.hypothesis.clone() };
    let begun = if lacks_all { again(with_all(), &fitted) } else { Ok(fitted.clone()) };
    let begun = begun.ok().filter(|begun| !begun.is_poor());
    let learnt = begun.and_then(|begun| again(ordinary::learnt(begun.data(data), &begun), &begun).ok());
    let is_better = |learnt: &Fitted| !learnt.is_poor() && (lacks_all || learnt.log_evidence > fitted.log_evidence);
    let best = learnt.filter(|learnt| is_better(learnt) && learnt.is_stable(data)).unwrap_or(fitted);
    if own.is_some() { best.to(data) } else { best }
}
