//! Elements that are predicted without themselves: the matrix is cut into nine parts, some monitors by some correctors, and each is predicted by
//! the others, to first order about the fit of all.

use evidence::Factor;
use nalgebra::{DMatrix, DVector};

use crate::data::Data;
use crate::error::MeasuredError;
use crate::model::Prediction;
use crate::noise::Noise;
use crate::normal::{Places, times};
use crate::unknowns::Unknown;

/// Parts of the rows, and of the columns.
const PARTS: usize = 3;

/// How well elements are predicted without themselves.
#[derive(Debug, Clone, PartialEq)]
pub struct HeldOut {
    /// `ln` density of the elements of each column [nat].
    pub log_density: Vec<f64>,
    /// Rms of what is left [mm].
    pub rms: f64,
    /// Sum of squares over the stated noise per element.
    pub chi2: f64,
    /// Standard deviation of each unknown by the fits without one part: `sqrt((n - 1)/n sum (p_i - mean)^2)` of `n` parts.
    ///
    /// Source: B. Efron and C. Stein, Ann. Stat. 9 (1981) 586, the jackknife.
    pub jackknife: DVector<f64>,
}

/// Scatter of the steps of fits without one part each.
fn jackknife(steps: &[DVector<f64>]) -> DVector<f64> {
    let parts = steps.len() as f64;
    let mean = steps.iter().fold(DVector::zeros(steps[0].len()), |sum, step| sum + step) / parts;
    let squares = steps.iter().map(|step| (step - &mean).map(|off| off * off));
    let sum = squares.fold(DVector::zeros(mean.len()), |sum, square| sum + square);
    sum.map(|sum| ((parts - 1.0) / parts * sum).sqrt())
}

impl HeldOut {
    /// Of the elements that count in some data, by a fit of all elements of its own data: with the precision of the prior in widths, and the errors of the
    /// elements.
    ///
    /// # Errors
    /// [`MeasuredError::Singular`].
    pub fn of_fit(
        (data, counted): (&Data, &Data),
        (unknowns, values, prediction): (&[Unknown], &DVector<f64>, &Prediction),
        (precision, noise): (&DMatrix<f64>, &Noise),
    ) -> Result<Self, MeasuredError> {
        let residual = data.residual(prediction);
        let weight = data.weight(noise, &residual);
        let (rows, columns) = residual.shape();
        let places = Places::of(unknowns, rows, columns);
        let each = |of: fn((&Unknown, &f64)) -> f64| {
            DVector::from_iterator(unknowns.len(), unknowns.iter().zip(values).map(of))
        };
        let width = each(|(unknown, _)| unknown.width);
        let pull = precision * each(|(unknown, value)| (value - unknown.mean) / unknown.width);
        let whole = places.information(prediction, &weight);
        let slope = places.back(prediction, &weight.component_mul(&residual));
        let (mut left, mut steps) = (residual.clone(), Vec::new());
        for part in 0..PARTS * PARTS {
            let is_in = |row: usize, column: usize| row % PARTS == part / PARTS && column % PARTS == part % PARTS;
            let own =
                DMatrix::from_fn(rows, columns, |row, column| f64::from(is_in(row, column)) * weight[(row, column)]);
            let matrix = times(&whole - places.information(prediction, &own), &width) + precision;
            let without = &slope - places.back(prediction, &own.component_mul(&residual));
            let downhill = without.component_mul(&width) - &pull;
            let step = Factor::of(matrix).ok_or(MeasuredError::Singular(0))?.solve(&downhill).component_mul(&width);
            let moved = places.forward(prediction, &step);
            left.zip_zip_apply(&moved, &own, |left, moved, own| *left -= if own > 0.0 { moved } else { 0.0 });
            steps.push(step);
        }
        left.zip_apply(&counted.sigma, |left, sigma| *left *= f64::from(sigma.is_finite()));
        let density = |column: usize| {
            let rows = (0..rows).filter(|&row| counted.sigma[(row, column)].is_finite());
            rows.map(|row| data.log_density(noise, (row, column), left[(row, column)])).sum()
        };
        let elements = counted.elements() as f64;
        Ok(Self {
            log_density: (0..columns).map(density).collect(),
            rms: (left.norm_squared() / elements).sqrt(),
            chi2: left.component_mul(&left).dot(&data.stated()) / elements,
            jackknife: jackknife(&steps),
        })
    }

    /// Gain of `ln` density over another prediction, and its standard deviation, columns being independent.
    pub fn gain_over(&self, other: &Self) -> (f64, f64) {
        let gains: Vec<f64> =
            self.log_density.iter().zip(&other.log_density).map(|(this, other)| this - other).collect();
        let (sum, n) = (gains.iter().sum::<f64>(), gains.len() as f64);
        let squares: f64 = gains.iter().map(|gain| (gain - sum / n).powi(2)).sum();
        (sum, (squares * n / (n - 1.0).max(1.0)).sqrt())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::descent::{EXACT, descend};
    use crate::fit::{Settings, fit};
    use crate::model::Model;
    use crate::testing::{NOISE, machine, measured, ring};

    /// Left out to first order and by a fit without the part: the same to a few hundredths of what is left.
    #[test]
    fn elements_are_predicted_as_by_a_fit_without_them() {
        let ring = ring();
        let folder = measured(&ring, &machine(&ring, 2), NOISE, 9);
        let settings = Settings::default();
        let fitted = fit(&folder, &settings, &mut |_| ()).unwrap();
        let model = Model::of(&folder, &fitted.groups, settings.rf).unwrap();
        let prediction = model.predict(&fitted.unknowns, &fitted.values).unwrap();
        let (rows, columns) = prediction.matrix.shape();
        let n = fitted.unknowns.len();
        let found = HeldOut::of_fit(
            (&fitted.data, &fitted.data),
            (&fitted.unknowns, &fitted.values, &prediction),
            (&DMatrix::identity(n, n), &fitted.noise),
        )
        .unwrap();
        let weight = fitted.data.weight(&fitted.noise, &fitted.residual);
        let mut squares = 0.0;
        for part in 0..PARTS * PARTS {
            let is_out = |row: usize, column: usize| row % PARTS == part / PARTS && column % PARTS == part % PARTS;
            let without = DMatrix::from_fn(rows, columns, |i, j| if is_out(i, j) { 0.0 } else { weight[(i, j)] });
            let there =
                descend(&model, &fitted.unknowns, &fitted.data.measured, &without, (fitted.values.clone(), EXACT))
                    .unwrap();
            let left = fitted.data.residual(&there.prediction);
            squares += (0..rows * columns)
                .map(|k| (k % rows, k / rows))
                .filter(|&(i, j)| is_out(i, j))
                .map(|at| left[at].powi(2))
                .sum::<f64>();
        }
        let rms = (squares / fitted.data.elements() as f64).sqrt();
        assert!((found.rms / rms - 1.0).abs() < 0.02, "{} {rms}", found.rms);
        // what is left of elements that were not fitted is more than their noise
        assert!(found.rms > NOISE && found.gain_over(&found) == (0.0, 0.0));
    }
}
