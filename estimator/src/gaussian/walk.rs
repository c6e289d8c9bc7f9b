//! A random walk of the params: a prediction of the Kalman filter in information form.

use super::{Correlated, Gaussian, Solution, square};
use crate::linear::dot;
use crate::triangle::Triangle;

impl<const B: usize, const N: usize, const T: usize, const U: usize> Gaussian<B, N, T, Correlated<B, U>> {
    /// Let every param walk at random by `sigma`: `P += sigma^2`, baselines stay.
    ///
    /// With `K = (1 + sigma^2 Y)^-1`: `Y <- K Y`, `slope <- K slope`, `covariance += sigma^2 slope^T K slope`.
    /// `solution` is that of this Gaussian and serves as work space.
    pub fn walk<const W: usize>(&mut self, sigma: f32, solution: &mut Solution<N, T, W>) {
        let variance = square(sigma);
        let mean = solution.delta;
        let k = solution.work_space();
        for (i, (to, from)) in k.rows_mut().zip(self.information.rows()).enumerate() {
            to.iter_mut().zip(from).for_each(|(to, y)| *to = variance * y);
            to.get_mut(i).into_iter().for_each(|diagonal| *diagonal += 1.0);
        }
        if k.factorise().is_none() {
            return; // 1 + a positive matrix; only a NaN could fail, and none can enter
        }
        let mut row = [0.0; N];
        // from the first row down: each finds the rest of its column, in the rows below, as it was
        for i in 0..N {
            self.information.copy_row(i, &mut row);
            k.solve_lower(&mut row);
            k.solve_upper(&mut row);
            self.information.row_mut(i).iter_mut().zip(&row).for_each(|(to, y)| *to = *y);
        }
        self.walk_baselines(variance, k, &mean);
        // the best point and its chi-square stay
        let best = self.cost - dot(&self.vector, &mean);
        self.vector = self.information.multiply(&mean);
        self.cost = best + dot(&self.vector, &mean);
    }

    /// Slopes, covariance and, so that the best point stays, baselines; `K = L^-T L^-1`.
    fn walk_baselines(&mut self, variance: f64, k: &Triangle<N, T, f64>, mean: &[f64; N]) {
        for (baseline, slope) in self.baseline.iter_mut().zip(self.slope.as_mut_slice().as_chunks_mut::<N>().0) {
            *baseline -= dot(slope, mean);
            k.solve_lower(slope);
        }
        self.covariance.correlate(variance, &self.slope);
        for (baseline, slope) in self.baseline.iter_mut().zip(self.slope.as_mut_slice().as_chunks_mut::<N>().0) {
            k.solve_upper(slope);
            *baseline += dot(slope, mean);
        }
    }
}
