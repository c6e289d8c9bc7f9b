//! Log-density of the params given a campaign, with its gradient: the twin or a surrogate, every frame or the paper's pairs, with
//! measured tunes or without.
//!
//! `ln p(theta) = -chi2(theta)/2 + ln prior(theta)`, `theta = ln var` within its range, up to a constant. A sampler sees it in
//! coordinates u without bounds ([`crate::Bounded`]), whitened by the Laplace covariance: `u = u_MAP + L z`, `L L^T` the covariance of u,
//! with the Jacobian of the first map in the density.

use nalgebra::{DMatrix, DVector};
use serde::Serialize;
use twin::OrbitError;

use crate::bounds::{Bounded, Coordinates};
use crate::model::ResponseModel;
use crate::optimise::{End, Limits, Objective, OptimiseError, Quadratic, minimise};
use crate::prior::Prior;
use crate::readings::Readings;

/// The posterior of one campaign under one model.
#[derive(Debug, Clone)]
pub struct Posterior {
    /// What predicts.
    pub model: ResponseModel,
    /// What was read.
    pub readings: Readings,
    /// Prior of every param.
    pub prior: Prior,
    /// The params without bounds.
    pub coordinates: Coordinates,
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
    /// No stable ring where the search begins.
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
        /// Length of the last step, in standard deviations.
        moved: f64,
    },
}

impl From<OptimiseError<OrbitError>> for LaplaceError {
    fn from(error: OptimiseError<OrbitError>) -> Self {
        match error {
            OptimiseError::Start(error) => Self::Orbit(error),
            OptimiseError::Degenerate => Self::Degenerate,
        }
    }
}

const LIMITS: Limits = Limits { settled: 1e-8, steps: 40, halvings: 10 };
/// Squared length of the last step, in standard deviations, that is small beside the width: for readings that no ring explains,
/// whose steps are small.
const CLOSE: f64 = 0.05 * 0.05;

impl Posterior {
    /// Of readings under a model.
    pub fn new(model: ResponseModel, readings: Readings, prior: Prior) -> Self {
        Self { model, readings, coordinates: Coordinates::from_prior(&prior), prior }
    }

    /// Number of params.
    pub fn dimension(&self) -> usize {
        self.prior.len()
    }

    /// Log-density of `theta` and its gradient, bounds left out.
    ///
    /// # Errors
    /// [`OrbitError`] where there is no stable ring.
    pub fn of_params(&self, params: &[f64]) -> Result<(f64, Vec<f64>), OrbitError> {
        let strength = self.readings.strength(params);
        let (chi_square, gradient) =
            self.model.differentiate(&strength, |prediction| self.readings.chi_square(prediction))?;
        let params = DVector::from_column_slice(params);
        let pull = (&params - &self.prior.mean).component_mul(&self.prior.precision);
        let slope = -0.5 * DVector::from_vec(self.readings.gather(&gradient)) - pull;
        Ok((-0.5 * (chi_square + self.prior.cost(&params)), slope.as_slice().to_vec()))
    }

    /// Log-density in the coordinates without bounds, and its gradient.
    ///
    /// # Errors
    /// [`OrbitError`] where there is no stable ring.
    pub fn of_unbounded(&self, u: &[f64]) -> Result<(f64, Vec<f64>), OrbitError> {
        let (mut value, mut gradient) = self.of_params(&self.coordinates.params(u))?;
        for (slope, bound) in gradient.iter_mut().zip(self.bounded(u)) {
            value += bound.slope.ln();
            *slope = *slope * bound.slope + bound.log_slope_slope;
        }
        Ok((value, gradient))
    }

    /// The best point in `u` from `params`, and the curvature there.
    ///
    /// # Errors
    /// [`LaplaceError`].
    pub fn laplace(&self, params: &[f64]) -> Result<Laplace, LaplaceError> {
        let start = self.coordinates.unbounded(params);
        let free = vec![[f64::NEG_INFINITY, f64::INFINITY]; start.len()];
        let found = minimise(self, &start, &free, &LIMITS, |_, _| true)?;
        if found.end != End::Settled && found.expected > CLOSE {
            return Err(LaplaceError::NotConverged { steps: found.steps, moved: found.expected.sqrt() });
        }
        let covariance = found.quadratic.factor().ok_or(LaplaceError::Degenerate)?.inverse();
        let factor = covariance.cholesky().ok_or(LaplaceError::Degenerate)?.unpack();
        Ok(Laplace { centre: found.x, factor })
    }

    fn bounded<'u>(&'u self, u: &'u [f64]) -> impl Iterator<Item = Bounded> + 'u {
        self.coordinates.each().iter().zip(u).map(|(one, u)| one.at(*u))
    }

    /// Minus the second derivative of the log-density in `u`, that of the response left out (Gauss-Newton).
    fn curvature(&self, u: &[f64]) -> Result<DMatrix<f64>, OrbitError> {
        let params = self.coordinates.params(u);
        let mut curvature = self.readings.curvature(&self.model, &params)?;
        let (_, slope) = self.of_params(&params)?;
        let bounds: Vec<Bounded> = self.bounded(u).collect();
        for i in 0..u.len() {
            // without a width, that of the range: a direction that nothing measures is not infinitely wide
            let precision = self.prior.precision[i];
            curvature[(i, i)] += if precision > 0.0 { precision } else { self.prior.precision_of_range(i) };
        }
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

/// Minus twice the log-density in the coordinates without bounds.
impl Objective for Posterior {
    /// Its gradient, times -1/2.
    type Point = DVector<f64>;
    type Slopes = ();
    type Error = OrbitError;

    fn evaluate(&self, u: &DVector<f64>) -> Result<(f64, DVector<f64>), OrbitError> {
        let (value, gradient) = self.of_unbounded(u.as_slice())?;
        Ok((-2.0 * value, DVector::from_vec(gradient)))
    }

    fn linearise(&self, u: &DVector<f64>, gradient: &DVector<f64>) -> Result<(Quadratic, ()), OrbitError> {
        Ok((Quadratic { matrix: self.curvature(u.as_slice())?, slope: gradient.clone() }, ()))
    }
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
}
