//! How often chance alone gives the search as much as it found: a parametric bootstrap of this recording.
//!
//! Recordings of the same machine with nothing missing are drawn, to first order: whitened noise, and unknowns from their priors. Noise, settings
//! and monitors are those of this recording, since they are in the whitening. Each is scored as the search scores the recording's own.
//!
//! Source: A. C. Davison and D. V. Hinkley, Bootstrap Methods and their Application (1997), ch. 4.2, eq. 4.11.

use nalgebra::{DMatrix, DVector, DVectorView};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use rand_distr::StandardNormal;

use super::data::Data;
use super::error::FitError;
use super::fit::Fitted;
use super::hypothesis::Term;
use super::scan::{Projection, SignatureScore, signatures};

/// Recordings drawn: a probability of 1 % is then known to a half.
const DRAWS: usize = 499;
const SEED: u64 = 1;

/// Probability that the best of some terms is at least as much better than its penalty as in this recording, were none of them there. `penalty`: of
/// each term the `ln` Bayes factor that pays for the search.
///
/// # Errors
/// [`FitError`].
pub fn of_search(data: &Data, without: &Fitted, terms: &[Term], penalty: &[f64]) -> Result<f64, FitError> {
    let columns = signatures(data, without, terms)?;
    let scored = Projection::of(without).score(columns.clone());
    let best = |pulls: DVectorView<f64>| {
        let weight = |i: usize| {
            let score = SignatureScore { pull: pulls[i], ..scored.scores[i] };
            score.log_bayes(terms[i].kind.is_switch()) - penalty[i]
        };
        (0..terms.len()).map(weight).fold(f64::NEG_INFINITY, f64::max)
    };
    let own = DVector::from_iterator(terms.len(), scored.scores.iter().map(|score| score.pull));
    let own = best(own.as_view());
    let mut rng = StdRng::seed_from_u64(SEED);
    let mut normal = |rows: usize| DMatrix::<f64>::from_fn(rows, DRAWS, |_, _| rng.sample(StandardNormal));
    // noise, and what the unknowns make
    let mut drawn = normal(columns.nrows());
    drawn += &without.jacobian * normal(without.u.len());
    let left = columns - &without.jacobian * &scored.taken;
    let pulls = left.transpose() * drawn; // nalgebra's `tr_mul` is several times slower
    let exceeding = pulls.column_iter().filter(|pulls| best(pulls.as_view()) >= own).count();
    Ok((1 + exceeding) as f64 / (1 + DRAWS) as f64)
}

#[cfg(test)]
mod tests {
    use inference::Campaign;

    use super::*;
    use crate::heldout::{gain_of_choice, reduced};
    use crate::scan::candidates;
    use crate::search::{Found, Search, corrections};
    use crate::testing::{Coloured, template};
    use twin::{Effect, EffectKind};

    /// The probability, and the held-out gain of the choice, of a campaign with some effects.
    fn tested(effects: &[Effect], seed: u64) -> (f64, f64) {
        let (ring, recording) = template();
        let made = Coloured::white(&ring, &recording, seed).campaign(&ring, &recording, effects);
        let data = Data::of(&Campaign::of(&ring, &made).unwrap()).unwrap();
        let terms = candidates(&data, None);
        let Found { data, null, best, .. } = Search::new(terms.clone()).run(data).unwrap();
        let fitted = if best.hypothesis.terms.is_empty() { null } else { reduced(&data, &best, 0).unwrap() };
        let penalty = corrections(&terms);
        (
            of_search(&data, &fitted, &terms, &penalty).unwrap(),
            gain_of_choice(&data, &fitted, &terms, &penalty).unwrap(),
        )
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
