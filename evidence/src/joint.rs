//! The evidence for several free amplitudes.

use nalgebra::{DMatrix, DVector};

use super::factor::Factor;

/// The evidence for some amplitudes together, and what the data says of them.
#[derive(Debug, Clone)]
pub struct JointEvidence {
    /// `ln` Bayes factor over none of them.
    pub log_bayes_factor: f64,
    widths: DVector<f64>,
    /// Of `1 + W G W`.
    factor: Factor,
    /// `L^-1 W g`, with `L` the factor.
    whitened: DVector<f64>,
}

impl JointEvidence {
    /// By slope and curvature of the log-likelihood at zero, and a width for each; none if `1 + W G W` is not positive.
    ///
    /// # Panics
    /// Where their sizes differ.
    pub fn from_scores(slope: &DVector<f64>, curvature: &DMatrix<f64>, widths: &DVector<f64>) -> Option<Self> {
        let n = slope.len();
        let scaled = DMatrix::from_fn(n, n, |i, j| widths[i] * curvature[(i, j)] * widths[j]);
        let factor = Factor::of(plus_one(scaled))?;
        let whitened = factor.whiten(&slope.component_mul(widths));
        let log_bayes_factor = 0.5 * (whitened.norm_squared() - factor.log_determinant());
        Some(Self { log_bayes_factor, widths: widths.clone(), factor, whitened })
    }

    /// Mean of the posterior of each, in the unit of its width.
    pub fn amplitudes(&self) -> DVector<f64> {
        self.factor.solve_transposed(self.whitened.clone()).component_mul(&self.widths)
    }

    /// Covariance of the posterior.
    pub fn covariance(&self) -> DMatrix<f64> {
        let inverse = self.factor.inverse();
        DMatrix::from_fn(inverse.nrows(), inverse.ncols(), |i, j| self.widths[i] * inverse[(i, j)] * self.widths[j])
    }
}

/// `ln` Bayes factor of amplitudes that all have one width, without the amplitudes themselves; none if `1 + w^2 G` is not positive.
pub fn log_bayes_factor(slope: &DVector<f64>, curvature: &DMatrix<f64>, width: f64) -> Option<f64> {
    let variance = width * width;
    let factor = Factor::of(plus_one(curvature * variance))?;
    Some(0.5 * (variance * factor.whiten(slope).norm_squared() - factor.log_determinant()))
}

fn plus_one(mut matrix: DMatrix<f64>) -> DMatrix<f64> {
    (0..matrix.ncols()).for_each(|i| matrix[(i, i)] += 1.0);
    matrix
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Evidence;

    fn vector(values: &[f64]) -> DVector<f64> {
        DVector::from_column_slice(values)
    }

    fn example() -> (DVector<f64>, DMatrix<f64>, DVector<f64>) {
        (
            vector(&[3.0, -1.0, 0.5]),
            DMatrix::from_row_slice(3, 3, &[4.0, 1.0, 0.0, 1.0, 2.0, 0.5, 0.0, 0.5, 1.0]),
            vector(&[0.5, 2.0, 1.0]),
        )
    }

    #[test]
    fn patterns_at_right_angles_add_the_evidence_of_each() {
        let (slope, powers, widths) = (vector(&[3.0, -1.0]), vector(&[4.0, 0.5]), vector(&[0.5, 2.0]));
        let joint = JointEvidence::from_scores(&slope, &DMatrix::from_diagonal(&powers), &widths).unwrap();
        let single = [0, 1].map(|i| Evidence::from_score(slope[i], powers[i], widths[i]));
        let sum = single[0].log_bayes_factor + single[1].log_bayes_factor;
        assert!((joint.log_bayes_factor - sum).abs() < 1e-14, "rounding");
        for (i, single) in single.iter().enumerate() {
            assert!((joint.amplitudes()[i] - single.amplitude).abs() < 1e-14, "rounding");
            assert!((joint.covariance()[(i, i)] - single.sigma.powi(2)).abs() < 1e-14, "rounding");
        }
        assert_eq!(joint.covariance()[(0, 1)], 0.0);
    }

    #[test]
    fn the_posterior_adds_the_precisions_of_prior_and_data() {
        let (slope, curvature, widths) = example();
        let joint = JointEvidence::from_scores(&slope, &curvature, &widths).unwrap();
        let precision = &curvature + DMatrix::from_diagonal(&widths.map(|width| width.powi(-2)));
        let covariance = precision.try_inverse().unwrap();
        assert!((joint.covariance() - &covariance).amax() < 1e-14, "rounding");
        assert!((joint.amplitudes() - covariance * slope).amax() < 1e-14, "rounding");
    }

    /// Determinant and inverse written out.
    #[test]
    fn the_evidence_is_its_closed_form() {
        let (slope, curvature, widths) = example();
        let w = DMatrix::from_diagonal(&widths);
        let inner = DMatrix::identity(3, 3) + &w * curvature.clone() * &w;
        let square = (slope.transpose() * &w * inner.clone().try_inverse().unwrap() * &w * &slope)[(0, 0)];
        let expected = 0.5 * (square - inner.determinant().ln());
        let joint = JointEvidence::from_scores(&slope, &curvature, &widths).unwrap();
        assert!((joint.log_bayes_factor - expected).abs() < 1e-13, "rounding");
    }

    #[test]
    fn one_width_for_all_is_the_same_evidence() {
        let (slope, curvature, _) = example();
        let joint = JointEvidence::from_scores(&slope, &curvature, &DVector::from_element(3, 0.3)).unwrap();
        let same = log_bayes_factor(&slope, &curvature, 0.3).unwrap();
        assert!((joint.log_bayes_factor - same).abs() < 1e-14, "rounding");
    }

    #[test]
    fn what_is_no_curvature_has_no_evidence() {
        let (ones, curvature) = (vector(&[1.0, 1.0]), DMatrix::from_diagonal(&vector(&[-2.0, 1.0])));
        assert!(JointEvidence::from_scores(&ones, &curvature, &ones).is_none());
        assert!(log_bayes_factor(&ones, &curvature, 1.0).is_none());
    }
}
