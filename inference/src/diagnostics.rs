//! Have the chains converged, and how many independent draws are they worth?
//!
//! For one quantity, its draws chain by chain, all of one length. The numbers are those of ArviZ 0.23, so that a reader
//! can check them there: `az.rhat`, `az.ess` with the methods `bulk` and `tail`, `az.mcse` with `mean`.
//!
//! A diagnostic is NaN where it cannot be known: for chains of fewer than four draws or of different lengths, for no
//! chain at all, and where a draw is NaN. An infinite draw is larger or smaller than all others for what works by ranks
//! ([`r_hat`], [`ess_bulk`], [`ess_tail`]) and gives NaN in the rest. What constant chains give stands with each
//! function.
//!
//! Source: A. Vehtari, A. Gelman, D. Simpson, B. Carpenter, P.-C. Bürkner, Rank-normalization, folding, and
//! localization: an improved R̂ for assessing convergence of MCMC, Bayesian Analysis 16 (2021) 667.

use nalgebra::DVectorView;
use statrs::distribution::{ContinuousCDF, Normal};

/// Fewest draws of a chain that say anything, as halves of two are compared.
const FEWEST_DRAWS: usize = 4;

/// Spread below which ArviZ takes draws for constant; absolute, so it is wise to give draws in units of order 1.
const RESOLUTION: f64 = 1e-15;

/// Potential scale reduction R̂ of rank-normalised split chains [1]; at most 1.01 where chains agree.
///
/// `R̂ = √((B/W + n − 1)/n)` of the normal scores of the `n`-draw halves, with `W` the mean of their variances and
/// `B/n` the variance of their means; the larger of that of the draws, which sees different places, and that of their
/// distances from the median, which sees different widths.
///
/// NaN for fewer than two chains, and where all draws are the same; infinite up to rounding, and so beyond all reason,
/// where each half is constant by itself.
///
/// Source: Vehtari et al. 2021, sec. 3.1, 4.1 and 4.2.
pub fn r_hat<C: AsRef<[f64]>>(chains: &[C]) -> f64 {
    if chains.len() < 2 || !are_valid(chains) {
        return f64::NAN;
    }
    let halves = Halves::split(chains);
    let bulk = halves.normal_scores().r_hat();
    let tail = halves.folded().normal_scores().r_hat();
    if tail > bulk { tail } else { bulk } // a NaN of the tail alone is passed over: two values are equally far out
}

/// Effective number of independent draws behind the middle of the distribution [1]: that of the normal scores.
///
/// `ESS = m·n/τ` for `m` halves of `n` draws and their autocorrelation time `τ`, at most `m·n·log₁₀(m·n)`.
/// Constant draws count as independent: `m·n`.
///
/// Source: Vehtari et al. 2021, sec. 3.2 and 4.1.
pub fn ess_bulk<C: AsRef<[f64]>>(chains: &[C]) -> f64 {
    if are_valid(chains) { Halves::split(chains).normal_scores().ess() } else { f64::NAN }
}

/// Effective number of independent draws behind the tails [1]: the smaller one of whether a draw lies up to the 5 %
/// quantile, and up to the 95 % quantile.
///
/// Constant draws count as independent.
///
/// Source: Vehtari et al. 2021, sec. 4.3.
pub fn ess_tail<C: AsRef<[f64]>>(chains: &[C]) -> f64 {
    if !are_valid(chains) {
        return f64::NAN;
    }
    let (sorted, halves) = (sorted(chains), Halves::split(chains));
    let [low, high] = [0.05, 0.95].map(|probability| {
        let quantile = quantile(&sorted, probability);
        halves.map(|draw| if draw <= quantile { 1.0 } else { 0.0 }).ess()
    });
    if high < low { high } else { low }
}

/// Monte Carlo standard error of the mean of all draws, in the draws' unit.
///
/// `sd/√ESS`, with the ESS of the draws themselves. Zero up to rounding for constant draws.
///
/// Source: Vehtari et al. 2021, sec. 3.2.
pub fn mcse_mean<C: AsRef<[f64]>>(chains: &[C]) -> f64 {
    if !are_valid(chains) {
        return f64::NAN;
    }
    let draws: Vec<f64> = pooled(chains).collect();
    (variance(&draws) / Halves::split(chains).ess()).sqrt()
}

/// Quantile of values in rising order by linear interpolation, as of numpy and type 7 of R, in the values' unit.
///
/// `(1 − γ)·x_k + γ·x_{k+1}`, where `k + γ = (n − 1)·p` counts from 0. NaN for no values.
///
/// ```
/// # use inference::quantile;
/// assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.75), 3.0);
/// ```
///
/// Source: R. J. Hyndman and Y. Fan, Sample quantiles in statistical packages, The American Statistician 50 (1996) 361.
pub fn quantile(sorted: &[f64], probability: f64) -> f64 {
    let [.., _] = sorted else { return f64::NAN };
    // In the order of operations of ArviZ's: with ties, whether a draw lies up to the quantile hangs on the last bit.
    let place = sorted.len() as f64 * probability + (1.0 - probability);
    let below = place.clamp(1.0, (sorted.len() - 1).max(1) as f64).floor();
    let share = (place - below).clamp(0.0, 1.0);
    let k = below as usize;
    (1.0 - share) * sorted[k - 1] + share * sorted[k.min(sorted.len() - 1)]
}

/// All draws in rising order.
pub(crate) fn sorted<C: AsRef<[f64]>>(chains: &[C]) -> Vec<f64> {
    let mut sorted: Vec<f64> = pooled(chains).collect();
    sorted.sort_unstable_by(f64::total_cmp);
    sorted
}

fn are_valid<C: AsRef<[f64]>>(chains: &[C]) -> bool {
    let Some(first) = chains.first() else { return false };
    let draws = first.as_ref().len();
    let is_valid = |chain: &[f64]| chain.len() == draws && !chain.iter().any(|draw| draw.is_nan());
    draws >= FEWEST_DRAWS && chains.iter().all(|chain| is_valid(chain.as_ref()))
}

fn pooled<C: AsRef<[f64]>>(chains: &[C]) -> impl Iterator<Item = f64> {
    chains.iter().flat_map(|chain| chain.as_ref().iter().copied())
}

pub(crate) fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// `Σ(x − x̄)²/(n − 1)`; NaN for fewer than two values.
pub(crate) fn variance(values: &[f64]) -> f64 {
    let mean = mean(values);
    values.iter().map(|value| (value - mean) * (value - mean)).sum::<f64>() / values.len().saturating_sub(1) as f64
}

/// The first and the last half of every chain, so that a chain that drifts disagrees with itself; of an odd number of
/// draws the middle one is left out.
struct Halves {
    /// Draws of a half, at least two.
    draws: usize,
    /// One half after the other.
    values: Vec<f64>,
}

impl Halves {
    fn split<C: AsRef<[f64]>>(chains: &[C]) -> Self {
        let draws = chains[0].as_ref().len() / 2;
        let ends = |chain: &[f64]| [&chain[..draws], &chain[chain.len() - draws..]].concat();
        Self { draws, values: chains.iter().flat_map(|chain| ends(chain.as_ref())).collect() }
    }

    fn iter(&self) -> impl Iterator<Item = &[f64]> {
        self.values.chunks_exact(self.draws)
    }

    fn map(&self, change: impl Fn(f64) -> f64) -> Self {
        Self { draws: self.draws, values: self.values.iter().map(|&value| change(value)).collect() }
    }

    /// Distances from the median of all.
    fn folded(&self) -> Self {
        let median = quantile(&sorted(&[&self.values]), 0.5);
        self.map(|value| (value - median).abs())
    }

    /// `Φ⁻¹((r − 3/8)/(S + 1/4))` of the rank `r` among all `S`; ties share the mean of their ranks. A NaN, from
    /// folding at an infinite median, stays one.
    fn normal_scores(&self) -> Self {
        let normal = Normal::standard();
        let mut order: Vec<usize> = (0..self.values.len()).collect();
        order.sort_unstable_by(|&a, &b| self.values[a].total_cmp(&self.values[b]));
        let (mut scores, mut before) = (vec![f64::NAN; self.values.len()], 0);
        for ties in order.chunk_by(|&a, &b| self.values[a] == self.values[b]) {
            let rank = before as f64 + (ties.len() + 1) as f64 / 2.0;
            let score = normal.inverse_cdf((rank - 0.375) / (self.values.len() as f64 + 0.25));
            ties.iter().filter(|&&i| !self.values[i].is_nan()).for_each(|&i| scores[i] = score);
            before += ties.len();
        }
        Self { draws: self.draws, values: scores }
    }

    fn r_hat(&self) -> f64 {
        let within = mean(&self.iter().map(variance).collect::<Vec<_>>());
        let draws = self.draws as f64;
        ((draws * self.between() / within + draws - 1.0) / draws).sqrt()
    }

    /// Variance of the halves' means.
    fn between(&self) -> f64 {
        variance(&self.iter().map(mean).collect::<Vec<_>>())
    }

    fn ess(&self) -> f64 {
        let size = self.values.len() as f64;
        if self.is_constant() {
            return size;
        }
        let (time, least) = (self.autocorrelation_time(), 1.0 / size.log10());
        size / if least > time { least } else { time } // a NaN stays
    }

    fn is_constant(&self) -> bool {
        let least = self.values.iter().copied().fold(f64::INFINITY, f64::min);
        let most = self.values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        most - least < RESOLUTION
    }

    /// `ρ_t = 1 − (W − c_t)/(c_0 + B/n)`, with `c_t` the autocovariance averaged over the halves and `W = c_0·n/(n −
    /// 1)`.
    fn autocorrelation_time(&self) -> f64 {
        let deviations = self.deviations();
        let covariance = |lag| deviations.autocovariance(lag);
        let within = covariance(0) * self.draws as f64 / (self.draws - 1) as f64;
        let total = covariance(0) + self.between();
        geyer(self.draws, |lag| 1.0 - (within - covariance(lag)) / total)
    }

    /// Every draw less the mean of its half.
    fn deviations(&self) -> Self {
        let of_half = |half| {
            let mean = mean(half);
            half.iter().map(move |value| value - mean)
        };
        Self { draws: self.draws, values: self.iter().flat_map(of_half).collect() }
    }

    /// Of deviations; a plain sum, as Geyer's criterion asks for few lags of chains that mix.
    fn autocovariance(&self, lag: usize) -> f64 {
        let of_half = |half: &[f64]| {
            let pairs = self.draws - lag;
            DVectorView::from_slice(&half[..pairs], pairs).dot(&DVectorView::from_slice(&half[lag..], pairs))
        };
        self.iter().map(of_half).sum::<f64>() / self.values.len() as f64
    }
}

/// Autocorrelation time `τ = −1 + 2·Σ P_k + ρ_2K` of `n` draws, with the pairs `P_k = ρ_2k + ρ_2k+1` for `k < K`.
///
/// Sums of neighbours are positive and fall in theory. So `K` is the first pair whose sum is not positive, or the last
/// before `n − 2`, and a pair larger than the one before is noise and lowered to it. `ρ_2K` counts where it is
/// positive.
///
/// Source: C. J. Geyer, Practical Markov chain Monte Carlo, Statistical Science 7 (1992) 473, sec. 3.3; the last term
/// as in ArviZ, for antithetic chains.
fn geyer(draws: usize, rho: impl Fn(usize) -> f64) -> f64 {
    let (mut sum, mut least, mut lag) = (0.0, f64::INFINITY, 0);
    let (mut even, mut odd) = (1.0, rho(1));
    while even + odd > 0.0 && lag + 4 < draws {
        least = least.min(even + odd);
        sum += least;
        lag += 2;
        (even, odd) = (rho(lag), rho(lag + 1));
    }
    match even + odd {
        pair if pair.is_nan() => f64::NAN,
        pair if pair >= 0.0 || even > 0.0 => 2.0 * sum - 1.0 + even,
        _ => 2.0 * sum - 1.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all(chains: &[Vec<f64>]) -> [f64; 4] {
        [r_hat(chains), ess_bulk(chains), ess_tail(chains), mcse_mean(chains)]
    }

    /// A fixed order of 0 to 99 without a trend: steps by a primitive root of 101.
    fn scattered() -> Vec<f64> {
        let next = |value: &u32| Some(value * 2 % 101);
        core::iter::successors(Some(1), next).take(100).map(|value: u32| f64::from(value - 1)).collect()
    }

    #[test]
    fn what_cannot_be_known_is_nan() {
        let short = vec![1.0, 2.0, 3.0];
        let hole = vec![1.0, 2.0, f64::NAN, 4.0];
        for chains in [vec![], vec![short.clone(); 4], vec![scattered(), short], vec![hole; 4]] {
            assert!(all(&chains).iter().all(|figure| figure.is_nan()), "{chains:?}");
        }
    }

    #[test]
    fn constant_chains_count_as_independent_draws_without_r_hat() {
        let [r_hat, ess_bulk, ess_tail, mcse_mean] = all(&[vec![2.5; 11], vec![2.5; 11]]);
        assert!(r_hat.is_nan());
        assert_eq!([ess_bulk, ess_tail, mcse_mean], [20.0, 20.0, 0.0]); // the middle draws of 11 belong to no half
    }

    #[test]
    fn one_chain_has_all_but_r_hat() {
        let [r_hat, others @ ..] = all(&[scattered()]);
        assert!(r_hat.is_nan() && others.iter().all(|figure| *figure > 0.0));
    }

    #[test]
    fn chains_that_rest_at_different_places_never_agree() {
        assert_eq!(r_hat(&[[0.0; 8], [1.0; 8]]), f64::INFINITY);
    }

    #[test]
    fn infinite_draws_are_only_extreme_to_ranks() {
        let mut infinite = [scattered(), scattered()];
        let [r_hat, ess_bulk, ess_tail, ..] = all(&infinite);
        infinite.iter_mut().flatten().filter(|draw| **draw == 99.0).for_each(|draw| *draw = f64::INFINITY);
        let [ranked @ .., mcse_mean] = all(&infinite);
        assert_eq!(ranked, [r_hat, ess_bulk, ess_tail]);
        assert!(mcse_mean.is_nan());
    }

    #[test]
    fn signed_zeros_are_ties() {
        let signed = [[0.0, -0.0, 0.0, -0.0, 1.0, 2.0, 0.0, -0.0]; 2];
        assert_eq!(ess_bulk(&signed), ess_bulk(&signed.map(|chain| chain.map(f64::abs))));
    }

    #[test]
    fn diagnostics_by_rank_ignore_the_scale() {
        let chains = [scattered(), scattered().into_iter().rev().collect()];
        let cubed = chains.each_ref().map(|chain| chain.iter().map(|draw| draw.powi(3)).collect::<Vec<f64>>());
        assert_eq!([ess_bulk(&chains), ess_tail(&chains)], [ess_bulk(&cubed), ess_tail(&cubed)]);
    }

    #[test]
    fn autocorrelation_time_of_geometric_correlations_is_closed() {
        let phi = 0.8_f64; // 1 + 2·Σ φ^t = (1 + φ)/(1 − φ) = 9; the rest after 200 lags is below rounding
        assert!((geyer(200, |lag| phi.powi(lag as i32)) - 9.0).abs() < 1e-12);
    }

    #[test]
    fn autocorrelation_time_lowers_a_pair_that_rises() {
        // Pairs 1.2, 0.2, 0.4 lowered to 0.2, then -0.2 that ends the sum without its even part.
        let rho = [1.0, 0.2, 0.1, 0.1, 0.3, 0.1, -0.1, -0.1];
        assert!((geyer(20, |lag| rho[lag]) - (2.0 * (1.2 + 0.2 + 0.2) - 1.0)).abs() < 1e-15);
    }

    #[test]
    fn quantile_of_few_values() {
        assert!(quantile(&[], 0.5).is_nan());
        assert_eq!([0.0, 0.3, 1.0].map(|probability| quantile(&[2.0], probability)), [2.0; 3]);
        assert_eq!([0.0, 0.25, 1.0].map(|probability| quantile(&[2.0, 4.0], probability)), [2.0, 2.5, 4.0]);
    }
}
