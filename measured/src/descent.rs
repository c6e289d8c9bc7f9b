//! The most probable values of the unknowns for elements that count what they count: damped Gauss-Newton. The slope is made at each point; the curvature, most of
//! the work, serves as long as steps gain what it promises.

use nalgebra::{DMatrix, DVector};

use crate::arrow::Arrow;
use crate::data::residual;
use crate::error::MeasuredError;
use crate::model::{Model, Prediction};
use crate::normal::{Places, in_widths, times};
use crate::unknowns::Unknown;

/// Steps of one descent; those of measured rings take 5 to 60.
const STEPS: usize = 100;
/// A descent has ended when the best step promises less than this, or a share of its sum of squares.
const ENOUGH: f64 = 1e-3;
/// That share of a descent whose values are told.
pub const EXACT: f64 = 1e-7;
/// That of one whose elements are weighed anew.
pub const ROUGH: f64 = 1e-5;
/// A step may gain this share more or less than promised before the curvature is made anew: what is left falls by four with each.
const AS_PROMISED: f64 = 0.25;
/// Damping of the first step, and that at which no step helps.
const DAMPING: f64 = 1e-3;
const STUCK: f64 = 1e9;

/// Where a descent ended.
pub struct Descent {
    /// Most probable values.
    pub values: DVector<f64>,
    /// Their covariance as the elements count.
    pub covariance: DMatrix<f64>,
    /// What they predict.
    pub prediction: Prediction,
    /// Steps taken.
    pub steps: usize,
    /// False where the steps were used up before.
    pub has_ended: bool,
}

/// What is descended: elements with their weights, and unknowns with their priors.
struct Hill<'h> {
    model: &'h Model,
    unknowns: &'h [Unknown],
    measured: &'h DMatrix<f64>,
    weight: &'h DMatrix<f64>,
    places: Places,
    width: DVector<f64>,
    mean: DVector<f64>,
}

/// A point of it.
struct Point {
    values: DVector<f64>,
    prediction: Prediction,
    /// Sum of squares of elements and priors.
    height: f64,
}

/// Damped Gauss-Newton, until a step promises less than a share of the sum of squares.
///
/// # Errors
/// [`MeasuredError`].
pub fn descend(
    model: &Model,
    unknowns: &[Unknown],
    measured: &DMatrix<f64>,
    weight: &DMatrix<f64>,
    (values, share): (DVector<f64>, f64),
) -> Result<Descent, MeasuredError> {
    let each = |of: fn(&Unknown) -> f64| DVector::from_iterator(unknowns.len(), unknowns.iter().map(of));
    let places = Places::of(unknowns, measured.nrows(), measured.ncols());
    let apart = places.apart();
    let hill =
        Hill { model, unknowns, measured, weight, places, width: each(|one| one.width), mean: each(|one| one.mean) };
    let mut here = hill.point(values)?;
    let (mut damping, mut step) = (DAMPING, 0);
    let (mut curvature, mut factor) = hill.curvature(&here, &apart).ok_or(MeasuredError::Singular(step))?;
    loop {
        let slope = hill.slope(&here);
        let has_ended = slope.dot(&factor.solve(&slope)) < ENOUGH.max(share * here.height);
        let further = (!has_ended && step < STEPS)
            .then(|| hill.further(&here, (&curvature, &slope, &apart), &mut damping))
            .flatten();
        let Some((there, promised)) = further else {
            let covariance = times(factor.inverse(), &hill.width);
            let Point { values, prediction, .. } = here;
            return Ok(Descent { values, covariance, prediction, steps: step, has_ended });
        };
        let is_as_promised = ((here.height - there.height) / promised - 1.0).abs() < AS_PROMISED;
        (here, step) = (there, step + 1);
        if !is_as_promised {
            (curvature, factor) = hill.curvature(&here, &apart).ok_or(MeasuredError::Singular(step))?;
        }
    }
}

impl Hill<'_> {
    fn point(&self, values: DVector<f64>) -> Result<Point, MeasuredError> {
        let prediction = self.model.predict(self.unknowns, &values)?;
        let left = residual(self.measured, &prediction, self.weight);
        let height = left.component_mul(&left).dot(self.weight) + self.off(&values).norm_squared();
        Ok(Point { values, prediction, height })
    }

    /// Distance from the means, in widths.
    fn off(&self, values: &DVector<f64>) -> DVector<f64> {
        (values - &self.mean).component_div(&self.width)
    }

    /// Half the slope downhill, in widths.
    fn slope(&self, here: &Point) -> DVector<f64> {
        let weighted = residual(self.measured, &here.prediction, self.weight).component_mul(self.weight);
        let back = self.places.back(&here.prediction, &weighted);
        back.component_mul(&self.width) - self.off(&here.values)
    }

    /// Half the curvature, in widths, and its factor; none where it is not positive.
    fn curvature(&self, here: &Point, apart: &[Vec<usize>]) -> Option<(DMatrix<f64>, Arrow)> {
        let curvature = in_widths(self.places.information(&here.prediction, self.weight), &self.width);
        let factor = Arrow::of(&curvature, apart)?;
        Some((curvature, factor))
    }

    /// The first better point along the curve of damped steps, from the longest on, and how much lower it was promised to be; none where not even a millionth of a
    /// step is better: the best ring is one at the edge of stability.
    fn further(
        &self,
        here: &Point,
        (curvature, slope, apart): (&DMatrix<f64>, &DVector<f64>, &[Vec<usize>]),
        damping: &mut f64,
    ) -> Option<(Point, f64)> {
        while *damping < STUCK {
            let mut damped = curvature.clone();
            (0..slope.len()).for_each(|i| damped[(i, i)] *= 1.0 + *damping);
            let step = Arrow::of(&damped, apart)?.solve(slope);
            match self.point(&here.values + step.component_mul(&self.width)) {
                Ok(there) if there.height < here.height => {
                    *damping = (*damping * 0.1).max(1e-9);
                    return Some((there, 2.0 * slope.dot(&step) - step.dot(&(curvature * &step))));
                }
                _ => *damping *= 10.0,
            }
        }
        None
    }
}
