//! A fit, prepared to score patterns that it lacks, all unknowns adapting to first order.

use nalgebra::{DMatrix, DVector};

use crate::error::MeasuredError;
use crate::model::Prediction;
use crate::normal::{Places, covariance};
use crate::unknowns::Unknown;

/// A fit, prepared to score further patterns.
pub struct About {
    places: Places,
    prediction: Prediction,
    covariance: DMatrix<f64>,
    /// Slope of `ln` likelihood by each predicted element [1/mm].
    slope: DMatrix<f64>,
    /// What each element says [1/mm^2].
    information: DMatrix<f64>,
    /// Step of the unknowns that the slope asks for; 0 at the best fit.
    step: DVector<f64>,
}

impl About {
    /// About a prediction, with the slope of `ln` likelihood by each element and what each says.
    ///
    /// # Errors
    /// [`MeasuredError::Singular`].
    pub fn of(
        unknowns: &[Unknown],
        prediction: Prediction,
        slope: DMatrix<f64>,
        information: DMatrix<f64>,
    ) -> Result<Self, MeasuredError> {
        let places = Places::of(unknowns, slope.nrows(), slope.ncols());
        let covariance = covariance(unknowns, &prediction, &information)?;
        let step = &covariance * places.back(&prediction, &slope, unknowns.len());
        Ok(Self { places, prediction, covariance, slope, information, step })
    }

    /// `d P r` and `d P d` of a pattern [mm].
    pub fn score(&self, pattern: &DMatrix<f64>) -> (f64, f64) {
        let weighted = pattern.component_mul(&self.information);
        let across = self.places.back(&self.prediction, &weighted, self.covariance.nrows());
        let own = weighted.dot(pattern);
        (pattern.dot(&self.slope) - across.dot(&self.step), own - across.dot(&(&self.covariance * &across)))
    }

    /// What the unknowns cannot follow of a pattern, `P d` [mm].
    pub fn projected(&self, pattern: &DMatrix<f64>) -> DMatrix<f64> {
        let across =
            self.places.back(&self.prediction, &pattern.component_mul(&self.information), self.covariance.nrows());
        pattern - self.places.forward(&self.prediction, &(&self.covariance * across))
    }

    /// Rms amplitude that the residuals give patterns which are not there.
    pub fn of_patterns(&self, patterns: &[DMatrix<f64>]) -> f64 {
        let squares = patterns.iter().map(|pattern| self.score(pattern)).map(|(pull, power)| (pull / power).powi(2));
        (squares.sum::<f64>() / patterns.len() as f64).sqrt()
    }
}
