//! The covariance of the baselines, params given: independent while the params are constant, else correlated.

use nalgebra::SMatrix;

use crate::linear::{add, dot};
use crate::triangle::Triangle;

/// Covariance of the baselines, params given [m^2].
pub trait Covariance<const B: usize>: Copy {
    /// All zero.
    const ZERO: Self;

    /// Independent baselines.
    fn set(&mut self, variances: &[f64; B]);

    /// Variance of each.
    fn variances(&self) -> [f64; B];

    /// Variance of a monitor's.
    fn variance(&self, b: usize) -> f64;

    /// Add to the variance of a monitor's.
    fn spread(&mut self, b: usize, variance: f64);

    /// Take a reading of monitor `b` off, of innovation variance `s`. Returns the gain of each baseline from `from` on.
    fn condition(&mut self, b: usize, s: f64) -> Gain<B>;
}

/// What a reading moves each baseline by, per unit of innovation: those from `from` up to `to`, the others by 0.
#[derive(Debug, Clone, Copy)]
pub struct Gain<const B: usize> {
    pub gain: [f64; B],
    pub from: usize,
    pub to: usize,
}

/// That of baselines which nothing correlates, as long as the params are constant.
pub type Independent<const B: usize> = [f64; B];

/// That of baselines which a walk of the params has correlated; `U` entries make a triangle of `B`.
#[derive(Debug, Clone, Copy)]
pub struct Correlated<const B: usize, const U: usize> {
    matrix: Triangle<B, U, f64>,
    walked: bool,
}

impl<const B: usize> Covariance<B> for Independent<B> {
    const ZERO: Self = [0.0; B];

    fn set(&mut self, variances: &[f64; B]) {
        *self = *variances;
    }

    fn variances(&self) -> [f64; B] {
        *self
    }

    fn variance(&self, b: usize) -> f64 {
        self.get(b).copied().unwrap_or(0.0)
    }

    fn spread(&mut self, b: usize, variance: f64) {
        self.get_mut(b).into_iter().for_each(|own| *own += variance);
    }

    fn condition(&mut self, b: usize, s: f64) -> Gain<B> {
        let mut gain = [0.0; B];
        if let (Some(variance), Some(gain)) = (self.get_mut(b), gain.get_mut(b)) {
            *gain = *variance / s;
            *variance -= *gain * *variance;
        }
        Gain { gain, from: b, to: b + 1 }
    }
}

impl<const B: usize, const U: usize> Covariance<B> for Correlated<B, U> {
    const ZERO: Self = Self { matrix: Triangle::ZERO, walked: false };

    fn set(&mut self, variances: &[f64; B]) {
        self.matrix.fill_diagonal(0.0);
        let diagonal = self.matrix.rows_mut().filter_map(<[f64]>::last_mut);
        diagonal.zip(variances).for_each(|(own, variance)| *own = *variance);
        self.walked = false;
    }

    fn variances(&self) -> [f64; B] {
        core::array::from_fn(|b| self.variance(b))
    }

    fn variance(&self, b: usize) -> f64 {
        self.matrix.get(b, b)
    }

    fn spread(&mut self, b: usize, variance: f64) {
        self.matrix.row_mut(b).last_mut().into_iter().for_each(|own| *own += variance);
    }

    fn condition(&mut self, b: usize, s: f64) -> Gain<B> {
        let mut gain = [0.0; B];
        let (from, to) = if self.walked { (0, B) } else { (b, b + 1) };
        self.matrix.copy_row(b, &mut gain);
        gain.iter_mut().for_each(|gain| *gain /= s);
        for (row, g) in self.matrix.rows_from_mut(from).zip(gain.get(from..to).unwrap_or_default()) {
            add(row.get_mut(from..).unwrap_or_default(), -g * s, gain.get(from..).unwrap_or_default());
        }
        Gain { gain, from, to }
    }
}

impl<const B: usize, const U: usize> Correlated<B, U> {
    /// Add the products of columns `h`, one of each baseline: what they share of a walk.
    pub fn correlate<const N: usize>(&mut self, h: &SMatrix<f64, N, B>) {
        let h = h.as_slice().chunks_exact(N);
        for (row, one) in self.matrix.rows_mut().zip(h.clone()) {
            row.iter_mut().zip(h.clone()).for_each(|(c, other)| *c += dot(one, other));
        }
        self.walked = true;
    }
}
