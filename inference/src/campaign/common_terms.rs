//! Sums over the readings of one monitor, from which the terms that they have in common are eliminated.
//!
//! A reading less its prediction obeys `r = x p + c t + noise`: `p` is wanted, `t` are the common terms (the baseline at each time in
//! the cycle, whose coefficient is 1 at that time and else 0, then its change with each supply and with the RF offset, see [`super::Campaign::terms`]), each with a normal
//! prior of mean 0. With
//! `M` the sum of weight times `c c^T` plus the prior precision of the terms,
//!
//! `t = M^-1 (sum of weight c r - S^T p)`, `S = sum of weight x c^T`,
//!
//! and the normal equations of `p` alone lose the Schur complement `S M^-1 S^T`.

use nalgebra::{Cholesky, DMatrix, DVector, DVectorView, Dyn};

/// Sums over some readings of a monitor of weight times products of their terms' coefficients and residual.
#[derive(Debug, Clone)]
pub(crate) struct Weighed(DMatrix<f64>);

/// Sums over all readings of a monitor.
#[derive(Debug, Clone)]
pub(crate) struct Common {
    /// Sum of weight times `(c, r) (c, r)^T`, the prior precision of the terms included [K + 1][K + 1].
    moments: DMatrix<f64>,
    /// Sum of weight times `x (c, r)^T` [X][K + 1].
    slope: DMatrix<f64>,
    /// How many of the terms are baselines; they come first.
    baselines: usize,
}

/// What readings say of `p` when the terms are at their best.
pub(crate) struct Eliminated {
    /// Columns `S L^-T`, `M = L L^T`: the sum of weight times `x x^T` loses their squares [X][K].
    pub columns: DMatrix<f64>,
    /// What is left of the sum of weight times `x r` [X].
    pub moment: DVector<f64>,
    /// What is left of the sum of weight times `r^2`.
    pub square: f64,
}

impl Weighed {
    /// No reading of a monitor with this many terms.
    pub fn none(terms: usize) -> Self {
        Self(DMatrix::zeros(terms + 1, terms + 1))
    }

    /// One reading: the coefficients of its terms, measured minus predicted, and one over its variance.
    pub fn one(terms: &[f64], residual: f64, weight: f64) -> Self {
        let all = DVector::from_iterator(terms.len() + 1, terms.iter().copied().chain([residual]));
        Self(&all * all.transpose() * weight)
    }

    /// Sum of the weights, of readings with one of so many baselines.
    pub fn weight(&self, baselines: usize) -> f64 {
        (0..baselines).map(|time| self.0[(time, time)]).sum()
    }
}

impl core::ops::AddAssign<&Self> for Weighed {
    fn add_assign(&mut self, other: &Self) {
        self.0 += &other.0;
    }
}

impl Common {
    /// No reading yet, of `size` wanted numbers; the first of the terms are `baselines`, and `baseline` is the precision to which each of
    /// these is known to be 0, 0 for not at all. The other terms are in units of their standard deviations.
    pub fn new(size: usize, terms: usize, baselines: usize, baseline: f64) -> Self {
        let mut moments = DMatrix::zeros(terms + 1, terms + 1);
        (0..terms).for_each(|k| moments[(k, k)] = if k < baselines { baseline } else { 1.0 });
        Self { moments, slope: DMatrix::zeros(size, terms + 1), baselines }
    }

    /// Add readings that share `x`.
    pub fn add(&mut self, x: &DVectorView<f64>, readings: &Weighed) {
        self.moments += &readings.0;
        // the coefficient of one baseline is 1
        (0..self.baselines).for_each(|time| self.slope.ger(1.0, x, &readings.0.column(time), 1.0));
    }

    fn terms(&self) -> usize {
        self.moments.ncols() - 1
    }

    /// True if something is known of a baseline.
    fn is_known(&self, baseline: usize) -> bool {
        self.moments[(baseline, baseline)] > 0.0
    }

    /// Baselines that anything is known of.
    fn known(&self) -> usize {
        (0..self.baselines).filter(|baseline| self.is_known(*baseline)).count()
    }

    /// Factor of `M`; none where nothing is known of any baseline. Where nothing is of one of several, it is 0 and costs nothing.
    fn factor(&self) -> Option<Cholesky<f64, Dyn>> {
        let k = self.terms();
        let mut moments = self.moments.view((0, 0), (k, k)).into_owned();
        let unknown = (0..self.baselines).filter(|baseline| !self.is_known(*baseline));
        if self.known() > 0 {
            unknown.for_each(|baseline| moments[(baseline, baseline)] = 1.0);
        }
        moments.cholesky()
    }

    /// Baselines at their best for given `p`, one for each time in the cycle; none of a time without readings.
    pub fn best_baselines(&self, p: &DVector<f64>) -> Vec<Option<f64>> {
        let best = self.best(p);
        let known = |time: usize| best.as_ref().filter(|_| self.is_known(time)).map(|best| best[time]);
        (0..self.baselines).map(known).collect()
    }

    /// Terms at their best for given `p`; none without readings.
    pub fn best(&self, p: &DVector<f64>) -> Option<DVector<f64>> {
        let k = self.terms();
        let pull = self.moments.view((0, k), (k, 1)) - self.slope.columns(0, k).tr_mul(p);
        self.factor().map(|factor| factor.solve(&pull).column(0).into_owned())
    }

    /// `M^-1 c` and `S M^-1 c`: what a reading with these terms has in common with those before; none without any.
    pub fn seen_by(&self, terms: &[f64]) -> Option<(DVector<f64>, DVector<f64>)> {
        let solved = self.factor()?.solve(&DVector::from_column_slice(terms));
        let along = self.slope.columns(0, self.terms()) * &solved;
        Some((solved, along))
    }

    /// Without the terms.
    pub fn eliminated(&self) -> Eliminated {
        let k = self.terms();
        let (moment, square) = (self.slope.column(k).into_owned(), self.moments[(k, k)]);
        let lower = self.factor().map(|factor| factor.unpack());
        let solve = |lower: DMatrix<f64>| {
            let pull = lower.solve_lower_triangular(&self.moments.view((0, k), (k, 1)))?;
            Some((lower.solve_lower_triangular(&self.slope.columns(0, k).transpose())?.transpose(), pull))
        };
        let Some((columns, pull)) = lower.and_then(solve) else {
            return Eliminated { columns: DMatrix::zeros(moment.len(), 0), moment, square };
        };
        Eliminated { moment: moment - &columns * pull.column(0), square: square - pull.norm_squared(), columns }
    }
}

/// Chi-square of some readings of a monitor by their noise [m] about what they have in common, and its degrees of freedom: the number of
/// readings less 1 for each baseline and, for each other term, the share of it that the readings and not its prior determine.
/// `terms`: a column for each reading, first the coefficients of so many baselines, then the others in standard deviations [m].
///
/// Source: T. Hastie, R. Tibshirani and J. Friedman, The Elements of Statistical Learning (2009), eq. 3.50.
pub fn chi_square(residual: &DVector<f64>, terms: &DMatrix<f64>, baselines: usize, noise: f64) -> (f64, f64) {
    let mut common = Common::new(0, terms.nrows(), baselines, 0.0);
    for (residual, terms) in residual.iter().zip(terms.column_iter()) {
        common.add(&DVector::zeros(0).column(0), &Weighed::one(terms.as_slice(), *residual, noise.powi(-2)));
    }
    let Some((best, left)) = common.best(&DVector::zeros(0)).zip(common.factor().map(|factor| factor.inverse())) else {
        return (0.0, 0.0);
    };
    let others = baselines..best.len();
    let cost: f64 = others.clone().map(|k| best[k].powi(2)).sum();
    let learnt: f64 = others.map(|k| 1.0 - left[(k, k)]).sum();
    (common.eliminated().square - cost, residual.len() as f64 - common.known() as f64 - learnt)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Against the covariance of the readings, `noise^2 + C C^T`, each term times its standard deviation.
    #[test]
    fn what_is_left_is_the_chi_square_of_correlated_readings() {
        let (readings, size, noise) = (12, 4, 0.3);
        let wave = |i: usize, k: f64| (k * i as f64 + 0.3 * k).sin();
        let x = DMatrix::from_fn(size, readings, |p, i| wave(i, 1.1 + p as f64));
        let terms = DMatrix::from_fn(3, readings, |k, i| if k == 0 { 1.0 } else { wave(i, 0.5 + 0.2 * k as f64) });
        let residual = DVector::from_fn(readings, |i, _| 5.0 + wave(i, 2.3));
        let mut common = Common::new(size, 3, 1, 0.02);
        for i in 0..readings {
            let one = Weighed::one(terms.column(i).as_slice(), residual[i], f64::powi(noise, -2));
            common.add(&x.column(i).as_view(), &one);
        }
        let Eliminated { columns, moment, square } = common.eliminated();
        let mut wide = terms.clone();
        wide.row_mut(0).scale_mut(0.02_f64.sqrt().recip());
        let covariance = DMatrix::identity(readings, readings) * noise.powi(2) + wide.tr_mul(&wide);
        let precision = covariance.cholesky().unwrap().inverse();
        let plain = &x * x.transpose() * noise.powi(-2) - &columns * columns.transpose();
        assert!((plain - &x * &precision * x.transpose()).amax() < 1e-9);
        assert!((moment - &x * &precision * &residual).amax() < 1e-9);
        assert!((square - residual.dot(&(&precision * &residual))).abs() < 1e-9);
    }

    /// Residuals and trace of the linear smoother that the best terms are.
    #[test]
    fn chi_square_is_that_of_the_residuals_and_what_they_are_free_to_be() {
        let terms = DMatrix::from_fn(9, 2, |i, k| (0.7 * (i + 1) as f64 * (k + 1) as f64).sin());
        let residual = DVector::from_fn(9, |i, _| 2.0 + (1.9 * i as f64).cos());
        let all = terms.clone().insert_column(0, 1.0);
        let prior = DMatrix::from_diagonal(&DVector::from_vec(vec![0.0, 1.0, 1.0]));
        let noise = 0.4;
        let smoother = &all * (all.tr_mul(&all) + prior * f64::powi(noise, 2)).try_inverse().unwrap() * all.transpose();
        let left = (&residual - &smoother * &residual).norm_squared() / noise.powi(2);
        let (chi2, freedom) = chi_square(&residual, &all.transpose(), 1, noise);
        assert!((chi2 - left).abs() < 1e-9 && (freedom - (9.0 - smoother.trace())).abs() < 1e-9, "{chi2} {freedom}");
    }

    #[test]
    fn terms_that_are_zero_change_nothing() {
        let residual = DVector::from_vec(vec![1.0, 2.0, 4.0, -3.0]);
        let about_mean = residual.add_scalar(-residual.mean()).norm_squared();
        for terms in [0, 2] {
            let terms = DMatrix::zeros(terms, 4).insert_row(0, 1.0);
            let (chi2, freedom) = chi_square(&residual, &terms, 1, 0.5);
            assert!((chi2 - 4.0 * about_mean).abs() < 1e-12 && (freedom - 3.0).abs() < 1e-12);
        }
    }

    /// Two times in the cycle, one of them read: as if there were one; both read: each about its own mean.
    #[test]
    fn each_time_in_the_cycle_has_its_baseline() {
        let residual = DVector::from_vec(vec![1.0, 2.0, 14.0, 7.0]);
        let at_first = DMatrix::from_row_slice(2, 4, &[1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0]);
        let at_both = DMatrix::from_row_slice(2, 4, &[1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0]);
        for (terms, expected) in [(at_first, (106.0, 3.0)), (at_both, (25.0, 2.0))] {
            let (chi2, freedom) = chi_square(&residual, &terms, 2, 1.0);
            assert!((chi2 - expected.0).abs() < 1e-9 && freedom == expected.1, "{chi2} {freedom}");
        }
        let mut common = Common::new(0, 2, 2, 0.0);
        common.add(&DVector::zeros(0).column(0), &Weighed::one(&[0.0, 1.0], 3.0, 1.0));
        assert_eq!(common.best_baselines(&DVector::zeros(0)), [None, Some(3.0)]); // by a factor of 1
    }

    #[test]
    fn without_readings_nothing_is_left() {
        let Eliminated { columns, moment, square } = Common::new(2, 3, 1, 0.0).eliminated();
        assert_eq!((columns.ncols(), moment, square), (0, DVector::zeros(2), 0.0));
        assert_eq!(Common::new(2, 3, 1, 0.0).best(&DVector::zeros(2)), None);
        assert_eq!(chi_square(&DVector::zeros(0), &DMatrix::zeros(2, 0), 1, 0.1), (0.0, 0.0));
    }
}
