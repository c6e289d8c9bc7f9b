//! What the readings of a pool tell by their differences of the terms that they have in common.
//!
//! CommonFactors a pool the machine is the same but for the supplies, which the baseline follows by unknown factors `c`, standard normal in their
//! prior. With `w` the readings less the mean of their pool, `W` the terms less theirs, both over the noise,
//!
//! `V = (1 + W^T W)^-1`, `m = V W^T w`
//!
//! are covariance and mean of the factors before the means are looked at; for white noise means and differences are independent, so
//! that nothing is counted twice and nothing is lost.

use nalgebra::{DMatrix, DVector};

/// Factors of the common terms, as the differences within pools tell them.
#[derive(Debug, Clone)]
pub struct CommonFactors {
    /// Their mean.
    pub mean: DVector<f64>,
    /// Root of their covariance: its product with its transpose.
    pub root: DMatrix<f64>,
}

impl CommonFactors {
    /// From differences of readings and of their terms [readings][factors], both over the noise.
    pub fn from_differences(readings: &DVector<f64>, terms: &DMatrix<f64>) -> Self {
        let factors = terms.ncols();
        let normal = DMatrix::identity(factors, factors) + terms.tr_mul(terms);
        let unknown = || Self { mean: DVector::zeros(factors), root: DMatrix::identity(factors, factors) };
        let Some(factor) = normal.cholesky() else { return unknown() };
        // (L L^T)^-1 = L^-T L^-1
        let Some(root) = factor.l().transpose().solve_upper_triangular(&DMatrix::identity(factors, factors)) else {
            return unknown();
        };
        Self { mean: factor.solve(&terms.tr_mul(readings)), root }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The best factors of all readings, with a free mean for each pool, by both ways.
    #[test]
    fn differences_and_means_together_tell_what_the_readings_tell() {
        let pools = [0..3, 3..5, 5..9];
        let terms = DMatrix::from_fn(9, 2, |i, k| (1.7 * (i * i) as f64 + k as f64).sin() * 2.0);
        let readings = DVector::from_fn(9, |i, _| (0.9 * (i * i) as f64).cos() * 3.0);
        let whole =
            (DMatrix::identity(2, 2) + terms.tr_mul(&terms)).cholesky().unwrap().solve(&terms.tr_mul(&readings));
        let (mut off, mut off_terms) = (readings.clone(), terms.clone());
        let mut means = (DVector::zeros(3), DMatrix::zeros(3, 2));
        for (g, pool) in pools.iter().enumerate() {
            let n = pool.len();
            let (mean, mean_terms) = (readings.rows(pool.start, n).mean(), terms.rows(pool.start, n).row_mean());
            means.0[g] = mean * (n as f64).sqrt();
            means.1.set_row(g, &(&mean_terms * (n as f64).sqrt()));
            pool.clone().for_each(|i| {
                off[i] -= mean;
                let mut row = off_terms.row_mut(i);
                row -= &mean_terms;
            });
        }
        let within = CommonFactors::from_differences(&off, &off_terms);
        let left = &means.0 - &means.1 * &within.mean;
        let terms = &means.1 * &within.root;
        let step = (DMatrix::identity(2, 2) + terms.tr_mul(&terms)).cholesky().unwrap().solve(&terms.tr_mul(&left));
        let found = &within.mean + &within.root * step;
        assert!((found - whole).amax() < 1e-12, "rounding");
    }
}
