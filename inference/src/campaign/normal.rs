//! Normal equations of the params with an unknown baseline for each monitor.
//!
//! Readings obey `residual = h step + baseline_b + noise`. Sums of weight times `1, h, residual` of each monitor are kept apart, so
//! that readings can be added and taken away one by one; the baselines at their best leave the Schur complement.

use nalgebra::{Cholesky, DMatrix, DVector, DVectorView, Dyn};

use crate::optimise::Quadratic;
use crate::prior::Prior;

/// Sums over readings, and the prior, about some params.
#[derive(Debug, Clone)]
pub(crate) struct Normal {
    matrix: DMatrix<f64>,
    vector: DVector<f64>,
    square: f64,
    monitors: Vec<Sums>,
}

/// Sums over readings of weight times `1, residual, residual^2`.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Weighed {
    weight: f64,
    residual: f64,
    square: f64,
}

impl Weighed {
    /// One reading: measured minus predicted, and one over its variance.
    pub fn one(residual: f64, weight: f64) -> Self {
        Self { weight, residual: weight * residual, square: weight * residual * residual }
    }
}

impl core::ops::AddAssign for Weighed {
    fn add_assign(&mut self, other: Self) {
        self.weight += other.weight;
        self.residual += other.residual;
        self.square += other.square;
    }
}

/// Sums over the readings of one monitor.
#[derive(Debug, Clone)]
struct Sums {
    weight: f64,
    residual: f64,
    slope: DVector<f64>,
}

impl Normal {
    /// The prior alone about params; `baseline` is the precision to which each baseline is known to be 0, 0 for not at all.
    pub fn new(prior: &Prior, params: &DVector<f64>, monitors: usize, baseline: f64) -> Self {
        let sums = Sums { weight: baseline, residual: 0.0, slope: DVector::zeros(params.len()) };
        Self {
            matrix: DMatrix::from_diagonal(&prior.precision),
            vector: (&prior.mean - params).component_mul(&prior.precision),
            square: prior.cost(params),
            monitors: vec![sums; monitors],
        }
    }

    /// Readings, those that share a derivative together: their derivatives as columns, and of each the monitor and the sums.
    pub fn add(&mut self, slopes: &DMatrix<f64>, readings: &[(usize, Weighed)]) {
        for (slope, (b, readings)) in slopes.column_iter().zip(readings) {
            let sums = &mut self.monitors[*b];
            sums.weight += readings.weight;
            sums.residual += readings.residual;
            sums.slope.axpy(readings.weight, &slope, 1.0);
            self.square += readings.square;
            self.vector.axpy(readings.residual, &slope, 1.0);
        }
        add_squares(&mut self.matrix, slopes, readings.iter().map(|(_, readings)| readings.weight));
    }

    /// A number that has no baseline, of variance 1.
    pub fn add_plain(&mut self, slope: &DVector<f64>, residual: f64) {
        self.square += residual * residual;
        self.vector.axpy(residual, slope, 1.0);
        self.matrix.ger(1.0, slope, slope, 1.0);
    }

    /// Cost and quadratic of the params alone.
    pub fn eliminated(&self) -> (f64, Quadratic) {
        let (mut cost, mut matrix, mut slope) = (self.square, self.matrix.clone(), self.vector.clone());
        let known: Vec<&Sums> = self.monitors.iter().filter(|sums| sums.weight > 0.0).collect();
        for sums in &known {
            cost -= sums.residual * sums.residual / sums.weight;
            slope.axpy(-sums.residual / sums.weight, &sums.slope, 1.0);
        }
        let mut slopes = DMatrix::zeros(slope.len(), known.len());
        slopes.column_iter_mut().zip(&known).for_each(|(mut to, sums)| to.copy_from(&sums.slope));
        add_squares(&mut matrix, &slopes, known.iter().map(|sums| -1.0 / sums.weight));
        (cost, Quadratic { matrix, slope })
    }

    /// Baseline of a monitor after a step of the params [m]; none without readings.
    pub fn baseline(&self, b: usize, step: &DVector<f64>) -> Option<f64> {
        let sums = &self.monitors[b];
        (sums.weight > 0.0).then(|| (sums.residual - sums.slope.dot(step)) / sums.weight)
    }

    /// What is expected of a residual after a step, and the variance of that, given the factor of the params' precision: the baseline's, and
    /// the params' `d M^-1 d` only if it is asked for.
    pub fn expect<'n>(
        &'n self,
        b: usize,
        slope: DVectorView<f64>,
        step: &DVector<f64>,
        factor: &'n Cholesky<f64, Dyn>,
    ) -> (f64, f64, impl FnOnce() -> f64 + 'n) {
        let sums = &self.monitors[b];
        let d = slope - &sums.slope / sums.weight;
        let expected = sums.residual / sums.weight + d.dot(step);
        let of_params = move || factor.l_dirty().solve_lower_triangular(&d).map_or(f64::INFINITY, |z| z.norm_squared());
        (expected, 1.0 / sums.weight, of_params)
    }
}

/// Add the sum of weight times `h h^T` over columns.
fn add_squares(matrix: &mut DMatrix<f64>, columns: &DMatrix<f64>, weights: impl Iterator<Item = f64>) {
    let mut weighted = columns.clone();
    weighted.column_iter_mut().zip(weights).for_each(|(mut column, weight)| column *= weight);
    matrix.gemm(1.0, &weighted, &columns.transpose(), 1.0);
}
