//! The peak of a density of a few coordinates: where it is, how wide, and its integral by Laplace's method.

use nalgebra::{DMatrix, DVector};

use inference::{Limits, Objective, Quadratic, minimise};

/// A peak.
#[derive(Debug, Clone)]
pub struct Peak {
    /// Where it is.
    pub at: DVector<f64>,
    /// Inverse of minus the second derivative of the log-density.
    pub covariance: DMatrix<f64>,
    /// `ln` of the integral.
    pub log_integral: f64,
}

/// A log-density.
struct Density<F>(F);

/// A log-density that is not a number, or not of a peak.
#[derive(Debug)]
struct NoPeak;

/// Step of the differences; the coordinates are logarithms.
const STEP: f64 = 0.05;
/// Least curvature.
const FLAT: f64 = 1e-3;
const LIMITS: Limits = Limits { settled: 1e-3, steps: 20, halvings: 6 };

impl<F: Fn(&DVector<f64>) -> f64> Density<F> {
    /// Minus half the gradient and half the second derivative of `-2 ln density`.
    fn quadratic(&self, x: &DVector<f64>) -> Quadratic {
        let n = x.len();
        let moved = |steps: &[(usize, f64)]| {
            let mut x = x.clone();
            steps.iter().for_each(|(i, step)| x[*i] += step);
            (self.0)(&x)
        };
        let here = moved(&[]);
        let sides: Vec<[f64; 2]> = (0..n).map(|i| [moved(&[(i, -STEP)]), moved(&[(i, STEP)])]).collect();
        let bend = |i: usize, j: usize| {
            if i == j {
                return (2.0 * here - sides[i][0] - sides[i][1]) / (STEP * STEP);
            }
            let along = moved(&[(i, STEP), (j, STEP)]) + moved(&[(i, -STEP), (j, -STEP)]);
            (sides[i][0] + sides[i][1] + sides[j][0] + sides[j][1] - 2.0 * here - along) / (2.0 * STEP * STEP)
        };
        let mut matrix = DMatrix::zeros(n, n);
        for i in 0..n {
            for j in 0..=i {
                matrix[(i, j)] = bend(i, j);
                matrix[(j, i)] = matrix[(i, j)];
            }
        }
        let slope = DVector::from_iterator(n, sides.iter().map(|[below, above]| (above - below) / (2.0 * STEP)));
        Quadratic { matrix: positive(matrix), slope }
    }
}

/// The matrix with its eigenvalues at least a little positive, so that a step leads uphill in density.
fn positive(matrix: DMatrix<f64>) -> DMatrix<f64> {
    let mut eigen = matrix.symmetric_eigen();
    eigen.eigenvalues.apply(|value| *value = value.abs().max(FLAT));
    eigen.recompose()
}

impl<F: Fn(&DVector<f64>) -> f64> Objective for Density<F> {
    type Point = ();
    type Slopes = ();
    type Error = NoPeak;

    fn evaluate(&self, x: &DVector<f64>) -> Result<(f64, ()), NoPeak> {
        let value = (self.0)(x);
        if value.is_finite() { Ok((-2.0 * value, ())) } else { Err(NoPeak) }
    }

    fn linearise(&self, x: &DVector<f64>, (): &()) -> Result<(Quadratic, ()), NoPeak> {
        Ok((self.quadratic(x), ()))
    }
}

impl Peak {
    /// Of a log-density, near a start and within bounds; none if there is no peak near it.
    pub fn find(log_density: impl Fn(&DVector<f64>) -> f64, start: &DVector<f64>, bounds: &[[f64; 2]]) -> Option<Self> {
        let density = Density(log_density);
        let found = minimise(&density, start, bounds, &LIMITS, |_, _| true).ok()?;
        let factor = density.quadratic(&found.x).matrix.cholesky()?;
        let log_det = 2.0 * factor.l_dirty().diagonal().iter().map(|d| d.ln()).sum::<f64>();
        let volume = 0.5 * (found.x.len() as f64 * core::f64::consts::TAU.ln() - log_det);
        Some(Self { log_integral: -0.5 * found.cost + volume, covariance: factor.inverse(), at: found.x })
    }

    /// Standard deviation of a coordinate.
    pub fn sigma(&self, coordinate: usize) -> f64 {
        self.covariance[(coordinate, coordinate)].sqrt()
    }
}
