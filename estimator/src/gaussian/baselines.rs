//! The covariance of the baselines, params given: independent while the params are constant, else correlated.

use nalgebra::SMatrix;

use crate::linear::{add, column, dot, zeros};

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

/// That of baselines which a walk of the params has correlated.
#[derive(Debug, Clone, Copy)]
pub struct Correlated<const B: usize> {
    matrix: SMatrix<f64, B, B>,
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

impl<const B: usize> Covariance<B> for Correlated<B> {
    const ZERO: Self = Self { matrix: zeros(), walked: false };

    fn set(&mut self, variances: &[f64; B]) {
        self.matrix.fill(0.0);
        for (b, (column, variance)) in self.matrix.as_mut_slice().chunks_exact_mut(B).zip(variances).enumerate() {
            column.get_mut(b).into_iter().for_each(|diagonal| *diagonal = *variance);
        }
        self.walked = false;
    }

    fn variances(&self) -> [f64; B] {
        core::array::from_fn(|b| self.variance(b))
    }

    fn variance(&self, b: usize) -> f64 {
        column(self.matrix.as_slice(), B, b).get(b).copied().unwrap_or(0.0)
    }

    fn spread(&mut self, b: usize, variance: f64) {
        let own = self.matrix.as_mut_slice().chunks_exact_mut(B).nth(b);
        own.and_then(|column| column.get_mut(b)).into_iter().for_each(|own| *own += variance);
    }

    fn condition(&mut self, b: usize, s: f64) -> Gain<B> {
        let mut gain = [0.0; B];
        let (from, to) = if self.walked { (0, B) } else { (b, b + 1) };
        let own = column(self.matrix.as_slice(), B, b);
        gain.iter_mut().zip(own).skip(from).take(to - from).for_each(|(to, v)| *to = v / s);
        let columns = self.matrix.as_mut_slice().chunks_exact_mut(B).zip(&gain);
        for (column, g) in columns.skip(from).take(to - from) {
            let rows = column.get_mut(from..to).unwrap_or_default();
            add(rows, -g * s, gain.get(from..to).unwrap_or_default());
        }
        Gain { gain, from, to }
    }
}

impl<const B: usize> Correlated<B> {
    /// Add the products of columns `h`, one of each baseline: what they share of a walk.
    pub fn correlate<const N: usize>(&mut self, h: &SMatrix<f64, N, B>) {
        let h = h.as_slice().chunks_exact(N);
        for (column, one) in self.matrix.as_mut_slice().chunks_exact_mut(B).zip(h.clone()) {
            column.iter_mut().zip(h.clone()).for_each(|(c, other)| *c += dot(one, other));
        }
        self.walked = true;
    }

    /// Add `variance` times the products of `h`, one of each baseline: what they share of the move of one param.
    pub fn share(&mut self, variance: f64, h: &[f64; B]) {
        for (column, one) in self.matrix.as_mut_slice().chunks_exact_mut(B).zip(h) {
            add(column, variance * one, h);
        }
        self.walked = true;
    }
}
