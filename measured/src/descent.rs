//! The most probable values of the unknowns for elements that count what they count: damped Gauss-Newton.

use nalgebra::{DMatrix, DVector};

use crate::arrow::Arrow;
use crate::data::residual;
use crate::error::MeasuredError;
use crate::model::{Model, Prediction};
use crate::normal::{Normal, Places, in_widths, times};
use crate::unknowns::Unknown;

/// Steps of one descent; those of measured rings take 5 to 60.
const STEPS: usize = 100;
/// A descent has ended when the best step promises less than this, or this share of its sum of squares.
const ENOUGH: f64 = 1e-3;
const ENOUGH_SHARE: f64 = 1e-7;

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

/// Damped Gauss-Newton.
///
/// # Errors
/// [`MeasuredError`].
pub fn descend(
    model: &Model,
    unknowns: &[Unknown],
    measured: &DMatrix<f64>,
    weight: &DMatrix<f64>,
    mut values: DVector<f64>,
) -> Result<Descent, MeasuredError> {
    let n = unknowns.len();
    let places = Places::of(unknowns, measured.nrows(), measured.ncols());
    let apart = places.apart();
    let width = DVector::from_iterator(n, unknowns.iter().map(|one| one.width));
    let mean = DVector::from_iterator(n, unknowns.iter().map(|one| one.mean));
    let off = |values: &DVector<f64>| (values - &mean).component_div(&width);
    let mut prediction = model.predict(unknowns, &values)?;
    let mut damping = 1e-3;
    let mut step = 0;
    loop {
        let normal = Normal::of(&places, &prediction, &residual(measured, &prediction, weight), weight, n);
        let matrix = in_widths(normal.matrix, &width);
        let slope = normal.slope.component_mul(&width) - off(&values);
        let now = normal.chi2 + off(&values).norm_squared();
        let factor = Arrow::of(&matrix, &apart).ok_or(MeasuredError::Singular(step))?;
        let has_ended = slope.dot(&factor.solve(&slope)) < ENOUGH.max(ENOUGH_SHARE * now);
        let further = (!has_ended && step < STEPS).then(|| {
            let sum = |values: &DVector<f64>, at: &Prediction| {
                let left = residual(measured, at, weight);
                left.component_mul(&left).dot(weight) + off(values).norm_squared()
            };
            further(
                model,
                unknowns,
                (&matrix, &slope, &apart),
                &mut damping,
                |moved| &values + moved.component_mul(&width),
                |v, at| sum(v, at) < now,
            )
        });
        match further.flatten() {
            Some(better) => (values, prediction) = better,
            None => {
                let covariance = times(factor.inverse(), &width);
                return Ok(Descent { values, covariance, prediction, steps: step, has_ended });
            }
        }
        step += 1;
    }
}

/// The first better point along the curve of damped steps, from the longest on; none where not even a millionth of a step is better: the
/// best ring is one at the edge of stability.
fn further(
    model: &Model,
    unknowns: &[Unknown],
    (matrix, slope, apart): (&DMatrix<f64>, &DVector<f64>, &[Vec<usize>]),
    damping: &mut f64,
    to: impl Fn(&DVector<f64>) -> DVector<f64>,
    is_better: impl Fn(&DVector<f64>, &Prediction) -> bool,
) -> Option<(DVector<f64>, Prediction)> {
    while *damping < 1e9 {
        let mut damped = matrix.clone();
        for i in 0..slope.len() {
            damped[(i, i)] *= 1.0 + *damping;
        }
        let values = to(&Arrow::of(&damped, apart)?.solve(slope));
        match model.predict(unknowns, &values) {
            Ok(at) if is_better(&values, &at) => {
                *damping = (*damping * 0.1).max(1e-9);
                return Some((values, at));
            }
            _ => *damping *= 10.0,
        }
    }
    None
}
