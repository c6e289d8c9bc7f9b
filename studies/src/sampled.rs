//! Draws of all vars as a matrix, and what is read off them.

use nalgebra::DMatrix;

use inference::{Draws, Summary};
use report::Band;

/// A sampled posterior.
#[derive(Debug, Clone)]
pub struct Sampled {
    /// Each var.
    pub summary: Vec<Summary>,
    /// Draws of all chains: rows draws, columns vars.
    pub vars: DMatrix<f64>,
}

impl Sampled {
    /// Everything about a run's draws.
    pub fn of(draws: &Draws) -> Self {
        let all: Vec<&[f64]> = draws.chains.iter().flat_map(|chain| chain.draws.iter().map(Vec::as_slice)).collect();
        Self { summary: draws.summary(), vars: DMatrix::from_fn(all.len(), draws.names.len(), |i, j| all[i][j]) }
    }

    /// Mean of each var.
    pub fn mean(&self) -> Vec<f64> {
        self.summary.iter().map(|s| s.mean).collect()
    }

    /// Standard deviation of each var.
    pub fn sigma(&self) -> Vec<f64> {
        self.summary.iter().map(|s| s.sd).collect()
    }

    /// Smallest effective sample size of a var, bulk or tail.
    pub fn smallest_ess(&self) -> f64 {
        self.summary.iter().map(|s| s.ess_bulk.min(s.ess_tail)).fold(f64::INFINITY, f64::min)
    }

    /// Largest R-hat of a var; infinite where a chain has not moved, which has none.
    pub fn largest_r_hat(&self) -> f64 {
        let each = self.summary.iter().map(|s| if s.r_hat.is_nan() { f64::INFINITY } else { s.r_hat });
        each.fold(0.0, f64::max)
    }

    /// 68 % and 95 % bands of each var.
    pub fn band(&self, label: &str) -> Band {
        Band {
            label: label.to_owned(),
            centre: self.mean(),
            inner: self.summary.iter().map(|s| (s.q16, s.q84)).collect(),
            outer: self.summary.iter().map(|s| (s.q025, s.q975)).collect(),
        }
    }

    /// Covariance of the vars.
    pub fn covariance(&self) -> DMatrix<f64> {
        let mean = self.mean();
        let mut centred = self.vars.clone();
        centred.column_iter_mut().zip(&mean).for_each(|(mut column, m)| column.add_scalar_mut(-m));
        centred.tr_mul(&centred) / (self.vars.nrows() as f64 - 1.0)
    }

    /// Correlation of the vars.
    pub fn correlation(&self) -> DMatrix<f64> {
        correlation(&self.covariance())
    }

    /// Probability density of one var as a histogram of `bins` bins: centres and heights.
    pub fn density(&self, var: usize, bins: usize) -> (Vec<f64>, Vec<f64>) {
        let values = self.vars.column(var);
        let (low, high) = (values.min(), values.max());
        let width = (high - low).max(f64::MIN_POSITIVE) / bins as f64;
        let mut counts = vec![0.0; bins];
        values.iter().for_each(|v| counts[(((v - low) / width) as usize).min(bins - 1)] += 1.0);
        let centres = (0..bins).map(|i| low + (i as f64 + 0.5) * width).collect();
        (centres, counts.into_iter().map(|n| n / (values.len() as f64 * width)).collect())
    }
}

/// Correlations of a covariance.
pub fn correlation(covariance: &DMatrix<f64>) -> DMatrix<f64> {
    let sigma: Vec<f64> = covariance.diagonal().iter().map(|v| v.sqrt()).collect();
    DMatrix::from_fn(sigma.len(), sigma.len(), |i, j| covariance[(i, j)] / (sigma[i] * sigma[j]))
}

/// Largest absolute difference off the diagonal.
pub fn largest_difference(one: &DMatrix<f64>, other: &DMatrix<f64>) -> f64 {
    (one - other).amax()
}
