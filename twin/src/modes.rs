//! The two normal modes of the coupled one-turn matrix: fractional tunes and their derivative.
//!
//! `cos(mu)` of the modes are the roots of the quadratic formed by the trace of the 4x4 one-turn matrix and the determinant
//! of its coupling block:
//!
//! `cos(mu) = (t_x + t_y)/2 ± sqrt((t_x - t_y)^2/4 + det(m + n^+)/4)`,
//!
//! `t` half the traces of the diagonal blocks, `m` and `n` the blocks that couple.
//!
//! Source: D. A. Edwards and L. C. Teng, IEEE Trans. Nucl. Sci. 20 (1973) 885, eq. 12-14.

use core::f64::consts::{PI, TAU};

use nalgebra::{Matrix4, Matrix6};

use crate::map::{X, Y};
use crate::orbit::OrbitError;

/// The two normal modes of a one-turn matrix.
#[derive(Debug, Clone)]
pub(crate) struct Modes {
    /// The transverse block.
    turn: Matrix4<f64>,
    /// Half the difference of the cosines, and what it would be without coupling.
    split: f64,
    difference: f64,
    /// Tunes without their integer part, in 0..1.
    pub fractions: [f64; 2],
}

impl Modes {
    /// Of a turn.
    ///
    /// # Errors
    /// [`OrbitError::Unstable`] with the half trace, [`OrbitError::SumResonance`].
    pub fn of(turn: &Matrix6<f64>) -> Result<Self, OrbitError> {
        let m = turn.fixed_view::<4, 4>(0, 0).into_owned();
        let half = |i: usize| 0.5 * (m[(i, i)] + m[(i + 1, i + 1)]);
        let (mean, difference) = (0.5 * (half(0) + half(2)), 0.5 * (half(0) - half(2)));
        let [a, b, c, d] = coupling(&m);
        let discriminant = difference * difference + 0.25 * (a * d - b * c);
        if discriminant < 0.0 {
            return Err(OrbitError::SumResonance { discriminant });
        }
        let split = discriminant.sqrt().copysign(difference);
        let fraction = |mode: char, half_trace: f64, i: usize| {
            if half_trace.is_nan() || half_trace.abs() >= 1.0 {
                return Err(OrbitError::Unstable { mode, half_trace });
            }
            let turns = half_trace.acos() / TAU;
            Ok(if m[(i, i + 1)] < 0.0 { 1.0 - turns } else { turns })
        };
        let fractions = [fraction('x', mean + split, X)?, fraction('y', mean - split, Y)?];
        Ok(Self { turn: m, split, difference, fractions })
    }

    /// Least distance of the two tunes, were they brought together: `sqrt(|det(m + n^+)|)/(pi |sin mu_x + sin mu_y|)`.
    pub fn closest_approach(&self) -> f64 {
        let [a, b, c, d] = coupling(&self.turn);
        let [x, y] = self.fractions.map(|fraction| (TAU * fraction).sin());
        (a * d - b * c).abs().sqrt() / (PI * (x + y).abs())
    }

    /// Derivative of each tune with respect to the entries of the 4x4 matrix: `dQ = -d(cos mu)/(2 pi sin mu)`.
    pub fn slopes(&self) -> [Matrix4<f64>; 2] {
        let mean = Matrix4::from_diagonal_element(0.25);
        let mut difference = mean;
        (difference[(2, 2)], difference[(3, 3)]) = (-0.25, -0.25);
        let split = match self.split {
            // two modes of one tune, without coupling
            0.0 => difference,
            split => (difference * self.difference + self.coupling_slope() * 0.125) / split,
        };
        let per_cos = self.fractions.map(|fraction| -1.0 / (TAU * (TAU * fraction).sin()));
        [(mean + split) * per_cos[0], (mean - split) * per_cos[1]]
    }

    /// Derivative of `det(m + n^+)`.
    fn coupling_slope(&self) -> Matrix4<f64> {
        let [a, b, c, d] = coupling(&self.turn);
        let mut slope = Matrix4::zeros();
        (slope[(0, 2)], slope[(3, 1)]) = (d, d);
        (slope[(0, 3)], slope[(2, 1)]) = (-c, c);
        (slope[(1, 2)], slope[(3, 0)]) = (-b, b);
        (slope[(1, 3)], slope[(2, 0)]) = (a, a);
        slope
    }

    /// Derivative of the tunes with respect to a gradient of this kernel: the turn changes by `-M Q`, and a kernel is taken
    /// away.
    pub fn tune_slope(slopes: &[Matrix4<f64>; 2], turn: &Matrix6<f64>, kernel: &Matrix6<f64>) -> [f64; 2] {
        let change = (turn * kernel).fixed_view::<4, 4>(0, 0).into_owned();
        [-slopes[0].dot(&change), -slopes[1].dot(&change)]
    }
}

/// Entries of `m + n^+`, rows first, `n^+` the symplectic conjugate of the lower coupling block.
fn coupling(turn: &Matrix4<f64>) -> [f64; 4] {
    let m = |i, j| turn[(i, j)];
    [m(0, 2) + m(3, 1), m(0, 3) - m(2, 1), m(1, 2) - m(3, 0), m(1, 3) + m(2, 0)]
}
