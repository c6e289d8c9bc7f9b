//! Normal equations of the params with an unknown baseline for each monitor.
//!
//! Readings obey `residual = h step + baseline_b + noise`. Sums of weight times `1, h, residual` of each monitor are kept apart, so
//! that readings can be added and taken away one by one; the baselines at their best leave the Schur complement.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

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

    /// A reading of a monitor: its derivative, measured minus predicted, one over its variance.
    pub fn add(&mut self, b: usize, slope: nalgebra::DVectorView<f64>, residual: f64, weight: f64) {
        self.add_plain(slope, residual, weight);
        let sums = &mut self.monitors[b];
        sums.weight += weight;
        sums.residual += weight * residual;
        sums.slope.axpy(weight, &slope, 1.0);
    }

    /// A number that has no baseline.
    pub fn add_plain(&mut self, slope: nalgebra::DVectorView<f64>, residual: f64, weight: f64) {
        self.square += weight * residual * residual;
        self.vector.axpy(weight * residual, &slope, 1.0);
        self.matrix.ger(weight, &slope, &slope, 1.0);
    }

    /// Cost and quadratic of the params alone.
    pub fn eliminated(&self) -> (f64, Quadratic) {
        let (mut cost, mut matrix, mut slope) = (self.square, self.matrix.clone(), self.vector.clone());
        for sums in self.monitors.iter().filter(|sums| sums.weight > 0.0) {
            cost -= sums.residual * sums.residual / sums.weight;
            matrix.ger(-1.0 / sums.weight, &sums.slope, &sums.slope, 1.0);
            slope.axpy(-sums.residual / sums.weight, &sums.slope, 1.0);
        }
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
        slope: nalgebra::DVectorView<f64>,
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
