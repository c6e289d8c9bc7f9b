//! How often chance alone gives the search as much as it found: a parametric bootstrap of this recording.
//!
//! Recordings of the same machine with nothing missing are drawn, to first order: whitened noise, and unknowns from their priors. Noise, settings
//! and monitors are those of this recording, since they are in the whitening. Of each only the pulls of the candidates count, which are
//! normal with the covariance `d_i P d_j`; they are scored as the search scores the recording's own.
//!
//! Source: A. C. Davison and D. V. Hinkley, Bootstrap Methods and their Application (1997), ch. 4.2, eq. 4.11.

use evidence::{Factor, symmetric};
use nalgebra::{DMatrix, DVectorView};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use rand_distr::StandardNormal;

use super::choice::Choice;
use super::fit::FitError;
use super::scan::SignatureScore;

/// Recordings drawn: a probability of 1 % is then known to a half.
const DRAWS: usize = 499;
const SEED: u64 = 1;
/// Share of its power, and of 1 nat, by which a signature differs from all others and from none at least.
const ROUNDING: f64 = 1e-9;

/// Probability that the best of the candidates is at least as much better than its penalty as in this recording, were none of them there.
pub fn of_search(choice: &Choice) -> Result<f64, FitError> {
    let scores = || choice.scores.iter().copied();
    let best =
        |scores: &mut dyn Iterator<Item = SignatureScore>| choice.log_weights(scores).fold(f64::NEG_INFINITY, f64::max);
    let best_score = best(&mut scores());
    let mut covariance = symmetric(&choice.columns, &choice.left);
    // alike signatures leave no more than rounding between them; one of an instrument that is dead is zero
    (0..covariance.nrows()).for_each(|i| covariance[(i, i)] += ROUNDING * (1.0 + covariance[(i, i)]));
    let factor = Factor::of(covariance).ok_or(FitError::Degenerate)?;
    let mut rng = StdRng::seed_from_u64(SEED);
    let normal = DMatrix::<f64>::from_fn(choice.scores.len(), DRAWS, |_, _| rng.sample(StandardNormal));
    let pulls = factor.lower() * normal;
    let drawn = |pulls: DVectorView<f64>| {
        let with_pull = |(score, pull): (SignatureScore, &f64)| SignatureScore { pull: *pull, ..score };
        best(&mut scores().zip(pulls.iter()).map(with_pull))
    };
    let exceeding = pulls.column_iter().filter(|pulls| drawn(*pulls) >= best_score).count();
    Ok((1 + exceeding) as f64 / (1 + DRAWS) as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::heldout::{gain_of_choice, lessened};
    use crate::odds::corrections;
    use crate::scan::candidates;
    use crate::search::{Found, Search};
    use crate::testing::{Coloured, template, whitened};
    use twin::{Effect, EffectKind};

    /// The probability, and the held-out gain of the choice, of a campaign with some effects.
    fn tested(effects: &[Effect], seed: u64) -> (f64, f64) {
        let (ring, recording) = template();
        let made = Coloured::white(&ring, &recording, seed).campaign(&ring, &recording, effects);
        let data = whitened(&ring, &made);
        let terms = candidates(&data, None);
        let Found { data, null, best, .. } = Search::new(terms.clone()).run(data).unwrap();
        let fitted = match best.hypothesis.terms.is_empty() {
            true => null,
            false => lessened(&data, &best, best.hypothesis.without(0)).unwrap(),
        };
        let penalty = corrections(&terms);
        let choice = Choice::from_terms(&data, &fitted, &terms, &penalty).unwrap();
        (of_search(&choice).unwrap(), gain_of_choice(&choice).unwrap())
    }

    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn what_chance_chooses_is_ordinary_and_predicts_nothing() {
        const SEEDS: u64 = 12;
        let all: Vec<(f64, f64)> = (0..SEEDS).map(|seed| tested(&[], 100 + seed)).collect();
        let mean = |of: fn(&(f64, f64)) -> f64| all.iter().map(of).sum::<f64>() / SEEDS as f64;
        // a uniform number's mean of 12 scatters by 0.083; four times that
        assert!((mean(|one| one.0) - 0.5).abs() < 0.33, "{all:?}");
        // what is chosen by chance from other folds predicts worse than nothing
        assert!(mean(|one| one.1) < 0.0, "{all:?}");
    }

    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn an_effect_is_no_chance_and_predicts_by_any_choice() {
        let (ring, _) = template();
        let gain = Effect::at(EffectKind::BpmGain, "x_E6", -0.15, &ring).unwrap();
        let (probability, choice) = tested(&[gain], 7);
        // one of 500; the ordinary gains of all monitors explain a part of it, and 3 nat are left that chance does not give
        assert!(probability <= 0.004 && choice > 3.0, "{probability} {choice}");
    }
}
