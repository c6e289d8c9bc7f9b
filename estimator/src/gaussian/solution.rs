//! The best point of a Gaussian within the prior's range, its covariance, and the evidence.

use super::{Covariance, Gaussian, square};
use crate::linear::{add, dot};
use crate::mask::Mask;
use crate::prior::Prior;
use crate::state::state;
use crate::triangle::Triangle;

/// Shares by which the information's diagonal is enlarged until it is positive: rounding of a sum of 48 squares is 1e-14 of it.
const SUPPORT: [f64; 4] = [0.0, 1e-14, 1e-9, 1e-4];

/// The best point of a [`Gaussian`], and its spread.
#[derive(Debug, Clone)]
pub struct Solution<const N: usize, const T: usize, const W: usize> {
    /// Best point without bounds, relative to the origin.
    pub delta: [f64; N],
    /// Best point within the prior's range: the MAP params.
    pub map_params: [f32; N],
    /// Standard deviation of each param.
    pub sigma: [f32; N],
    /// Bit `i` is 1 if param `i` sits at a bound.
    pub clipped: Mask<W>,
    /// Chi-square at the best point without bounds.
    pub cost: f64,
    /// `ln` of the evidence: the density of all readings under the model.
    pub log_evidence: f64,
    /// `ln` of the determinant of the information.
    pub log_determinant: f64,
    /// Inverse of the information's lower Cholesky factor, `P = X^T X`.
    factor: Triangle<N, T, f64>,
}

state!([const N: usize, const T: usize, const W: usize] Solution<N, T, W> {
    delta,
    map_params,
    sigma,
    clipped,
    cost,
    log_evidence,
    log_determinant,
    factor,
});

impl<const N: usize, const T: usize, const W: usize> Solution<N, T, W> {
    /// Memory for one, all zero.
    pub const BLANK: Self = Self {
        delta: [0.0; N],
        map_params: [0.0; N],
        sigma: [0.0; N],
        clipped: Mask::NONE,
        cost: 0.0,
        log_evidence: 0.0,
        log_determinant: 0.0,
        factor: Triangle::ZERO,
    };

    /// Solve a Gaussian. True if its information was positive as it stands; else the diagonal is enlarged by as little as makes
    /// it so, and where nothing does, the solution is the prior: whatever happens, it is a whole one.
    pub fn solve<const B: usize, V: Covariance<B>>(
        &mut self,
        gaussian: &Gaussian<B, N, T, V>,
        prior: impl Fn(usize) -> Prior,
    ) -> bool {
        const { assert!(W >= crate::mask::words(N), "W words have a bit for each param") };
        let mut tried = 0;
        let factorised = SUPPORT.into_iter().find_map(|more| {
            tried += 1;
            self.factor = gaussian.information;
            self.factor.rows_mut().filter_map(<[f64]>::last_mut).for_each(|diagonal| *diagonal *= 1.0 + more);
            self.factor.factorise()
        });
        self.log_determinant = factorised.unwrap_or_else(|| self.forget(gaussian, &prior));
        if factorised.is_some() {
            self.delta = gaussian.vector;
            self.factor.solve_lower(&mut self.delta);
            self.factor.solve_upper(&mut self.delta);
            self.factor.invert();
        }
        let mut variance = [0.0; N];
        for row in self.factor.rows() {
            variance.iter_mut().zip(row).for_each(|(v, x)| *v += x * x);
        }
        self.sigma = variance.map(|v| libm::sqrt(v) as f32);
        self.cost = gaussian.cost - dot(&gaussian.vector, &self.delta);
        self.log_evidence = -0.5 * (self.cost + gaussian.volume + self.log_determinant);
        self.bound(gaussian, prior);
        tried == 1
    }

    /// The prior as a solution; returns the logarithm of the determinant of its information.
    #[cold]
    fn forget<const B: usize, V: Covariance<B>>(
        &mut self,
        gaussian: &Gaussian<B, N, T, V>,
        prior: impl Fn(usize) -> Prior,
    ) -> f64 {
        let mut log_determinant = 0.0;
        self.factor.fill_diagonal(0.0);
        let each = self.factor.rows_mut().zip(self.delta.iter_mut().zip(&gaussian.origin));
        for (i, (row, (delta, origin))) in each.enumerate() {
            let Prior { mean, sigma, .. } = prior(i);
            *delta = f64::from(mean) - f64::from(*origin);
            row.last_mut().into_iter().for_each(|diagonal| *diagonal = sigma.into());
            log_determinant -= libm::log(square(sigma));
        }
        log_determinant
    }

    /// The best point within the bounds, by projected Gauss-Seidel sweeps from the unbounded one.
    #[inline(never)] // so that the stack holds its rows, and those of each step of `solve`, one after the other
    fn bound<const B: usize, V: Covariance<B>>(
        &mut self,
        gaussian: &Gaussian<B, N, T, V>,
        prior: impl Fn(usize) -> Prior,
    ) {
        // not `clamp`, which panics on bounds that are crossed
        let bounded = |i: usize, theta: f32| {
            let Prior { lower, upper, .. } = prior(i);
            theta.max(lower).min(upper)
        };
        let mut outside = false;
        for (i, ((map, delta), origin)) in self.map_params.iter_mut().zip(&self.delta).zip(&gaussian.origin).enumerate()
        {
            let best = (f64::from(*origin) + delta) as f32;
            *map = bounded(i, best);
            outside |= *map != best;
        }
        self.clipped = Mask::NONE;
        if !outside {
            return;
        }
        let mut pull = gaussian.pull(&gaussian.step_to(&self.map_params));
        // Each sweep minimises over one param at a time; the error falls by the coupling, about a half, each sweep.
        for _ in 0..30 {
            if !self.sweep(gaussian, &mut pull, bounded) {
                break;
            }
        }
        for (i, &map) in self.map_params.iter().enumerate() {
            let Prior { lower, upper, .. } = prior(i);
            self.clipped.put(i, map == lower || map == upper);
        }
    }

    /// Move each param to its best value within the bounds, the others held; false if none moved by more than a thousandth
    /// of its error bar.
    fn sweep<const B: usize, V: Covariance<B>>(
        &mut self,
        gaussian: &Gaussian<B, N, T, V>,
        pull: &mut [f64; N],
        bounded: impl Fn(usize, f32) -> f32,
    ) -> bool {
        let (mut moved, mut row) = (false, [0.0; N]);
        for (i, (map, sigma)) in self.map_params.iter_mut().zip(&self.sigma).enumerate() {
            let step = pull.get(i).copied().unwrap_or(0.0) / gaussian.information.get(i, i);
            let to = bounded(i, *map + step as f32);
            let step = f64::from(to) - f64::from(*map);
            if step.abs() > 1e-3 * f64::from(*sigma) {
                gaussian.information.copy_row(i, &mut row);
                add(pull, -step, &row);
                (*map, moved) = (to, true);
            }
        }
        moved
    }

    /// Memory for a triangle of params, until the next [`Solution::solve`].
    pub(super) fn work_space(&mut self) -> &mut Triangle<N, T, f64> {
        &mut self.factor
    }

    /// Covariance of two params.
    pub fn covariance(&self, i: usize, j: usize) -> f64 {
        self.factor.rows().skip(i.max(j)).filter_map(|row| Some(row.get(i)? * row.get(j)?)).sum()
    }

    /// Covariance of a param with each.
    pub fn covariance_row(&self, i: usize) -> [f32; N] {
        let mut sum = [0.0; N];
        for row in self.factor.rows_from(i) {
            add(&mut sum, row.get(i).copied().unwrap_or(0.0), row);
        }
        sum.map(|v| v as f32)
    }

    /// What covariances are sums of: the entries of `X` of `P = X^T X`, a lower triangle row by row, which [`crate::square`] makes that of `P`.
    pub fn inverse_factor(&self) -> &[f64] {
        self.factor.entries()
    }

    /// Variance of a prediction with derivative `h`: `h^T P h`.
    pub fn variance_of(&self, h: &[f64; N]) -> f64 {
        let image = |row: &[f64]| {
            let x = dot(row, h);
            x * x
        };
        self.factor.rows().map(image).sum()
    }
}
