//! Normal equations of the params with unknown common terms of each monitor's readings.
//!
//! Readings obey `residual = h step + terms + noise`. Sums over the readings of each monitor are kept apart ([`Common`]); the terms at
//! their best leave the Schur complement.

use nalgebra::{DMatrix, DVector, DVectorView};

use super::common_terms::{Common, Eliminated, Weighed};
use crate::optimise::Quadratic;
use crate::prior::Prior;
use evidence::Factor;

/// Sums over readings, and the prior, about some params.
#[derive(Debug, Clone)]
pub(crate) struct Normal {
    matrix: DMatrix<f64>,
    /// Without the monitors.
    vector: DVector<f64>,
    square: f64,
    monitors: Vec<Common>,
    baselines: usize,
}

/// What readings of a monitor have in common.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Terms {
    /// How many terms.
    pub count: usize,
    /// How many of them, from the first on, are baselines: one for each time in the cycle.
    pub baselines: usize,
    /// Precision to which each baseline is known to be 0, 0 for not at all.
    pub precision: f64,
}

impl Normal {
    /// The prior alone about params; the readings of each monitor have these terms in common.
    pub fn new(prior: &Prior, params: &DVector<f64>, monitors: usize, terms: Terms) -> Self {
        let Terms { count, baselines, precision } = terms;
        Self {
            matrix: DMatrix::from_diagonal(&prior.precision),
            vector: (&prior.mean - params).component_mul(&prior.precision),
            square: prior.cost(params),
            monitors: vec![Common::new(params.len(), count, baselines, precision); monitors],
            baselines,
        }
    }

    /// Readings, those that share a derivative together: their derivatives as columns, and of each the monitor and the sums.
    pub fn add(&mut self, slopes: &DMatrix<f64>, readings: &[(usize, Weighed)]) {
        for (slope, (b, readings)) in slopes.column_iter().zip(readings) {
            self.monitors[*b].add(&slope, readings);
        }
        let mut weighted = slopes.clone();
        weighted
            .column_iter_mut()
            .zip(readings)
            .for_each(|(mut column, (_, readings))| column *= readings.weight(self.baselines));
        self.matrix.gemm(1.0, &weighted, &slopes.transpose(), 1.0);
    }

    /// A number that has no terms, of variance 1.
    pub fn add_plain(&mut self, slope: &DVector<f64>, residual: f64) {
        self.square += residual * residual;
        self.vector.axpy(residual, slope, 1.0);
        self.matrix.ger(1.0, slope, slope, 1.0);
    }

    /// Cost and quadratic of the params alone.
    pub fn eliminated(&self) -> (f64, Quadratic) {
        let (mut cost, mut matrix, mut slope) = (self.square, self.matrix.clone(), self.vector.clone());
        let known: Vec<Eliminated> = self.monitors.iter().map(Common::eliminated).collect();
        let mut taken = DMatrix::zeros(slope.len(), known.iter().map(|known| known.columns.ncols()).sum());
        let mut at = 0;
        for Eliminated { columns, moment, square } in &known {
            cost += square;
            slope += moment;
            taken.columns_mut(at, columns.ncols()).copy_from(columns);
            at += columns.ncols();
        }
        matrix.gemm(-1.0, &taken, &taken.transpose(), 1.0);
        (cost, Quadratic { matrix, slope })
    }

    /// Baselines of the monitors after a step of the params, for each time in the cycle [m]; none without readings.
    pub fn baselines(&self, step: &DVector<f64>) -> Vec<Option<f64>> {
        let of_monitors: Vec<Vec<Option<f64>>> = self.monitors.iter().map(|one| one.best_baselines(step)).collect();
        (0..self.baselines).flat_map(|time| of_monitors.iter().map(move |baselines| baselines[time])).collect()
    }

    /// What is expected of a residual with these terms after a step, and the variance of that, given the factor of the params' precision:
    /// the terms', and the params' `d M^-1 d` only if it is asked for. None of a monitor of which nothing is known.
    pub fn expect<'n>(
        &'n self,
        b: usize,
        slope: DVectorView<f64>,
        terms: &[f64],
        step: &DVector<f64>,
        factor: &'n Factor,
    ) -> Option<(f64, f64, impl FnOnce() -> f64 + 'n)> {
        let (solved, along) = self.monitors[b].seen_by(terms)?;
        let best = self.monitors[b].best(step)?;
        let terms = DVector::from_column_slice(terms);
        let (expected, variance, d) = (slope.dot(step) + terms.dot(&best), terms.dot(&solved), slope - along);
        let of_params = move || factor.whiten(&d).norm_squared();
        Some((expected, variance, of_params))
    }
}
