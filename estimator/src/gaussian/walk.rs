//! What is known is forgotten: a random walk of the params, each by its own step. It is a prediction of the Kalman filter, in
//! information form; the best point stays.

use super::{Correlated, Gaussian, Solution};
use crate::linear::dot;
use crate::triangle::Triangle;

impl<const B: usize, const N: usize, const T: usize, const U: usize> Gaussian<B, N, T, Correlated<B, U>> {
    /// Let each param walk at random by its `sigma`, none of them below 1e-6: `P += S^2`, `S = diag(sigma)`, baselines stay.
    ///
    /// With `K = (1 + S Y S)^-1`: `Y <- S^-1 K S Y = S^-1 (1 - K) S^-1`, `slope <- S^-1 K S slope`,
    /// `covariance += slope^T S K S slope`. The difference is off by 1e-16, the information so by 1e-4 in the worst case, where the prior's
    /// is a thousand.
    /// `solution` is that of this Gaussian and serves as work space.
    pub fn walk<const W: usize>(&mut self, sigma: &[f64; N], solution: &mut Solution<N, T, W>) {
        let mean = solution.delta;
        let k = solution.work_space();
        for (i, (to, from)) in k.rows_mut().zip(self.information.rows()).enumerate() {
            let own = sigma.get(i).copied().unwrap_or(0.0);
            to.iter_mut().zip(from).zip(sigma).for_each(|((to, y), other)| *to = own * y * other);
            to.last_mut().into_iter().for_each(|diagonal| *diagonal += 1.0);
        }
        let Some(log_determinant) = k.factorise() else {
            return; // 1 + a positive matrix; only a NaN could fail, and none can enter
        };
        k.invert();
        let best = self.cost - dot(&self.vector, &mean);
        self.walk_baselines(sigma, k, &mean);
        k.square();
        for (i, (to, from)) in self.information.rows_mut().zip(k.rows()).enumerate() {
            let own = sigma.get(i).copied().unwrap_or(1.0);
            to.iter_mut().zip(from).zip(sigma).for_each(|((to, k), other)| *to = -k / (own * other));
            to.last_mut().into_iter().for_each(|diagonal| *diagonal += 1.0 / (own * own));
        }
        self.keep(best, log_determinant, &mean);
    }

    /// Slopes, covariance and, so that the best point stays, baselines; `K = X^T X`.
    fn walk_baselines(&mut self, sigma: &[f64; N], x: &Triangle<N, T, f64>, mean: &[f64; N]) {
        for (baseline, slope) in self.baseline.iter_mut().zip(&mut self.slope) {
            *baseline -= dot(slope, mean);
            multiply(slope, sigma);
            x.apply_lower(slope);
        }
        self.covariance.correlate(&self.slope);
        for (baseline, slope) in self.baseline.iter_mut().zip(&mut self.slope) {
            *slope = x.apply_upper(slope);
            divide(slope, sigma);
            *baseline += dot(slope, mean);
        }
    }

    /// The best point stays, and so do its chi-square and the evidence: the determinant has fallen by this logarithm.
    fn keep(&mut self, best: f64, log_determinant: f64, mean: &[f64; N]) {
        self.vector = self.information.multiply(mean);
        self.cost = best + dot(&self.vector, mean);
        self.volume += log_determinant;
    }
}

fn multiply<const N: usize>(row: &mut [f64; N], by: &[f64; N]) {
    row.iter_mut().zip(by).for_each(|(value, by)| *value *= by);
}

fn divide<const N: usize>(row: &mut [f64; N], by: &[f64; N]) {
    row.iter_mut().zip(by).for_each(|(value, by)| *value /= by);
}
