//! What the data say of one unknown that its prior holds, if it did not.
//!
//! Where unknown `i` goes `t` further the others follow by `t C_ji/C_ii`, and residuals become `r - t f` with `f = J C_i/C_ii`. The most probable
//! `t` is found by reweighted least squares, from where the prior holds it and from all weights equal: a row whose gain is a quarter off looks like
//! errors with heavy tails, which weigh little. Of the two ends the more probable one counts.

use nalgebra::{DMatrix, DVector};

use crate::data::Data;
use crate::model::Prediction;
use crate::noise::Noise;
use crate::normal::Places;
use crate::unknowns::Unknown;

/// Steps of reweighted least squares.
const STEPS: usize = 30;

/// A fit with priors that hold.
pub struct Held<'f> {
    unknowns: &'f [Unknown],
    values: &'f DVector<f64>,
    at: &'f Prediction,
    data: &'f Data,
    noise: &'f Noise,
    covariance: &'f DMatrix<f64>,
    places: Places,
    residual: DMatrix<f64>,
    /// What all unknowns would go further together if all elements weighed as errors of the learnt size.
    by_equal_weights: DVector<f64>,
}

/// One unknown without its prior.
pub struct Released {
    /// Its value, everything else following.
    pub value: f64,
    /// Standard deviation by the data alone.
    pub sigma: f64,
}

impl<'f> Held<'f> {
    /// A fit: its unknowns with the priors that hold, their values and what these predict, the data and what the model misses of them, and the
    /// covariance with independent errors.
    pub fn of(
        (unknowns, values, at): (&'f [Unknown], &'f DVector<f64>, &'f Prediction),
        (data, noise): (&'f Data, &'f Noise),
        covariance: &'f DMatrix<f64>,
    ) -> Self {
        let places = Places::of(unknowns, at.matrix.nrows(), at.matrix.ncols());
        let residual = data.residual(at);
        let weighted = data.precision(noise).component_mul(&residual);
        let mut slope = places.back(at, &weighted);
        for ((slope, unknown), value) in slope.iter_mut().zip(unknowns).zip(values) {
            *slope += (unknown.mean - value) / unknown.width.powi(2);
        }
        Self { unknowns, values, at, data, noise, covariance, places, residual, by_equal_weights: covariance * slope }
    }

    /// The same as [`Self::released`] to first order, with the weights of the fit or with equal ones, whichever goes further from a value: for a
    /// choice of those that are worth the other.
    pub fn about(&self, one: usize, from: f64) -> Released {
        let left = (1.0 - self.covariance[(one, one)] / self.unknowns[one].width.powi(2)).max(f64::EPSILON);
        let held = self.values[one] - from;
        let further = held.abs().max((held + self.by_equal_weights[one]).abs());
        Released { value: from + further / left, sigma: self.sigma(one) }
    }

    /// One unknown with a prior of another width; errors that are alike along rows and columns widen its standard deviation.
    pub fn released(&self, one: usize, width: f64) -> Released {
        let variance = self.covariance[(one, one)];
        let follow = self.covariance.column(one) / variance;
        let along = self.places.forward(self.at, &follow);
        // slope and curvature of the priors, with the other width of its own
        let (mut prior, mut stiff) = (0.0, 0.0);
        for (at, unknown) in self.unknowns.iter().enumerate() {
            let width = if at == one { width } else { unknown.width };
            prior += follow[at] * (unknown.mean - self.values[at]) / width.powi(2);
            stiff += (follow[at] / width).powi(2);
        }
        let left = |by: f64| &self.residual - &along * by;
        let step = |weight: &DMatrix<f64>| {
            let weighted = weight.component_mul(&along);
            (weighted.dot(&self.residual) + prior) / (weighted.dot(&along) + stiff)
        };
        let further = |start: f64| {
            let by = (0..STEPS).fold(start, |by, _| step(&self.data.weight(self.noise, &left(by))));
            (by, self.data.log_likelihood(self.noise, &left(by)) + by * prior - 0.5 * by * by * stiff)
        };
        let [held, equal] = [0.0, step(&self.data.precision(self.noise))].map(further);
        let by = if equal.1 > held.1 { equal.0 } else { held.0 };

        let left = left(by);
        let said = self.data.weight(self.noise, &left).component_mul(&left).component_mul(&along);
        let lines = said.column_sum().norm_squared() + said.row_sum().norm_squared() - said.norm_squared();
        let widening = (lines * variance).max(1.0);
        Released { value: self.values[one] + by, sigma: self.sigma(one) * widening.sqrt() }
    }

    /// Standard deviation by the data alone, errors independent: of a variance `v` with a prior `w` it is `1/sqrt(1/v - 1/w^2)`.
    fn sigma(&self, one: usize) -> f64 {
        (self.covariance[(one, one)].recip() - self.unknowns[one].width.powi(-2)).max(f64::EPSILON).sqrt().recip()
    }
}
