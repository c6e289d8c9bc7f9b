//! Whether stated probabilities are true, in several mixes of campaigns.
//!
//! A probability is stated for the shares of empty campaigns, effects of the library and other physics that the search takes for granted
//! (`ASSUMED`). Among campaigns of other shares `q` the same evidence gives `P' = P f_c / (sum over c of P_c f_c)`, `f_c = q_c/p_c`, with `c` the
//! sort of the cause that is stated and `P_c` the probability of each sort. A mix is made of the campaigns at hand, each counted with the weight
//! `q_c/(share of its sort among them)`; of weighted campaigns there are effectively `(sum w)^2/(sum w^2)`.
//!
//! Source of the effective number: L. Kish, Survey Sampling (Wiley, 1965), section 8.2.

use diagnosis::{ODDS, UNMODELLED};
use schemars::JsonSchema;
use serde::Serialize;

use crate::outcome::Outcome;
use crate::share::Share;
use crate::stated::{SORTS, Sort, Stated};

/// Shares of the sorts of campaigns, which add up to 1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
pub struct Mix([f64; SORTS]);

/// What the search takes for granted.
const ASSUMED: Mix = {
    let something = ODDS / (1.0 + ODDS);
    Mix([1.0 - something, something * (1.0 - UNMODELLED), something * UNMODELLED])
};
/// That, a machine that is well known, and one that is not.
const MIXES: [Mix; 3] = [ASSUMED, Mix([0.9, 0.08, 0.02]), Mix([0.1, 0.6, 0.3])];
const BINS: [[f64; 2]; 6] = [[0.0, 0.5], [0.5, 0.7], [0.7, 0.85], [0.85, 0.95], [0.95, 0.99], [0.99, 1.01]];

/// How often stated probabilities are true in one mix.
#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct Calibration {
    /// Shares of empty campaigns, of effects of the library, of other physics.
    pub mix: Mix,
    /// Of each bin with campaigns.
    pub bins: Vec<Reliability>,
    /// Mean square of stated probability less truth (Brier score).
    pub brier: f64,
}

/// How often the stated probabilities of one bin are true.
#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct Reliability {
    /// Stated probability, from and to.
    pub bin: [f64; 2],
    /// Number of campaigns.
    pub campaigns: usize,
    /// The same, effectively.
    pub effectively: f64,
    /// Mean of what was stated.
    pub stated: f64,
    /// Share that is true, and its 95 % limits.
    pub is_true: f64,
    /// See above.
    pub limits: [f64; 2],
}

impl Mix {
    /// What a probability that was stated for [`ASSUMED`] is here.
    fn probability(self, stated: &Stated) -> f64 {
        let factor = |sort: usize| self.0[sort] / ASSUMED.0[sort];
        let all: f64 = stated.of_sorts.iter().enumerate().map(|(sort, p)| p * factor(sort)).sum();
        stated.probability * factor(stated.sort as usize) / all
    }

    /// Weight of a campaign of each sort, so that the campaigns make the mix.
    fn weights(self, outcomes: &[Outcome]) -> [f64; SORTS] {
        let mut counts = [0.0; SORTS];
        outcomes.iter().for_each(|outcome| counts[Sort::of(outcome.class) as usize] += 1.0);
        core::array::from_fn(|sort| if counts[sort] > 0.0 { self.0[sort] / counts[sort] } else { 0.0 })
    }

    /// `50 : 42 : 8`, in per cent.
    pub fn text(self) -> String {
        self.0.map(|share| format!("{:.0}", 100.0 * share)).join(" : ")
    }
}

impl Calibration {
    /// In each mix.
    pub fn all(outcomes: &[Outcome]) -> Vec<Self> {
        MIXES.iter().map(|&mix| Self::of(mix, outcomes)).collect()
    }

    fn of(mix: Mix, outcomes: &[Outcome]) -> Self {
        let weights = mix.weights(outcomes);
        let weighted = |outcome: &Outcome| Weighted {
            weight: weights[Sort::of(outcome.class) as usize],
            probability: mix.probability(&outcome.stated),
            is_true: f64::from(u8::from(outcome.stated.is_true)),
        };
        let all: Vec<Weighted> = outcomes.iter().map(weighted).collect();
        let brier = mean(&all, |one| (one.probability - one.is_true).powi(2));
        Self { mix, bins: BINS.iter().filter_map(|&bin| Reliability::of(&all, bin)).collect(), brier }
    }

    /// Bins whose mean is outside its limits.
    pub fn outside(&self) -> usize {
        self.bins.iter().filter(|bin| !bin.is_within()).count()
    }
}

/// One campaign in a mix.
#[derive(Debug, Clone, Copy)]
struct Weighted {
    weight: f64,
    probability: f64,
    is_true: f64,
}

fn mean(all: &[Weighted], of: impl Fn(&Weighted) -> f64) -> f64 {
    let (sum, weights) = all.iter().fold((0.0, 0.0), |(sum, n), one| (sum + one.weight * of(one), n + one.weight));
    if weights > 0.0 { sum / weights } else { 0.0 }
}

impl Reliability {
    fn of(all: &[Weighted], bin: [f64; 2]) -> Option<Self> {
        let within: Vec<Weighted> =
            all.iter().copied().filter(|one| (bin[0]..bin[1]).contains(&one.probability)).collect();
        let [sum, squares] = [1, 2].map(|power| within.iter().map(|one| one.weight.powi(power)).sum::<f64>());
        let (effectively, is_true) = (sum * sum / squares, mean(&within, |one| one.is_true));
        let limits = Share::limits(is_true * effectively, effectively);
        let stated = mean(&within, |one| one.probability);
        (sum > 0.0).then_some(Self { bin, campaigns: within.len(), effectively, stated, is_true, limits })
    }

    /// True if the mean of what was stated is within the limits of what is true.
    pub fn is_within(&self) -> bool {
        (self.limits[0]..=self.limits[1]).contains(&self.stated)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stated(sort: Sort, of_sorts: [f64; SORTS]) -> Stated {
        let probability = of_sorts[sort as usize];
        Stated { cause: String::new(), sort, probability, of_sorts, is_true: false }
    }

    /// Bayes: the odds of two sorts change by the ratio of their shares.
    #[test]
    fn a_probability_follows_the_shares() {
        let one = stated(Sort::Library, [0.5, 0.4, 0.1]);
        assert!((ASSUMED.probability(&one) - 0.4).abs() < 1e-12, "as stated");
        let rare = Mix([ASSUMED.0[0], ASSUMED.0[1] / 2.0, ASSUMED.0[2]]);
        assert!((rare.probability(&one) - 0.2 / 0.8).abs() < 1e-12);
        assert!((MIXES.map(|mix| mix.0.iter().sum::<f64>())).iter().all(|sum| (sum - 1.0).abs() < 1e-12));
    }

    /// Campaigns drawn by the probabilities that are stated are calibrated; the same with truths exchanged are not.
    #[test]
    fn what_is_drawn_as_stated_is_within_its_limits() {
        let drawn = |i: usize, is_so: bool| Weighted {
            weight: if i.is_multiple_of(3) { 2.0 } else { 1.0 },
            probability: 0.6,
            is_true: f64::from(u8::from((i % 5 < 3) == is_so)),
        };
        let of = |is_so: bool| {
            let all: Vec<Weighted> = (0..300).map(|i| drawn(i, is_so)).collect();
            Reliability::of(&all, [0.5, 0.7]).unwrap()
        };
        let right = of(true);
        assert!(right.is_within() && (right.is_true - 0.6).abs() < 1e-12, "{right:?}");
        assert!((right.effectively - 400.0 * 400.0 / 600.0).abs() < 1e-9, "Kish: (sum w)^2/(sum w^2)");
        assert!(!of(false).is_within());
    }
}
