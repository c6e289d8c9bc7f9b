//! What the readings of a pool tell by their differences of the terms that they have in common.
//!
//! In a pool the machine is the same but for the supplies, which the baseline follows by unknown factors `c`, standard normal in their
//! prior. With `w` the readings less the mean of their pool, `W` the terms less theirs, both over the noise,
//!
//! `V = (1 + W^T W)^-1`, `m = V W^T w`
//!
//! are covariance and mean of the factors before the means are looked at; for white noise means and differences are independent, so
//! that nothing is counted twice and nothing is lost.

use nalgebra::{DMatrix, DVector};

/// Mean of the factors of the common terms, and the root of their covariance, its product with its transpose, from differences of readings and of their
/// terms [readings][factors], both over the noise.
pub fn common_factors(readings: &DVector<f64>, terms: &DMatrix<f64>) -> (DVector<f64>, DMatrix<f64>) {
    let factors = terms.ncols();
    let normal = DMatrix::identity(factors, factors) + terms.tr_mul(terms);
    let unknown = || (DVector::zeros(factors), DMatrix::identity(factors, factors));
    let Some(factor) = normal.cholesky() else { return unknown() };
    // (L L^T)^-1 = L^-T L^-1
    let Some(root) = factor.l().transpose().solve_upper_triangular(&DMatrix::identity(factors, factors)) else {
        return unknown();
    };
    (factor.solve(&terms.tr_mul(readings)), root)
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
        let (mean, root) = common_factors(&off, &off_terms);
        let left = &means.0 - &means.1 * &mean;
        let terms = &means.1 * &root;
        let step = (DMatrix::identity(2, 2) + terms.tr_mul(&terms)).cholesky().unwrap().solve(&terms.tr_mul(&left));
        let found = &mean + &root * step;
        assert!((found - whole).amax() < 1e-12, "rounding");
    }
}
