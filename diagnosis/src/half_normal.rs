//! The posterior of a size whose prior is half-normal, on a grid: how likely it is against none, its mean and its mean square.
//!
//! All sums are taken relative to their largest term: the likelihood of strong noise in common exceeds that of none by more than
//! the largest number.

/// Prior widths that the grid spans; beyond them lies 0.3 % of the prior.
const SPAN: f64 = 3.0;

/// A posterior.
#[derive(Debug, Clone, Copy)]
pub struct HalfNormal {
    /// `ln` of the likelihood's mean over the prior.
    pub log_evidence: f64,
    /// Mean size.
    pub mean: f64,
    /// Mean of its square.
    pub square: f64,
}

impl HalfNormal {
    /// From a `ln` likelihood and the width of the prior, on so many points.
    pub fn from_log_likelihood(log_likelihood: impl Fn(f64) -> f64, width: f64, points: usize) -> Self {
        let step = SPAN / points as f64;
        let log_weight = |x: f64| (x * width, log_likelihood(x * width) - 0.5 * x * x);
        let all: Vec<(f64, f64)> = (0..points).map(|i| log_weight((i as f64 + 0.5) * step)).collect();
        let largest = all.iter().map(|(_, log)| *log).fold(f64::NEG_INFINITY, f64::max);
        let sum = |power: i32| all.iter().map(|(size, log)| size.powi(power) * (log - largest).exp()).sum::<f64>();
        let total = sum(0);
        Self {
            log_evidence: largest + (total * step * core::f64::consts::FRAC_2_PI.sqrt()).ln(),
            mean: sum(1) / total,
            square: sum(2) / total,
        }
    }

    /// Standard deviation of the size.
    pub fn sigma(&self) -> f64 {
        (self.square - self.mean * self.mean).max(0.0).sqrt()
    }

    /// Root mean square of the size if none is possible too, whose likelihood times its prior odds has this `ln`.
    pub fn range(&self, log_none: f64) -> f64 {
        (self.square / (1.0 + (log_none - self.log_evidence).exp())).sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_likelihood_that_says_nothing_leaves_the_prior() {
        let posterior = HalfNormal::from_log_likelihood(|_| 0.0, 2.0, 600);
        // a grid of three widths leaves out 0.27 % of the prior, 0.9 % of its mean and 2.9 % of its square
        assert!(posterior.log_evidence.abs() < 0.003);
        assert!((posterior.mean / (2.0 * core::f64::consts::FRAC_2_PI.sqrt()) - 1.0).abs() < 0.012);
        assert!((posterior.square / 4.0 - 1.0).abs() < 0.03);
        assert!(
            (posterior.range(0.0) / (0.5 * posterior.square).sqrt() - 1.0).abs() < 0.002,
            "none and some are as likely"
        );
    }

    #[test]
    fn an_overwhelming_likelihood_stays_a_number() {
        let posterior = HalfNormal::from_log_likelihood(|size| 1e4 * size, 1.0, 60);
        assert!(posterior.log_evidence > 2.9e4 && posterior.log_evidence.is_finite());
        assert!((posterior.mean - 2.975).abs() < 1e-9, "the last point of the grid");
        assert!(posterior.sigma() < 1e-6 && posterior.range(0.0).is_finite());
    }
}
