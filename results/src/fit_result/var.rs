//! One strength factor in a result.

use estimator::Marginal;
use inference::Summary;
use schemars::JsonSchema;
use serde::Serialize;
use twin::Ring;

/// One quadrupole factor: mean, standard deviation and quantiles of its truncated posterior [1].
#[derive(Debug, Clone, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct Var {
    pub name: String,
    pub mean: f64,
    pub sigma: f64,
    pub q025: f64,
    pub q16: f64,
    pub q84: f64,
    pub q975: f64,
    /// At a bound of the prior's range.
    pub clipped: bool,
}

impl Var {
    /// Moments and quantiles of draws; the sampler's coordinates never reach a bound.
    pub(super) fn of_draws(summary: &Summary) -> Self {
        let Summary { name, mean, sd, q025, q16, q84, q975, .. } = summary.clone();
        Self { name, mean, sigma: sd, q025, q16, q84, q975, clipped: false }
    }

    /// Moments and quantiles of a marginal of `ln var`.
    pub(super) fn of_marginal(name: String, marginal: &Marginal, clipped: bool) -> Self {
        let (mean, sigma) = marginal.moments();
        let quantile = |p| f64::from(marginal.quantile(p));
        Self {
            name,
            mean: f64::from(mean),
            sigma: f64::from(sigma),
            q025: quantile(0.025),
            q16: quantile(0.16),
            q84: quantile(0.84),
            q975: quantile(0.975),
            clipped,
        }
    }

    pub(super) fn cells(&self) -> [String; 4] {
        let mark = if self.clipped { "*" } else { "" };
        [
            format!("{}{mark}", self.name),
            format!("{:.4}", self.mean),
            format!("{:.2}", 100.0 * self.sigma),
            format!("{:.4}..{:.4}", self.q025, self.q975),
        ]
    }
}

/// Vars from means and standard deviations of `ln var`, truncated to the prior's range.
pub fn vars_of(ring: &Ring, mean: &[f64], sigma: &[f64]) -> Vec<Var> {
    let prior = inference::Prior::from_ring(ring);
    let var = |(i, name)| Var::of_marginal(name, &prior.marginal(i, mean[i], sigma[i]), false);
    ring.var_names().into_iter().enumerate().map(var).collect()
}

/// Covariance of the vars, `mean_i mean_j` times that of their logarithms.
pub(super) fn covariance(vars: &[Var], of_params: impl Fn(usize, usize) -> f64) -> Vec<Vec<f64>> {
    let row = |i: usize| (0..vars.len()).map(|j| vars[i].mean * vars[j].mean * of_params(i, j)).collect();
    (0..vars.len()).map(row).collect()
}
