//! How well a combination of the unknowns is known where the model's errors are alike along the row of a monitor and along the column of a
//! corrector, as they are on every measured ring.
//!
//! Of a combination `d` of the unknowns with covariance `C`, an element with derivative `J` and slope `s` of its `ln` likelihood says
//! `d C J^T s`. What each row and each column says, squared and added, less what stands in both, is the variance of the combination:
//!
//! `sum_rows (sum d C J^T s)^2 + sum_columns (sum d C J^T s)^2 - sum (d C J^T s)^2 + d C P C d`,
//!
//! the last term of the prior of precision `P`: of independent errors of the learnt size all are `C (J^T W J + P) C = C`. It is at least `d C d` and at least
//! `sum (d C J^T s)^2 + d C P C d`, that of independent errors of unequal size: the fit of an instrument's own gain leaves nothing in the sum over its line.
//!
//! Source: A. C. Cameron, J. B. Gelbach and D. L. Miller, J. Bus. Econ. Stat. 29 (2011) 238, eq. 2.8; H. White,
//! Econometrica 48 (1980) 817.

use evidence::Factor;
use nalgebra::{DMatrix, DVector};

use crate::data::Data;
use crate::error::MeasuredError;
use crate::linear::{product, transposed_product};
use crate::model::Prediction;
use crate::noise::Noise;
use crate::normal::{Places, in_widths, times};
use crate::unknowns::Unknown;

/// Of the unknowns of a fit.
#[derive(Debug, Clone)]
pub struct Uncertainty {
    /// Covariance with independent errors.
    pub independent: DMatrix<f64>,
    /// Standard deviation of each unknown.
    pub sigma: DVector<f64>,
    /// `J^T s` of each row and of each column, columns.
    together: DMatrix<f64>,
    /// `J^T s s J` of all elements.
    alone: DMatrix<f64>,
    /// `J^T W J` of independent errors of the learnt size.
    information: DMatrix<f64>,
    /// Of the variance of each unknown with independent errors, what they make: the rest is of the prior.
    of_data: DVector<f64>,
}

impl Uncertainty {
    /// About a prediction, with the errors of the elements.
    ///
    /// # Errors
    /// [`MeasuredError::Singular`].
    pub fn of(unknowns: &[Unknown], at: &Prediction, data: &Data, noise: &Noise) -> Result<Self, MeasuredError> {
        let residual = data.residual(at);
        let places = Places::of(unknowns, residual.nrows(), residual.ncols());
        let information = places.information(at, &data.information(noise));
        let width = DVector::from_iterator(unknowns.len(), unknowns.iter().map(|one| one.width));
        let curvature = in_widths(information.clone(), &width);
        let inverse = Factor::of(curvature).ok_or(MeasuredError::Singular(0))?.inverse();
        let independent = times(inverse, &width);
        Ok(Self::about((&places, at), (independent, information), (data, noise)))
    }

    /// About a prediction, with the covariance of the unknowns with independent errors and what the data say of them, `J^T W J`.
    pub fn about(
        (places, at): (&Places, &Prediction),
        (independent, information): (DMatrix<f64>, DMatrix<f64>),
        (data, noise): (&Data, &Noise),
    ) -> Self {
        let (residual, n) = (data.residual(at), independent.nrows());
        let slope = data.weight(noise, &residual).component_mul(&residual);
        let together = places.back_by_lines(at, &slope);
        let alone = places.information(at, &slope.component_mul(&slope));
        let [sigma, of_data] = [DVector::zeros(n), DVector::zeros(n)];
        let mut all = Self { independent, sigma, together, alone, information, of_data };
        let of_lines = transposed_product(&all.together, &all.independent);
        let diagonal = |matrix: &DMatrix<f64>, independent: &DMatrix<f64>| {
            product(matrix, independent).component_mul(independent).row_sum().transpose()
        };
        let of_elements = diagonal(&all.alone, &all.independent);
        all.of_data = diagonal(&all.information, &all.independent);
        all.sigma = DVector::from_fn(n, |i, _| {
            let independent = all.independent[(i, i)];
            variance(of_lines.column(i).norm_squared(), of_elements[i], all.of_data[i], independent).sqrt()
        });
        all
    }

    /// How many times larger the variance that the data leave an unknown is than that of independent errors.
    pub fn widening(&self, unknown: usize) -> f64 {
        let of_data = self.of_data[unknown];
        let of_prior = self.independent[(unknown, unknown)] - of_data;
        if of_data > 0.0 { ((self.sigma[unknown].powi(2) - of_prior) / of_data).max(1.0) } else { 1.0 }
    }

    /// Among some of the unknowns.
    pub fn among(&self, unknowns: &[usize]) -> Marginal {
        let directions = self.independent.select_columns(unknowns);
        let of_lines = transposed_product(&self.together, &directions);
        let [elements, of_data] =
            [&self.alone, &self.information].map(|form| transposed_product(&directions, &product(form, &directions)));
        Marginal {
            lines: transposed_product(&of_lines, &of_lines),
            elements,
            of_data,
            independent: directions.select_rows(unknowns),
        }
    }

    /// Variance of a combination of the unknowns.
    pub fn variance(&self, combination: &DVector<f64>) -> f64 {
        let direction = &self.independent * combination;
        let [elements, data] = [&self.alone, &self.information].map(|matrix| direction.dot(&(matrix * &direction)));
        variance(self.together.tr_mul(&direction).norm_squared(), elements, data, combination.dot(&direction))
    }
}

/// The same among some of the unknowns, where many combinations of a few are asked for.
#[derive(Debug, Clone)]
pub struct Marginal {
    lines: DMatrix<f64>,
    elements: DMatrix<f64>,
    of_data: DMatrix<f64>,
    independent: DMatrix<f64>,
}

impl Marginal {
    /// Variances of combinations, rows `[M][N]` of the chosen unknowns.
    pub fn variances(&self, combinations: &DMatrix<f64>) -> DVector<f64> {
        let [lines, elements, of_data, independent] = [&self.lines, &self.elements, &self.of_data, &self.independent]
            .map(|form| (combinations * form).component_mul(combinations).column_sum());
        DVector::from_fn(combinations.nrows(), |i, _| variance(lines[i], elements[i], of_data[i], independent[i]))
    }
}

/// From the sums of squares over lines and over elements, what independent errors of the learnt size make, and the whole variance with these.
fn variance(lines: f64, elements: f64, of_data: f64, independent: f64) -> f64 {
    (lines - elements).max(elements).max(of_data) + independent - of_data
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use crate::fit::{Settings, fit};
    use crate::testing::{NOISE, machine, measured, normal, ring};

    /// Mean square error of the strengths over their variance with independent errors, and over that with errors alike along rows and columns, of
    /// rings whose correctors kick at another one's place too, by a share with some rms.
    fn nees(share: f64, seeds: core::ops::Range<u64>) -> [f64; 2] {
        let ring = ring();
        let mut sums = [0.0; 2];
        for seed in seeds {
            let truth = machine(&ring, seed);
            let mut folder = measured(&ring, &truth, NOISE, 100 + seed);
            let (mut normal, columns) = (normal(300 + seed), folder.matrix.ncols());
            let right = folder.matrix.clone();
            for column in 0..columns {
                let other = right.column((column + 5) % columns) * (share * normal());
                let mut into = folder.matrix.column_mut(column);
                into += other;
            }
            let fit = fit(&folder, &Settings::default(), &mut |_| ()).unwrap();
            for i in 0..fit.groups[0].len() {
                let square = (fit.values[i] - truth.2[i]).powi(2) / (8 * fit.groups[0].len()) as f64;
                sums[0] += square / fit.uncertainty.independent[(i, i)];
                sums[1] += square / fit.sigma(i).powi(2);
            }
        }
        sums
    }

    #[test]
    fn combinations_of_a_few_have_the_variance_of_combinations_of_all() {
        let ring = ring();
        let fit = fit(&measured(&ring, &machine(&ring, 5), NOISE, 6), &Settings::default(), &mut |_| ()).unwrap();
        let some = [3, 0, 11];
        let combinations = DMatrix::from_row_slice(2, 3, &[0.5, -2.0, 1.0, 1.0, 1.0, 0.0]);
        let variances = fit.uncertainty.among(&some).variances(&combinations);
        for (row, variance) in combinations.row_iter().zip(&variances) {
            let mut whole = DVector::zeros(fit.unknowns.len());
            some.iter().zip(row.iter()).for_each(|(&at, &share)| whole[at] = share);
            let known = fit.uncertainty.variance(&whole);
            assert!((variance / known - 1.0).abs() < 1e-9, "{variance} {known}");
        }
    }

    #[test]
    fn errors_that_are_alike_widen_the_error_bars() {
        let [independent, alike] = nees(0.0, 0..8);
        // of independent errors nothing to widen but by chance: 0.95 to 0.99 in five sets of eight rings
        assert!((0.9..=1.0).contains(&(alike / independent)), "{independent} {alike}");
        // 192 strengths: their mean square scatters by 0.10, four times that
        assert!((0.6..1.4).contains(&alike), "{alike}");
        // five sets of eight rings give 1.7 to 2.6 with independent errors and 1.2 to 2.1 with these: 24 rows and columns are few to learn from,
        // real rings have 48 to 400
        let [independent, alike] = nees(0.03, 0..8);
        assert!(independent > 1.6 && alike < 0.85 * independent, "{independent} {alike}");
    }
}
