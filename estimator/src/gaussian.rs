//! A Gaussian over the params and the unknown baseline of every monitor, and its best point within the prior's range.
//!
//! Readings obey `innovation = h . delta + baseline_b + noise`, `delta = theta - origin`. The baselines are eliminated as
//! readings arrive: given the params, `baseline_b = mean_b - slope_b . delta +- covariance`, and what a reading says of
//! the params alone is
//!
//! `d = h - slope_b`, `e = innovation - mean_b`, `s = noise^2 + covariance_bb`:
//! `information += d d^T/s`, `vector += d e/s`, `cost += e^2/s`.
//!
//! A tune meter is one more monitor here: its baseline is its calibration error.
//!
//! With constant params the covariance stays diagonal and `slope`, `mean` are running weighted means.
//!
//! Source: the square completion behind the Schur complement, e.g. A. Gelb, Applied Optimal Estimation (1974), ch. 4.

use nalgebra::SMatrix;

use crate::linear::{add, column, dot, zeros};
use crate::mask::Mask;
use crate::prior::Prior;
use crate::sum::{LogProduct, Sum};
use crate::triangle::Triangle;

/// Variance against which the product of variances is kept, that of 0.15 mm [m^2].
const USUAL: f32 = 2.25e-8;
/// `ln(2 pi)` of that.
const LN_USUAL: f32 = -15.771_873;

/// Readings of one monitor at settings of one kind: at the share `x` of a drive whose derivative is `h`,
/// `residual = x h . delta + baseline + noise`. Its fields are sums of precision times `1, x, x^2, residual, x residual`.
#[derive(Debug, Clone, Copy, Default)]
pub struct Line {
    one: f32,
    x: f32,
    xx: f32,
    r: f32,
    xr: f32,
}

/// Repeats of a reading that enter as their mean.
#[derive(Debug, Clone, Copy)]
pub struct Repeats {
    /// How many.
    pub number: u32,
    /// Variance of each about their mean [m^2].
    pub noise: f32,
    /// Variance of the mean, errors that all share included [m^2].
    pub variance: f32,
}

/// What many readings say of the baselines, before these are eliminated; [`Gaussian::slope`] meanwhile holds sums of
/// precision times `h`.
#[derive(Debug, Clone)]
pub struct Pool<const B: usize> {
    /// Baselines from which residuals are counted [m].
    level: [f32; B],
    precision: [f32; B],
    /// Sum of precision times residual.
    pull: [f32; B],
}

/// Information on `N` params and `B` baselines; `T` entries make a triangle of `N`.
#[derive(Debug, Clone, Copy)]
pub struct Gaussian<const B: usize, const N: usize, const T: usize> {
    /// Params at which the readings were linearised.
    origin: [f32; N],
    /// Information matrix of the params, baselines eliminated.
    information: Triangle<N, T>,
    /// Rows that wait to enter the information, with their weights.
    staged: [[f32; N]; 4],
    staged_weight: [f32; 4],
    staged_rows: usize,
    /// Information vector of `theta - origin`.
    vector: [f32; N],
    /// Baselines at the origin [m].
    baseline: [f32; B],
    /// How much less baseline a unit of a param leaves [m], one column a monitor.
    slope: SMatrix<f32, N, B>,
    /// Covariance of the baselines, params given [m^2]; diagonal until the params walk.
    covariance: SMatrix<f32, B, B>,
    walked: bool,
    /// Chi-square of everything at the origin.
    cost: Sum,
    /// `ln` of the product of `s` over the usual variance, readings and prior.
    volume: LogProduct,
    /// Readings in the volume.
    readings: Sum,
}

impl<const B: usize, const N: usize, const T: usize> Gaussian<B, N, T> {
    /// Memory for one, all zero; [`Gaussian::reset`] makes it a distribution.
    pub const BLANK: Self = Self {
        origin: [0.0; N],
        information: Triangle::ZERO,
        staged: [[0.0; N]; 4],
        staged_weight: [0.0; 4],
        staged_rows: 0,
        vector: [0.0; N],
        baseline: [0.0; B],
        slope: zeros(),
        covariance: zeros(),
        walked: false,
        cost: Sum::ZERO,
        volume: LogProduct::BLANK,
        readings: Sum::ZERO,
    };

    /// The prior alone, its mean the origin: that of each param, and the standard deviation of each baseline.
    pub fn reset(&mut self, prior: impl Fn(usize) -> Prior, baseline: impl Fn(usize) -> f32) {
        (self.cost, self.volume, self.readings) = (Sum::ZERO, LogProduct::ONE, Sum::ZERO);
        self.information.fill_diagonal(0.0);
        for (i, (row, origin)) in self.information.rows_mut().zip(&mut self.origin).enumerate() {
            let Prior { mean, sigma, .. } = prior(i);
            let precision = 1.0 / (sigma * sigma);
            *origin = mean;
            row.last_mut().into_iter().for_each(|diagonal| *diagonal = precision);
            self.volume.add_log(-libm::logf(precision));
        }
        self.staged_rows = 0;
        self.vector = [0.0; N];
        self.baseline = [0.0; B];
        self.slope.fill(0.0);
        self.covariance.fill(0.0);
        for (b, column) in self.covariance.as_mut_slice().chunks_exact_mut(B).enumerate() {
            let sigma = baseline(b);
            column.get_mut(b).into_iter().for_each(|diagonal| *diagonal = sigma * sigma);
        }
        self.walked = false;
    }

    /// Params at which innovations are to be formed.
    pub fn origin(&self) -> &[f32; N] {
        &self.origin
    }

    /// Chi-square at the origin, prior included, baselines at their best.
    pub fn cost(&self) -> f32 {
        self.cost.value()
    }

    /// Rms of the baselines of monitors `from..to` [m].
    pub fn orbit(&self, from: usize, to: usize) -> f32 {
        let baselines = self.baseline.get(from..to).unwrap_or_default();
        libm::sqrtf(dot(baselines, baselines) / baselines.len().max(1) as f32)
    }

    /// Baselines at the origin [m].
    pub fn baselines(&self) -> &[f32; B] {
        &self.baseline
    }

    /// Baseline of a monitor at the origin [m].
    pub fn baseline(&self, b: usize) -> f32 {
        self.baseline.get(b).copied().unwrap_or(0.0)
    }

    /// Add readings of monitor `b`: their mean innovation [m], its variance [m^2], and `h` [m].
    pub fn condition(&mut self, b: usize, innovation: f32, variance: f32, h: &[f32]) {
        let Some(&mean) = self.baseline.get(b) else { return };
        let (d, baseline_variance) = self.effective(b, h);
        let s = variance + baseline_variance;
        let e = innovation - mean;
        self.stage(&d, 1.0 / s);
        add(&mut self.vector, e / s, &d);
        self.cost.add(e * e / s);
        self.volume.multiply(s / USUAL);
        self.readings.add(1.0);
        self.learn_baselines(b, &d, e, s);
    }

    fn stage(&mut self, d: &[f32; N], weight: f32) {
        let at = self.staged_rows.min(3);
        if let (Some(row), Some(to)) = (self.staged.get_mut(at), self.staged_weight.get_mut(at)) {
            (*row, *to) = (*d, weight);
        }
        self.staged_rows = at + 1;
        if self.staged_rows == 4 {
            self.settle();
        }
    }

    /// Let the last readings enter the information; to be called after a frame's.
    pub fn settle(&mut self) {
        // what is left of a group of four waits with no weight
        self.staged_weight.iter_mut().skip(self.staged_rows).for_each(|weight| *weight = 0.0);
        let staged = self.staged.each_ref().map(<[f32; N]>::as_slice);
        let factors = |j: usize| {
            let mut factors = self.staged_weight;
            factors.iter_mut().zip(&staged).for_each(|(w, row)| *w *= row.get(j).copied().unwrap_or(0.0));
            factors
        };
        self.information.add_products(factors, staged);
        self.staged_rows = 0;
    }

    /// Move the baselines: without process noise that of monitor `b` alone, else all, for they are correlated.
    fn learn_baselines(&mut self, b: usize, d: &[f32; N], e: f32, s: f32) {
        let mut gain = [0.0; B];
        let (from, to) = if self.walked { (0, B) } else { (b, b + 1) };
        let own = column(self.covariance.as_slice(), B, b);
        gain.iter_mut().zip(own).skip(from).take(to - from).for_each(|(to, v)| *to = v / s);
        let slopes = self.slope.as_mut_slice().chunks_exact_mut(N);
        let covariances = self.covariance.as_mut_slice().chunks_exact_mut(B);
        let each = self.baseline.iter_mut().zip(slopes).zip(covariances).zip(&gain);
        for (((mean, slope), covariance), g) in each.skip(from).take(to - from) {
            *mean += g * e;
            add(slope, *g, d);
            let covariance = covariance.get_mut(from..to).unwrap_or_default();
            add(covariance, -g * s, gain.get(from..to).unwrap_or_default());
        }
    }

    /// Begin to take in many readings at once; their residuals are counted from the baselines `level` [m].
    ///
    /// Where [`Gaussian::condition`] takes one product of rows a reading, this takes one a line and two a monitor:
    ///
    /// `information += sum of x^2/s h h^T - (sum of x/s h)(sum of x/s h)^T / (sum of 1/s)`.
    pub fn open(&mut self, level: [f32; B]) -> Pool<B> {
        let mut pool = Pool { level, precision: [0.0; B], pull: [0.0; B] };
        for b in 0..B {
            // what is known of a baseline is one more reading
            let h = core::array::from_fn(|i| column(self.slope.as_slice(), N, b).get(i).copied().unwrap_or(0.0));
            self.slope.as_mut_slice().iter_mut().skip(b * N).take(N).for_each(|slope| *slope = 0.0);
            let precision = 1.0 / self.baseline_variance(b);
            let r = self.baseline(b) - pool.level.get(b).copied().unwrap_or(0.0);
            self.cost.add(precision * r * r);
            let line = Line { one: precision, x: precision, xx: precision, r: precision * r, xr: precision * r };
            self.add_line(&mut pool, b, &line, &h);
        }
        pool
    }

    /// Count the mean of repeats into a line: its residual [m] at the share `x`.
    ///
    /// The density of all `n` repeats is that of their mean, times `n` and the usual densities of `n - 1` (and what their
    /// scatter adds, [`Gaussian::add_scatter`]).
    pub fn count(&mut self, line: &mut Line, x: f32, residual: f32, repeats: &Repeats) {
        let one = 1.0 / repeats.variance;
        let r = residual * one;
        line.one += one;
        line.x += one * x;
        line.xx += one * x * x;
        line.r += r;
        line.xr += r * x;
        self.cost.add(r * residual);
        let n = repeats.number as f32;
        self.volume.multiply(n * repeats.variance / USUAL);
        if repeats.noise != USUAL {
            self.volume.add_log((n - 1.0) * libm::logf(repeats.noise / USUAL));
        }
        self.readings.add(n);
    }

    /// Add a line of monitor `b`.
    pub fn add_line(&mut self, pool: &mut Pool<B>, b: usize, line: &Line, h: &[f32; N]) {
        let (Some(precision), Some(pull)) = (pool.precision.get_mut(b), pool.pull.get_mut(b)) else { return };
        *precision += line.one;
        *pull += line.r;
        if h.iter().any(|h| *h != 0.0) {
            self.stage(h, line.xx);
            add(&mut self.vector, line.xr, h);
            let slopes = self.slope.as_mut_slice().as_chunks_mut::<N>().0;
            slopes.get_mut(b).into_iter().for_each(|slope| add(slope, line.x, h));
        }
    }

    /// Eliminate the baselines from what a pool has taken in.
    pub fn close(&mut self, pool: &Pool<B>) {
        for (b, (precision, (pull, level))) in pool.precision.iter().zip(pool.pull.iter().zip(&pool.level)).enumerate()
        {
            let mut slope = [0.0; N];
            slope.iter_mut().zip(column(self.slope.as_slice(), N, b)).for_each(|(to, sum)| *to = sum / precision);
            let mean = pull / precision;
            self.stage(&slope, -precision);
            add(&mut self.vector, -pull, &slope);
            self.cost.add(-pull * mean);
            self.volume.multiply(precision * self.baseline_variance(b));
            self.baseline.get_mut(b).into_iter().for_each(|to| *to = level + mean);
            self.slope.as_mut_slice().as_chunks_mut::<N>().0.get_mut(b).into_iter().for_each(|to| *to = slope);
            let own = self.covariance.as_mut_slice().get_mut(b * B + b);
            own.into_iter().for_each(|to| *to = 1.0 / precision);
        }
        self.settle();
    }

    /// Count repeats whose mean has been added as one reading: their number, the variance of each, and the sum of their squared
    /// deviations from the mean. The density of all `n` is that of their mean, times `n` and the usual densities of `n - 1`.
    pub fn add_repeats(&mut self, number: u32, variance: f32, squares: f32) {
        let n = number as f32;
        self.volume.multiply(n);
        self.volume.add_log((n - 1.0) * libm::logf(variance / USUAL));
        self.readings.add(n - 1.0);
        self.add_scatter(squares / variance);
    }

    /// Squared deviations of repeats from their means, over their variance.
    pub fn add_scatter(&mut self, chi_square: f32) {
        self.cost.add(chi_square);
    }

    /// Move the origin without changing the distribution.
    pub fn recentre(&mut self, origin: &[f32; N]) {
        let mut step = [0.0; N];
        step.iter_mut().zip(origin.iter().zip(&self.origin)).for_each(|(s, (to, from))| *s = to - from);
        let moved = self.information.multiply(&step);
        self.cost.add(dot(&step, &moved) - 2.0 * dot(&step, &self.vector));
        add(&mut self.vector, -1.0, &moved);
        for (mean, slope) in self.baseline.iter_mut().zip(self.slope.as_slice().chunks_exact(N)) {
            *mean -= dot(slope, &step);
        }
        self.origin = *origin;
    }

    /// Let every param walk at random by `sigma`: `P += sigma^2`, baselines stay.
    ///
    /// With `K = (1 + sigma^2 Y)^-1`: `Y <- K Y`, `slope <- K slope`, `covariance += sigma^2 slope^T K slope`.
    /// `solution` is that of this Gaussian and serves as work space.
    pub fn walk<const W: usize>(&mut self, sigma: f32, solution: &mut Solution<N, T, W>) {
        let variance = sigma * sigma;
        let mean = solution.delta;
        let k = &mut solution.factor;
        for (i, (to, from)) in k.rows_mut().zip(self.information.rows()).enumerate() {
            to.iter_mut().zip(from).for_each(|(to, y)| *to = variance * y);
            to.get_mut(i).into_iter().for_each(|diagonal| *diagonal += 1.0);
        }
        if k.factorise().is_none() {
            return; // 1 + a positive matrix; only a NaN could fail, and none can enter
        }
        let mut row = [0.0; N];
        // from the first row down: each finds the rest of its column, in the rows below, as it was
        for i in 0..N {
            self.information.copy_row(i, &mut row);
            k.solve_lower(&mut row);
            k.solve_upper(&mut row);
            self.information.row_mut(i).iter_mut().zip(&row).for_each(|(to, y)| *to = *y);
        }
        self.walk_baselines(variance, k, &mean);
        self.walked = true;
        // the best point and its chi-square stay
        let best = self.cost.value() - dot(&self.vector, &mean);
        self.vector = self.information.multiply(&mean);
        self.cost = Sum::ZERO;
        self.cost.add(best + dot(&self.vector, &mean));
    }

    /// Slopes, covariance and, so that the best point stays, baselines; `K = L^-T L^-1`.
    fn walk_baselines(&mut self, variance: f32, k: &Triangle<N, T>, mean: &[f32; N]) {
        for (baseline, slope) in self.baseline.iter_mut().zip(self.slope.as_mut_slice().as_chunks_mut::<N>().0) {
            *baseline -= dot(slope, mean);
            k.solve_lower(slope);
        }
        let half = self.slope.as_slice().chunks_exact(N);
        for (column, one) in self.covariance.as_mut_slice().chunks_exact_mut(B).zip(half.clone()) {
            column.iter_mut().zip(half.clone()).for_each(|(c, other)| *c += variance * dot(one, other));
        }
        for (baseline, slope) in self.baseline.iter_mut().zip(self.slope.as_mut_slice().as_chunks_mut::<N>().0) {
            k.solve_upper(slope);
            *baseline += dot(slope, mean);
        }
    }
}

/// Shares by which the information's diagonal is enlarged until it is positive: rounding of a sum of 48 squares in f32 is
/// 3e-6 of it, and twice the diagonal of any covariance is positive.
const SUPPORT: [f32; 6] = [0.0, 1e-6, 1e-5, 1e-4, 1e-2, 1.0];

/// The best point of a [`Gaussian`], and its spread.
#[derive(Debug, Clone)]
pub struct Solution<const N: usize, const T: usize, const W: usize> {
    /// Best point without bounds, relative to the origin.
    pub delta: [f32; N],
    /// Best point within the prior's range: the MAP params.
    pub map_params: [f32; N],
    /// Standard deviation of each param.
    pub sigma: [f32; N],
    /// Bit `i` is 1 if param `i` sits at a bound.
    pub clipped: Mask<W>,
    /// Chi-square at the best point without bounds.
    pub cost: f32,
    /// `ln` of the evidence: the density of all readings under the model.
    pub log_evidence: f32,
    /// Inverse of the information's lower Cholesky factor, `P = X^T X`.
    factor: Triangle<N, T>,
}

impl<const N: usize, const T: usize, const W: usize> Solution<N, T, W> {
    /// Memory for one, all zero.
    pub const BLANK: Self = Self {
        delta: [0.0; N],
        map_params: [0.0; N],
        sigma: [0.0; N],
        clipped: Mask::NONE,
        cost: 0.0,
        log_evidence: 0.0,
        factor: Triangle::ZERO,
    };

    /// Solve a Gaussian. Where rounding has made its information singular, the diagonal is enlarged by as little as makes
    /// it positive again, and this is false.
    pub fn solve<const B: usize>(&mut self, gaussian: &Gaussian<B, N, T>, prior: impl Fn(usize) -> Prior) -> bool {
        const { assert!(W >= crate::mask::words(N), "W words have a bit for each param") };
        let mut support = SUPPORT.into_iter();
        let log_determinant = loop {
            let Some(more) = support.next() else { return false };
            self.factor = gaussian.information;
            self.factor.rows_mut().filter_map(<[f32]>::last_mut).for_each(|diagonal| *diagonal *= 1.0 + more);
            if let Some(log_determinant) = self.factor.factorise() {
                break log_determinant;
            }
        };
        self.delta = gaussian.vector;
        self.factor.solve_lower(&mut self.delta);
        self.factor.solve_upper(&mut self.delta);
        self.factor.invert();
        let mut variance = [0.0; N];
        for row in self.factor.rows() {
            variance.iter_mut().zip(row).for_each(|(v, x)| *v += x * x);
        }
        self.sigma = variance.map(libm::sqrtf);
        self.cost = gaussian.cost.value() - dot(&gaussian.vector, &self.delta);
        let volume = gaussian.volume.value() + LN_USUAL * gaussian.readings.value();
        self.log_evidence = -0.5 * (self.cost + volume + log_determinant);
        self.bound(gaussian, prior);
        support.len() + 1 == SUPPORT.len()
    }

    /// The best point within the bounds, by projected Gauss-Seidel sweeps from the unbounded one.
    fn bound<const B: usize>(&mut self, gaussian: &Gaussian<B, N, T>, prior: impl Fn(usize) -> Prior) {
        // not `clamp`, which panics on bounds that are crossed
        let bounded = |i: usize, theta: f32| {
            let Prior { lower, upper, .. } = prior(i);
            theta.max(lower).min(upper)
        };
        let mut outside = false;
        for (i, ((map, delta), origin)) in self.map_params.iter_mut().zip(&self.delta).zip(&gaussian.origin).enumerate()
        {
            *map = bounded(i, origin + delta);
            outside |= *map != origin + delta;
        }
        self.clipped = Mask::NONE;
        if !outside {
            return;
        }
        let mut pull = gaussian.pull(&self.map_params);
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
    fn sweep<const B: usize>(
        &mut self,
        gaussian: &Gaussian<B, N, T>,
        pull: &mut [f32; N],
        bounded: impl Fn(usize, f32) -> f32,
    ) -> bool {
        let (mut moved, mut row) = (false, [0.0; N]);
        for (i, (map, sigma)) in self.map_params.iter_mut().zip(&self.sigma).enumerate() {
            let to = bounded(i, *map + pull.get(i).copied().unwrap_or(0.0) / gaussian.information.get(i, i));
            let step = to - *map;
            if step.abs() > 1e-3 * sigma {
                gaussian.information.copy_row(i, &mut row);
                add(pull, -step, &row);
                (*map, moved) = (to, true);
            }
        }
        moved
    }

    /// Covariance of two params.
    pub fn covariance(&self, i: usize, j: usize) -> f32 {
        self.factor.rows().skip(i.max(j)).filter_map(|row| Some(row.get(i)? * row.get(j)?)).sum()
    }

    /// Variance of a prediction with derivative `h`: `h^T P h`.
    pub fn variance_of(&self, h: &[f32]) -> f32 {
        let image = |row: &[f32]| {
            let x = dot(row, h);
            x * x
        };
        self.factor.rows().map(image).sum()
    }
}

impl<const B: usize, const N: usize, const T: usize> Gaussian<B, N, T> {
    /// Downhill pull on the params at a point: minus half the derivative of chi-square.
    fn pull(&self, at: &[f32; N]) -> [f32; N] {
        let mut step = *at;
        add(&mut step, -1.0, &self.origin);
        let mut pull = self.vector;
        add(&mut pull, -1.0, &self.information.multiply(&step));
        pull
    }

    /// Derivative of the difference between a reading and its baseline, and the variance of the baseline.
    pub fn effective(&self, b: usize, h: &[f32]) -> ([f32; N], f32) {
        let mut d = [0.0; N];
        let slope = column(self.slope.as_slice(), N, b);
        d.iter_mut().zip(h).zip(slope).for_each(|((d, h), slope)| *d = h - slope);
        (d, self.baseline_variance(b))
    }

    fn baseline_variance(&self, b: usize) -> f32 {
        column(self.covariance.as_slice(), B, b).get(b).copied().unwrap_or(0.0)
    }
}

#[cfg(test)]
mod tests {
    extern crate std;
    use std::vec::Vec;

    use nalgebra::{Matrix4, Vector4};

    use super::*;

    const BASELINE: f32 = 0.02;
    const WIDE: Prior = Prior { mean: 0.0, sigma: 0.03, lower: -0.06, upper: 0.06 };

    type Solved = Solution<2, 3, 1>;

    /// Readings of two monitors of a ring with two params.
    fn readings() -> Vec<(usize, f32, [f32; 2])> {
        (0..40)
            .map(|i| {
                let t = i as f32;
                let h = [0.05 * libm::sinf(t), 0.04 * libm::cosf(1.7 * t)];
                let noise = 1.5e-4 * libm::sinf(12.9 * t);
                (i % 2, 3e-3 + 0.02 * h[0] - 0.01 * h[1] + noise, h)
            })
            .collect()
    }

    fn prior() -> Gaussian<2, 2, 3> {
        let mut gaussian = Gaussian::BLANK;
        gaussian.reset(|_| WIDE, |_| BASELINE);
        gaussian
    }

    const VARIANCE: f32 = 1.5e-4 * 1.5e-4;
    const SINGLE: Repeats = Repeats { number: 1, noise: VARIANCE, variance: VARIANCE };

    fn conditioned() -> Gaussian<2, 2, 3> {
        let mut gaussian = prior();
        for (b, innovation, h) in readings() {
            gaussian.condition(b, innovation, VARIANCE, &h);
        }
        gaussian.settle();
        gaussian
    }

    /// The same by brute force: params and baselines as four unknowns, in f64.
    fn batch(walks: &[usize], walk: f64) -> (Vector4<f64>, Matrix4<f64>) {
        let (prior, base) = (f64::from(WIDE.sigma).powi(2), f64::from(BASELINE).powi(2));
        let mut p = Matrix4::from_diagonal(&Vector4::new(prior, prior, base, base));
        let mut x = Vector4::zeros();
        for (i, (b, innovation, h)) in readings().into_iter().enumerate() {
            if walks.contains(&i) {
                p[(0, 0)] += walk * walk;
                p[(1, 1)] += walk * walk;
            }
            let mut row = Vector4::new(f64::from(h[0]), f64::from(h[1]), 0.0, 0.0);
            row[2 + b] = 1.0;
            let gain = p * row / ((row.transpose() * p * row)[0] + f64::from(VARIANCE));
            x += gain * (f64::from(innovation) - row.dot(&x));
            p -= gain * (row.transpose() * p);
        }
        (x, p)
    }

    fn assert_equal(gaussian: &Gaussian<2, 2, 3>, walks: &[usize], walk: f64) {
        let mut solution = Solved::BLANK;
        assert!(solution.solve(gaussian, |_| WIDE));
        let (x, p) = batch(walks, walk);
        for i in 0..2 {
            let sigma = p[(i, i)].sqrt();
            let theta = f64::from(gaussian.origin[i] + solution.delta[i]);
            assert!((theta - x[i]).abs() < 1e-3 * sigma, "{theta} {}", x[i]); // f32 rounding
            assert!((f64::from(solution.sigma[i]) / sigma - 1.0).abs() < 1e-4);
        }
        assert!((f64::from(solution.covariance(0, 1)) - p[(0, 1)]).abs() < 1e-4 * p[(0, 0)]);
    }

    #[test]
    fn eliminated_baselines_leave_the_joint_answer() {
        assert_equal(&conditioned(), &[], 0.0);
    }

    /// Lines of settings at two shares of one drive, some of it known before, are what the readings are one by one.
    #[test]
    fn a_pool_of_lines_is_its_readings() {
        let (mut one_by_one, mut pooled) = (prior(), prior());
        let derivative = |b: usize| if b == 0 { [0.05, -0.02] } else { [0.01, 0.04] };
        let residual = |b: usize, i: usize| 3e-3 + 2e-4 * libm::sinf((7 * b + i) as f32);
        let share = |i: usize| [1.0, -0.9, 0.0, 0.4][i % 4];
        for (b, innovation, h) in readings().into_iter().take(4) {
            one_by_one.condition(b, innovation, VARIANCE, &h);
            pooled.condition(b, innovation, VARIANCE, &h);
        }
        pooled.settle();
        let mut pool = pooled.open([2.9e-3, 0.0]);
        for b in 0..2 {
            let (mut line, level) = (Line::default(), pool.level[b]);
            for i in 0..20 {
                pooled.count(&mut line, share(i), residual(b, i) - level, &SINGLE);
                one_by_one.condition(b, residual(b, i), VARIANCE, &derivative(b).map(|h| share(i) * h));
            }
            pooled.add_line(&mut pool, b, &line, &derivative(b));
        }
        pooled.close(&pool);
        one_by_one.settle();
        let (mut expected, mut solution) = (Solved::BLANK, Solved::BLANK);
        expected.solve(&one_by_one, |_| WIDE);
        solution.solve(&pooled, |_| WIDE);
        for i in 0..2 {
            assert!((solution.delta[i] - expected.delta[i]).abs() < 1e-3 * expected.sigma[i]); // f32 rounding
            assert!((solution.sigma[i] / expected.sigma[i] - 1.0).abs() < 1e-4);
            assert!((pooled.baseline[i] - one_by_one.baseline[i]).abs() < 1e-7);
            assert!((pooled.baseline_variance(i) / one_by_one.baseline_variance(i) - 1.0).abs() < 1e-4);
        }
        assert!((pooled.slope - one_by_one.slope).norm() < 1e-5 * one_by_one.slope.norm());
        assert!(
            (solution.log_evidence - expected.log_evidence).abs() < 0.02,
            "{} {}",
            solution.log_evidence,
            expected.log_evidence
        );
    }

    #[test]
    fn recentring_changes_nothing() {
        let mut gaussian = conditioned();
        let (mut before, mut after) = (Solved::BLANK, Solved::BLANK);
        before.solve(&gaussian, |_| WIDE);
        gaussian.recentre(&[0.01, -0.02]);
        after.solve(&gaussian, |_| WIDE);
        assert_equal(&gaussian, &[], 0.0);
        assert!((before.log_evidence - after.log_evidence).abs() < 1e-2); // cancellation of chi-squares of 1e4 in f32
    }

    #[test]
    fn a_walk_is_a_kalman_prediction() {
        let mut gaussian = prior();
        let mut solution = Solved::BLANK;
        for (i, (b, innovation, h)) in readings().into_iter().enumerate() {
            if i == 10 || i == 25 {
                solution.solve(&gaussian, |_| WIDE);
                gaussian.walk(2e-2, &mut solution);
            }
            gaussian.condition(b, innovation, VARIANCE, &h);
            gaussian.settle();
        }
        assert_equal(&gaussian, &[10, 25], 2e-2);
    }

    /// The evidence is the product of the predictive densities of the readings, one after another.
    #[test]
    fn evidence_is_the_product_of_predictions() {
        let (mut gaussian, mut solution) = (prior(), Solved::BLANK);
        let mut log_density = 0.0;
        for (b, innovation, h) in readings() {
            solution.solve(&gaussian, |_| WIDE);
            let (d, baseline) = gaussian.effective(b, &h);
            let s = VARIANCE + baseline + solution.variance_of(&d);
            let e = innovation - gaussian.baseline(b) - d[0] * solution.delta[0] - d[1] * solution.delta[1];
            log_density -= 0.5 * (e * e / s + libm::logf(core::f32::consts::TAU * s));
            gaussian.condition(b, innovation, VARIANCE, &h);
            gaussian.settle();
        }
        solution.solve(&gaussian, |_| WIDE);
        assert!((solution.log_evidence - log_density).abs() < 0.02, "{} {log_density}", solution.log_evidence); // f32
    }

    #[test]
    fn a_param_beyond_its_range_is_clipped_and_the_other_follows() {
        let narrow = Prior { upper: 0.005, ..WIDE };
        let gaussian = conditioned();
        let mut solution = Solved::BLANK;
        solution.solve(&gaussian, |_| narrow);
        assert_eq!(solution.clipped.as_words(), [0b01]);
        assert_eq!(solution.map_params[0], narrow.upper);
        // at the constrained best point nothing pulls on the free param
        let pull = gaussian.pull(&solution.map_params)[1] / gaussian.information.get(1, 1);
        assert!(pull.abs() < 1e-3 * solution.sigma[1], "{pull}");
    }
}
