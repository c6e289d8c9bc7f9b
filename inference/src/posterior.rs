//! Log-density of the params given a recording, with its gradient: the twin or a surrogate, every frame or the paper's pairs.
//!
//! `ln p(theta) = -chi2(theta)/2 + ln prior(theta)`, `theta = ln var` within `ln 0.94 .. ln 1.06`, up to a constant. A
//! sampler sees it in coordinates without bounds, whitened by the Laplace covariance:
//!
//! `theta = lower + t softplus((u - lower)/t) - t softplus((u - upper)/t)`, `u = u_MAP + L z`, `L L^T` the covariance of u,
//!
//! with the Jacobian of the first map in the density. Where a bound is more than a few `t` away, `u` is `theta` itself, so
//! that a posterior that is normal in theta is normal in u. A logistic map of the whole range bends everywhere: on a var at
//! 0.958 it cost half of the effective draws.

use nalgebra::{DMatrix, DVector};
use serde::Serialize;
use twin::OrbitError;

use crate::model::ResponseModel;
use crate::readings::Readings;

/// Prior of every var.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Width {
    /// Lognormal, before it ends at the range's bounds of mean exactly 1 and this standard deviation: `ln var` is normal with
    /// variance `ln(1 + w^2)` and mean minus half of it.
    Lognormal(f64),
    /// Flat in `ln var`: the limit of a lognormal of median 1 that grows wide.
    Loguniform,
}

/// The range of every var, the paper's.
pub const RANGE: [f64; 2] = [0.94, 1.06];

/// The posterior of one recording under one model.
#[derive(Debug, Clone)]
pub struct Posterior {
    /// What predicts.
    pub model: ResponseModel,
    /// What was read.
    pub readings: Readings,
    /// Prior of every var.
    pub width: Width,
}

/// The Gaussian at the best point, in the coordinates without bounds.
#[derive(Debug, Clone, Serialize)]
pub struct Laplace {
    /// Best point in `u`.
    pub centre: DVector<f64>,
    /// Lower Cholesky factor of the covariance of `u`.
    pub factor: DMatrix<f64>,
}

/// Why the posterior has no Laplace approximation.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LaplaceError {
    /// No stable ring on the way.
    #[error(transparent)]
    Orbit(#[from] OrbitError),
    /// The curvature is not positive.
    #[error("the curvature of the log-density is not positive")]
    Degenerate,
    /// The steps did not settle.
    #[error("no maximum after {steps} steps; the last one moved by {moved:.2e} standard deviations")]
    NotConverged {
        /// Steps taken.
        steps: usize,
        /// Largest move of the last step.
        moved: f64,
    },
}

/// Largest move of a param, in standard deviations, at which the steps have settled.
const SETTLED: f64 = 1e-4;
/// The same after the last step, for readings that no ring explains: their steps creep, and what is left of the way is small
/// beside the width.
const CLOSE: f64 = 0.05;
const STEPS: usize = 40;
const HALVINGS: i32 = 10;

impl Width {
    /// Mean and precision of theta; both 0 where the density of theta is flat.
    pub fn normal(self) -> (f64, f64) {
        match self {
            Self::Lognormal(width) => {
                let variance = width.powi(2).ln_1p();
                (-0.5 * variance, 1.0 / variance)
            }
            Self::Loguniform => (0.0, 0.0),
        }
    }
}

impl Posterior {
    /// Number of params.
    pub fn dimension(&self) -> usize {
        self.readings.supplies().len()
    }

    /// Log-density of `theta` and its gradient, bounds left out.
    ///
    /// # Errors
    /// [`OrbitError`] where there is no stable ring.
    pub fn of_params(&self, params: &[f64]) -> Result<(f64, Vec<f64>), OrbitError> {
        let strength: Vec<f64> = params.iter().zip(self.readings.supplies()).map(|(theta, s)| theta + s).collect();
        let (chi_square, mut gradient) =
            self.model.differentiate(&strength, |response| self.readings.chi_square(response))?;
        let (mean, precision) = self.width.normal();
        let mut value = -0.5 * chi_square;
        for (slope, theta) in gradient.iter_mut().zip(params) {
            let away = theta - mean;
            value -= 0.5 * precision * away * away;
            *slope = -0.5 * *slope - precision * away;
        }
        Ok((value, gradient))
    }

    /// Log-density in the coordinates without bounds, and its gradient.
    ///
    /// # Errors
    /// [`OrbitError`] where there is no stable ring.
    pub fn of_unbounded(&self, u: &[f64]) -> Result<(f64, Vec<f64>), OrbitError> {
        let (mut value, mut gradient) = self.of_params(&params_of(u))?;
        for (slope, u) in gradient.iter_mut().zip(u) {
            let bound = Bounded::at(*u);
            value += bound.slope.ln();
            *slope = *slope * bound.slope + bound.log_slope_slope;
        }
        Ok((value, gradient))
    }

    /// The best point in `u` by damped Gauss-Newton steps from `params`, and the curvature there.
    ///
    /// # Errors
    /// [`LaplaceError`].
    pub fn laplace(&self, params: &[f64]) -> Result<Laplace, LaplaceError> {
        let mut u = unbounded_of(params);
        let (mut value, mut gradient) = self.of_unbounded(u.as_slice())?;
        let mut moved = f64::INFINITY;
        for taken in 0..=STEPS {
            let covariance = self.curvature(&u)?.cholesky().ok_or(LaplaceError::Degenerate)?.inverse();
            let full = &covariance * DVector::from_column_slice(&gradient);
            moved = (0..full.len()).map(|i| full[i].abs() / covariance[(i, i)].sqrt()).fold(0.0, f64::max);
            if moved < if taken < STEPS { SETTLED } else { CLOSE } {
                let factor = covariance.cholesky().ok_or(LaplaceError::Degenerate)?.unpack();
                return Ok(Laplace { centre: u, factor });
            }
            // half the way as long as it leads downhill or to an unstable ring
            let uphill = (0..HALVINGS).map(|k| &full * 0.5_f64.powi(k)).find_map(|step| {
                let (next, slope) = self.of_unbounded((&u + &step).as_slice()).ok()?;
                (next >= value - 1e-9 * value.abs()).then_some((step, next, slope))
            });
            let Some((step, next, slope)) = uphill else { break };
            (value, gradient) = (next, slope);
            u += &step;
        }
        Err(LaplaceError::NotConverged { steps: STEPS, moved })
    }

    /// Minus the second derivative of the log-density in `u`, that of the response left out (Gauss-Newton).
    fn curvature(&self, u: &DVector<f64>) -> Result<DMatrix<f64>, OrbitError> {
        let params = params_of(u.as_slice());
        let strength: Vec<f64> = params.iter().zip(self.readings.supplies()).map(|(theta, s)| theta + s).collect();
        let mut curvature = self.readings.curvature(&self.model.jacobian(&strength)?);
        // without a width, that of a flat density over the range: a direction that nothing measures is not infinitely wide
        let flat = 12.0 / (RANGE[1] / RANGE[0]).ln().powi(2);
        let precision = if self.width == Width::Loguniform { flat } else { self.width.normal().1 };
        let (_, slope) = self.of_params(&params)?;
        (0..u.len()).for_each(|i| curvature[(i, i)] += precision);
        let bounds: Vec<Bounded> = u.iter().map(|u| Bounded::at(*u)).collect();
        for i in 0..u.len() {
            for j in 0..u.len() {
                curvature[(i, j)] *= bounds[i].slope * bounds[j].slope;
            }
            // of the map itself: positive in the middle; towards a bound the density may turn either way
            let bend = bounds[i].log_curvature - slope[i] * bounds[i].bend;
            curvature[(i, i)] += bend.max(0.0);
        }
        Ok(curvature)
    }
}

/// One param as a function of its coordinate without bounds.
pub struct Bounded {
    /// `d theta/du`.
    pub slope: f64,
    /// `d2 theta/du2`.
    pub bend: f64,
    /// `d ln(slope)/du`.
    pub log_slope_slope: f64,
    /// `-d2 ln(slope)/du2`.
    pub log_curvature: f64,
}

/// Distance from a bound within which the map bends [ln var].
pub const BEND: f64 = 0.003;

impl Bounded {
    /// `slope = s_l (1 - s_u) (1 - e^(-(upper - lower)/t))`, `s` the logistic functions of the distances from both bounds.
    pub fn at(u: f64) -> Self {
        let [lower, upper] = bounds();
        let [above_lower, above_upper] = [logistic((u - lower) / BEND), logistic((u - upper) / BEND)];
        let [below_lower, below_upper] = [logistic((lower - u) / BEND), logistic((upper - u) / BEND)];
        let log_slope_slope = (below_lower - above_upper) / BEND;
        let slope = above_lower * below_upper * -(-(upper - lower) / BEND).exp_m1();
        Self {
            slope,
            bend: slope * log_slope_slope,
            log_slope_slope,
            log_curvature: (above_lower * below_lower + above_upper * below_upper) / (BEND * BEND),
        }
    }
}

fn bounds() -> [f64; 2] {
    RANGE.map(f64::ln)
}

fn logistic(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// `ln(1 + e^x)`.
pub fn softplus(x: f64) -> f64 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

/// Params of coordinates without bounds.
pub fn params_of(u: &[f64]) -> Vec<f64> {
    let [lower, upper] = bounds();
    u.iter().map(|u| lower + BEND * (softplus((u - lower) / BEND) - softplus((u - upper) / BEND))).collect()
}

/// Coordinates without bounds of params; a param at a bound is taken a thousandth of the range inside.
pub fn unbounded_of(params: &[f64]) -> DVector<f64> {
    let [lower, upper] = bounds();
    let room = 1e-3 * (upper - lower);
    let one = |theta: &f64| {
        let theta = theta.clamp(lower + room, upper - room);
        // of `e = (1 + a)/(1 + a q)` for `a`, `e` and `q` the exponentials of the distances from lower of theta and upper
        let e = ((theta - lower) / BEND).exp_m1();
        lower + BEND * (e / -((theta - upper) / BEND).exp_m1()).ln()
    };
    DVector::from_iterator(params.len(), params.iter().map(one))
}

impl Laplace {
    /// Coordinates without bounds of whitened ones.
    pub fn unbounded(&self, z: &[f64]) -> DVector<f64> {
        &self.centre + &self.factor * DVector::from_column_slice(z)
    }

    /// The gradient in whitened coordinates.
    pub fn whiten(&self, gradient: &[f64]) -> DVector<f64> {
        self.factor.tr_mul(&DVector::from_column_slice(gradient))
    }

    /// Mean and standard deviation of each var.
    ///
    /// The coordinate without bounds is normal; its map to the var is integrated over +-8 standard deviations.
    pub fn moments(&self) -> (Vec<f64>, Vec<f64>) {
        const POINTS: i32 = 400;
        let one = |i: usize| {
            let (centre, sigma) = (self.centre[i], self.factor.row(i).norm());
            let (mut weight, mut first, mut second) = (0.0, 0.0, 0.0);
            for k in -POINTS..=POINTS {
                let z = 8.0 * f64::from(k) / f64::from(POINTS);
                let (w, var) = ((-0.5 * z * z).exp(), params_of(&[centre + sigma * z])[0].exp());
                (weight, first, second) = (weight + w, first + w * var, second + w * var * var);
            }
            let mean = first / weight;
            (mean, (second / weight - mean * mean).max(0.0).sqrt())
        };
        (0..self.centre.len()).map(one).unzip()
    }

    /// Covariance of the coordinates without bounds.
    pub fn covariance(&self) -> DMatrix<f64> {
        &self.factor * self.factor.transpose()
    }

    /// Squared Mahalanobis distance of params.
    pub fn distance(&self, params: &[f64]) -> f64 {
        let away = unbounded_of(params) - &self.centre;
        self.factor.solve_lower_triangular(&away).map_or(f64::INFINITY, |z| z.norm_squared())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coordinates_without_bounds_are_those_of_the_params() {
        let params = [-0.0605, -0.05, -0.01, 0.0, 0.03, 0.055];
        let u = unbounded_of(&params);
        for (i, (theta, back)) in params.iter().zip(params_of(u.as_slice())).enumerate() {
            assert!((theta - back).abs() < 1e-14);
            let (h, bound) = (1e-7, Bounded::at(u[i]));
            let (above, below) = (Bounded::at(u[i] + h), Bounded::at(u[i] - h));
            let (up, down) = (params_of(&[u[i] + h])[0], params_of(&[u[i] - h])[0]);
            assert!(((up - down) / (2.0 * h) / bound.slope - 1.0).abs() < 1e-7);
            assert!(((above.slope - below.slope) / (2.0 * h) - bound.bend).abs() < 1e-6 / BEND);
            assert!(((above.slope.ln() - below.slope.ln()) / (2.0 * h) - bound.log_slope_slope).abs() < 1e-6 / BEND);
            let curvature = -(above.log_slope_slope - below.log_slope_slope) / (2.0 * h);
            assert!((curvature - bound.log_curvature).abs() < 1e-6 / (BEND * BEND));
        }
    }

    /// The lognormal's mean is 1 for any width: integrated over ln var.
    #[test]
    fn the_prior_has_mean_one() {
        for width in [0.01, 0.03, 0.3] {
            let (mean, precision) = Width::Lognormal(width).normal();
            assert!(((mean + 0.5 / precision).exp() - 1.0).abs() < 1e-15);
            // and the width that it says: exp(variance) - 1 = width^2
            assert!((((1.0 / precision).exp() - 1.0).sqrt() / width - 1.0).abs() < 1e-12);
        }
    }
}
