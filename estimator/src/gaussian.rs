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
//! All of this is in double precision, since it is a sum over all frames. In single precision the information of a stream of
//! several correctors a frame stopped being positive after 165,000 to 240,000 frames, and sigma was 12 % wrong after 100,000.
//! A square-root filter in single precision was off by 0.11 sigma there; a Cortex-M7 adds doubles in hardware, and a chip that
//! does not gets the same bits more slowly.
//!
//! Source: the square completion behind the Schur complement, e.g. A. Gelb, Applied Optimal Estimation (1974), ch. 4.

use nalgebra::SMatrix;

use crate::linear::{add, column, dot, zeros};
use crate::mask::Mask;
use crate::prior::Prior;
use crate::triangle::Triangle;

/// Readings of one monitor at settings of one kind: at the share `x` of a drive whose derivative is `h`,
/// `residual = x h . delta + baseline + noise`. Its fields are sums of precision times `1, x, x^2, residual, x residual`.
#[derive(Debug, Clone, Copy, Default)]
pub struct Line {
    one: f64,
    x: f64,
    xx: f64,
    r: f64,
    xr: f64,
}

/// A reading, linearised.
#[derive(Debug, Clone, Copy)]
pub struct Reading<'h> {
    /// Of which monitor, or of which tune.
    pub channel: usize,
    /// Measured minus predicted, before the baseline [m].
    pub innovation: f32,
    /// Its variance [m^2].
    pub variance: f32,
    /// Its derivative `h` [m].
    pub slope: &'h [f32],
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
pub struct Pool<const B: usize, const N: usize> {
    /// Baselines from which residuals are counted [m].
    level: [f64; B],
    precision: [f64; B],
    /// Sum of precision times residual.
    pull: [f64; B],
    staged: Staged<N>,
}

/// Rows that wait to enter the information, with their weights: four at a time cost half of four alone.
#[derive(Debug, Clone)]
struct Staged<const N: usize> {
    rows: [[f64; N]; 4],
    weight: [f64; 4],
    count: usize,
}

impl<const N: usize> Staged<N> {
    const NONE: Self = Self { rows: [[0.0; N]; 4], weight: [0.0; 4], count: 0 };

    /// `information += weight row row^T`, now or later.
    fn push<const T: usize>(&mut self, row: &[f64; N], weight: f64, information: &mut Triangle<N, T, f64>) {
        if let (Some(to), Some(its)) = (self.rows.get_mut(self.count), self.weight.get_mut(self.count)) {
            (*to, *its) = (*row, weight);
        }
        self.count += 1;
        if self.count >= self.rows.len() {
            self.settle(information);
        }
    }

    /// Let all that wait enter.
    fn settle<const T: usize>(&mut self, information: &mut Triangle<N, T, f64>) {
        // what is left of a group of four has no weight
        self.weight.iter_mut().skip(self.count).for_each(|weight| *weight = 0.0);
        let rows = self.rows.each_ref().map(<[f64; N]>::as_slice);
        let factors = |j: usize| {
            let mut factors = self.weight;
            factors.iter_mut().zip(&rows).for_each(|(w, row)| *w *= row.get(j).copied().unwrap_or(0.0));
            factors
        };
        information.add_products(factors, rows);
        self.count = 0;
    }
}

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

    /// Take a reading of monitor `b` off, of innovation variance `s`. Returns the gain of each baseline from `from` on.
    fn condition(&mut self, b: usize, s: f64) -> Gain<B>;
}

/// What a reading moves each baseline by, per unit of innovation: those from `from` up to `to`, the others by 0.
#[derive(Debug, Clone, Copy)]
pub struct Gain<const B: usize> {
    gain: [f64; B],
    from: usize,
    to: usize,
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

/// Information on `N` params and `B` baselines; `T` entries make a triangle of `N`.
#[derive(Debug, Clone, Copy)]
pub struct Gaussian<const B: usize, const N: usize, const T: usize, V = Correlated<B>> {
    /// Params at which the readings were linearised.
    origin: [f32; N],
    /// Information matrix of the params, baselines eliminated.
    information: Triangle<N, T, f64>,
    /// Information vector of `theta - origin`.
    vector: [f64; N],
    /// Baselines at the origin [m].
    baseline: [f64; B],
    /// How much less baseline a unit of a param leaves [m], one column a monitor.
    slope: SMatrix<f64, N, B>,
    /// Covariance of the baselines, params given [m^2].
    covariance: V,
    /// Chi-square of everything at the origin.
    cost: f64,
    /// `ln` of the product of all variances, those of readings times `2 pi`.
    volume: f64,
}

impl<const B: usize, const N: usize, const T: usize, V: Covariance<B>> Gaussian<B, N, T, V> {
    /// Memory for one, all zero; [`Gaussian::reset`] makes it a distribution.
    pub const BLANK: Self = Self {
        origin: [0.0; N],
        information: Triangle::ZERO,
        vector: [0.0; N],
        baseline: [0.0; B],
        slope: zeros(),
        covariance: V::ZERO,
        cost: 0.0,
        volume: 0.0,
    };

    /// The prior alone, its mean the origin: that of each param, and the standard deviation of each baseline.
    pub fn reset(&mut self, prior: impl Fn(usize) -> Prior, baseline: impl Fn(usize) -> f32) {
        (self.cost, self.volume) = (0.0, 0.0);
        self.information.fill_diagonal(0.0);
        for (i, (row, origin)) in self.information.rows_mut().zip(&mut self.origin).enumerate() {
            let Prior { mean, sigma, .. } = prior(i);
            let precision = 1.0 / square(sigma);
            *origin = mean;
            row.last_mut().into_iter().for_each(|diagonal| *diagonal = precision);
            self.volume -= libm::log(precision);
        }
        self.vector = [0.0; N];
        self.baseline = [0.0; B];
        self.slope.fill(0.0);
        self.covariance.set(&core::array::from_fn(|b| square(baseline(b))));
    }

    /// Become what another one is.
    pub fn copy<U: Covariance<B>>(&mut self, other: &Gaussian<B, N, T, U>) {
        (self.origin, self.vector, self.baseline) = (other.origin, other.vector, other.baseline);
        (self.information, self.slope) = (other.information, other.slope);
        (self.cost, self.volume) = (other.cost, other.volume);
        self.covariance.set(&other.covariance.variances());
    }

    /// Params at which innovations are to be formed.
    pub fn origin(&self) -> &[f32; N] {
        &self.origin
    }

    /// Chi-square at the origin, prior included, baselines at their best.
    pub fn cost(&self) -> f64 {
        self.cost
    }

    /// Rms of the baselines of monitors `from..to` [m].
    pub fn orbit(&self, from: usize, to: usize) -> f32 {
        let baselines = self.baseline.get(from..to).unwrap_or_default();
        libm::sqrt(dot(baselines, baselines) / baselines.len().max(1) as f64) as f32
    }

    /// Baselines at the origin [m].
    pub fn baselines(&self) -> &[f64; B] {
        &self.baseline
    }

    /// Baseline of a monitor at the origin [m].
    pub fn baseline(&self, b: usize) -> f64 {
        self.baseline.get(b).copied().unwrap_or(0.0)
    }

    /// Add the readings of a frame, of one channel each; `own` is what the uncertain linearisation adds to a variance, for a
    /// difference of reading and baseline of this derivative.
    pub fn condition<'h>(&mut self, readings: impl IntoIterator<Item = Reading<'h>>, own: impl Fn(&[f64; N]) -> f64) {
        let mut staged = Staged::NONE;
        for Reading { channel, innovation, variance, slope } in readings {
            let (d, baseline_variance) = self.effective(channel, slope);
            let s = f64::from(variance) + own(&d) + baseline_variance;
            let e = f64::from(innovation) - self.baseline(channel);
            staged.push(&d, 1.0 / s, &mut self.information);
            add(&mut self.vector, e / s, &d);
            self.cost += e * e / s;
            self.volume += ln_density(s);
            self.learn_baselines(channel, &d, e, s);
        }
        staged.settle(&mut self.information);
    }

    /// Move the baselines: without process noise that of monitor `b` alone, else all, for they are correlated.
    fn learn_baselines(&mut self, b: usize, d: &[f64; N], e: f64, s: f64) {
        let Gain { gain, from, to } = self.covariance.condition(b, s);
        let slopes = self.slope.as_mut_slice().chunks_exact_mut(N);
        let each = self.baseline.iter_mut().zip(slopes).zip(&gain);
        for ((mean, slope), g) in each.skip(from).take(to - from) {
            *mean += g * e;
            add(slope, *g, d);
        }
    }

    /// Begin to take in many readings at once; their residuals are counted from the baselines `level` [m].
    ///
    /// Where [`Gaussian::condition`] takes one product of rows a reading, this takes one a line and two a monitor:
    ///
    /// `information += sum of x^2/s h h^T - (sum of x/s h)(sum of x/s h)^T / (sum of 1/s)`.
    pub fn open(&mut self, level: [f64; B]) -> Pool<B, N> {
        let mut pool = Pool { level, precision: [0.0; B], pull: [0.0; B], staged: Staged::NONE };
        for b in 0..B {
            // what is known of a baseline is one more reading
            let mut h = [0.0; N];
            if let Some(slope) = self.slope.as_mut_slice().as_chunks_mut::<N>().0.get_mut(b) {
                h = core::mem::replace(slope, h);
            }
            let precision = 1.0 / self.covariance.variance(b);
            let r = self.baseline(b) - pool.level.get(b).copied().unwrap_or(0.0);
            self.cost += precision * r * r;
            let line = Line { one: precision, x: precision, xx: precision, r: precision * r, xr: precision * r };
            self.add_line_of(&mut pool, b, &line, &h);
        }
        pool
    }

    /// Count the mean of repeats into a line: its residual [m] at the share `x`.
    ///
    /// The density of all `n` repeats is that of their mean, times `n` and the usual densities of `n - 1` (and what their
    /// scatter adds, [`Gaussian::add_scatter`]).
    pub fn count(&mut self, line: &mut Line, x: f32, residual: f64, repeats: &Repeats) {
        let (one, x) = (1.0 / f64::from(repeats.variance), f64::from(x));
        let r = residual * one;
        line.one += one;
        line.x += one * x;
        line.xx += one * x * x;
        line.r += r;
        line.xr += r * x;
        self.cost += r * residual;
        let n = f64::from(repeats.number);
        self.volume += ln_density(n * f64::from(repeats.variance)) + (n - 1.0) * ln_density(repeats.noise.into());
    }

    /// Add a line of monitor `b`.
    pub fn add_line(&mut self, pool: &mut Pool<B, N>, b: usize, line: &Line, h: &[f32; N]) {
        self.add_line_of(pool, b, line, &h.map(f64::from));
    }

    fn add_line_of(&mut self, pool: &mut Pool<B, N>, b: usize, line: &Line, h: &[f64; N]) {
        let (Some(precision), Some(pull)) = (pool.precision.get_mut(b), pool.pull.get_mut(b)) else { return };
        *precision += line.one;
        *pull += line.r;
        if h.iter().any(|h| *h != 0.0) {
            pool.staged.push(h, line.xx, &mut self.information);
            add(&mut self.vector, line.xr, h);
            let slopes = self.slope.as_mut_slice().as_chunks_mut::<N>().0;
            slopes.get_mut(b).into_iter().for_each(|slope| add(slope, line.x, h));
        }
    }

    /// Eliminate the baselines from what a pool has taken in.
    pub fn close(&mut self, pool: &mut Pool<B, N>) {
        let Pool { level, precision, pull, staged } = pool;
        let mut variances = [0.0; B];
        let slopes = self.slope.as_mut_slice().as_chunks_mut::<N>().0.iter_mut();
        let each = slopes.zip(self.baseline.iter_mut().zip(&mut variances));
        let sums = precision.iter().zip(pull.iter().zip(level.iter())).enumerate();
        for ((slope, (baseline, variance)), (b, (precision, (pull, level)))) in each.zip(sums) {
            slope.iter_mut().for_each(|sum| *sum /= precision);
            let mean = pull / precision;
            staged.push(slope, -precision, &mut self.information);
            add(&mut self.vector, -pull, slope);
            self.cost -= pull * mean;
            self.volume += libm::log(precision * self.covariance.variance(b));
            (*baseline, *variance) = (level + mean, 1.0 / precision);
        }
        self.covariance.set(&variances);
        staged.settle(&mut self.information);
    }

    /// Count repeats whose mean has been added as one reading of a variance that is theirs over their number, but for what
    /// they share: their number, and the variance of each. The density of all `n` is that of their mean, over `sqrt(n)`, and the
    /// usual densities of `n - 1`.
    pub fn add_repeats(&mut self, number: u32, variance: f32) {
        let n = f64::from(number);
        self.volume += libm::log(n) + (n - 1.0) * ln_density(variance.into());
    }

    /// Squared deviations of repeats from their means, over their variance.
    pub fn add_scatter(&mut self, chi_square: f64) {
        self.cost += chi_square;
    }

    /// The baselines have moved by so much [m], those of monitors; the readings so far move with them.
    pub fn move_baselines(&mut self, shift: &[f32]) {
        self.baseline.iter_mut().zip(shift).for_each(|(baseline, by)| *baseline += f64::from(*by));
    }

    /// Move the origin without changing the distribution.
    pub fn recentre(&mut self, origin: &[f32; N]) {
        let mut step = [0.0; N];
        let each = step.iter_mut().zip(origin.iter().zip(&self.origin));
        each.for_each(|(s, (to, from))| *s = f64::from(*to) - f64::from(*from));
        let moved = self.information.multiply(&step);
        self.cost += dot(&step, &moved) - 2.0 * dot(&step, &self.vector);
        add(&mut self.vector, -1.0, &moved);
        for (mean, slope) in self.baseline.iter_mut().zip(self.slope.as_slice().chunks_exact(N)) {
            *mean -= dot(slope, &step);
        }
        self.origin = *origin;
    }
}

impl<const B: usize, const N: usize, const T: usize> Gaussian<B, N, T> {
    /// Let every param walk at random by `sigma`: `P += sigma^2`, baselines stay.
    ///
    /// With `K = (1 + sigma^2 Y)^-1`: `Y <- K Y`, `slope <- K slope`, `covariance += sigma^2 slope^T K slope`.
    /// `solution` is that of this Gaussian and serves as work space.
    pub fn walk<const W: usize>(&mut self, sigma: f32, solution: &mut Solution<N, T, W>) {
        let variance = square(sigma);
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
        self.covariance.walked = true;
        // the best point and its chi-square stay
        let best = self.cost - dot(&self.vector, &mean);
        self.vector = self.information.multiply(&mean);
        self.cost = best + dot(&self.vector, &mean);
    }

    /// Slopes, covariance and, so that the best point stays, baselines; `K = L^-T L^-1`.
    fn walk_baselines(&mut self, variance: f64, k: &Triangle<N, T, f64>, mean: &[f64; N]) {
        for (baseline, slope) in self.baseline.iter_mut().zip(self.slope.as_mut_slice().as_chunks_mut::<N>().0) {
            *baseline -= dot(slope, mean);
            k.solve_lower(slope);
        }
        let half = self.slope.as_slice().chunks_exact(N);
        for (column, one) in self.covariance.matrix.as_mut_slice().chunks_exact_mut(B).zip(half.clone()) {
            column.iter_mut().zip(half.clone()).for_each(|(c, other)| *c += variance * dot(one, other));
        }
        for (baseline, slope) in self.baseline.iter_mut().zip(self.slope.as_mut_slice().as_chunks_mut::<N>().0) {
            k.solve_upper(slope);
            *baseline += dot(slope, mean);
        }
    }
}

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
    /// Inverse of the information's lower Cholesky factor, `P = X^T X`.
    factor: Triangle<N, T, f64>,
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

    /// Solve a Gaussian. True if its information was positive as it stands; else the diagonal is enlarged by as little as makes
    /// it so, and where nothing does, the solution is the prior: whatever happens, it is a whole one.
    pub fn solve<const B: usize>(&mut self, gaussian: &Gaussian<B, N, T>, prior: impl Fn(usize) -> Prior) -> bool {
        const { assert!(W >= crate::mask::words(N), "W words have a bit for each param") };
        let mut tried = 0;
        let factorised = SUPPORT.into_iter().find_map(|more| {
            tried += 1;
            self.factor = gaussian.information;
            self.factor.rows_mut().filter_map(<[f64]>::last_mut).for_each(|diagonal| *diagonal *= 1.0 + more);
            self.factor.factorise()
        });
        let log_determinant = factorised.unwrap_or_else(|| self.forget(gaussian, &prior));
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
        self.log_evidence = -0.5 * (self.cost + gaussian.volume + log_determinant);
        self.bound(gaussian, prior);
        tried == 1
    }

    /// The prior as a solution; returns the logarithm of the determinant of its information.
    #[cold]
    fn forget<const B: usize>(&mut self, gaussian: &Gaussian<B, N, T>, prior: impl Fn(usize) -> Prior) -> f64 {
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
    fn bound<const B: usize>(&mut self, gaussian: &Gaussian<B, N, T>, prior: impl Fn(usize) -> Prior) {
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

    /// Variance of a prediction with derivative `h`: `h^T P h`.
    pub fn variance_of(&self, h: &[f64; N]) -> f64 {
        let image = |row: &[f64]| {
            let x = dot(row, h);
            x * x
        };
        self.factor.rows().map(image).sum()
    }
}

impl<const B: usize, const N: usize, const T: usize, V: Covariance<B>> Gaussian<B, N, T, V> {
    /// Downhill pull on the params at a point: minus half the derivative of chi-square.
    fn pull(&self, at: &[f32; N]) -> [f64; N] {
        let mut step = at.map(f64::from);
        step.iter_mut().zip(&self.origin).for_each(|(step, origin)| *step -= f64::from(*origin));
        let mut pull = self.vector;
        add(&mut pull, -1.0, &self.information.multiply(&step));
        pull
    }

    /// Derivative of the difference between a reading and its baseline, and the variance of the baseline.
    pub fn effective(&self, b: usize, h: &[f32]) -> ([f64; N], f64) {
        let mut d = [0.0; N];
        let slope = column(self.slope.as_slice(), N, b);
        d.iter_mut().zip(h).zip(slope).for_each(|((d, h), slope)| *d = f64::from(*h) - slope);
        (d, self.covariance.variance(b))
    }
}

/// The square of a number of single precision.
fn square(of: f32) -> f64 {
    f64::from(of) * f64::from(of)
}

/// `ln(2 pi s)`: minus twice the logarithm of a normal density of variance `s` at its mean.
fn ln_density(s: f64) -> f64 {
    libm::log(core::f64::consts::TAU * s)
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
    fn reading(channel: usize, innovation: f32, slope: &[f32]) -> Reading<'_> {
        Reading { channel, innovation, variance: VARIANCE, slope }
    }

    const SINGLE: Repeats = Repeats { number: 1, noise: VARIANCE, variance: VARIANCE };

    fn conditioned() -> Gaussian<2, 2, 3> {
        let mut gaussian = prior();
        for (b, innovation, h) in readings() {
            gaussian.condition([reading(b, innovation, &h)], |_| 0.0);
        }
        gaussian
    }

    /// The same by brute force: params and baselines as four unknowns, in f64.
    fn batch(walks: &[usize], walk: f64) -> (Vector4<f64>, Matrix4<f64>) {
        let (prior, base) = (square(WIDE.sigma), square(BASELINE));
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
            let theta = f64::from(gaussian.origin[i]) + solution.delta[i];
            assert!((theta - x[i]).abs() < 1e-9 * sigma, "{theta} {}", x[i]);
            assert!((f64::from(solution.sigma[i]) / sigma - 1.0).abs() < 1e-6); // f32
        }
        assert!((solution.covariance(0, 1) - p[(0, 1)]).abs() < 1e-9 * p[(0, 0)]);
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
            one_by_one.condition([reading(b, innovation, &h)], |_| 0.0);
            pooled.condition([reading(b, innovation, &h)], |_| 0.0);
        }
        let mut pool = pooled.open([2.9e-3, 0.0]);
        for b in 0..2 {
            let (mut line, level) = (Line::default(), pool.level[b]);
            for i in 0..20 {
                pooled.count(&mut line, share(i), f64::from(residual(b, i)) - level, &SINGLE);
                let h = derivative(b).map(|h| share(i) * h);
                one_by_one.condition([reading(b, residual(b, i), &h)], |_| 0.0);
            }
            pooled.add_line(&mut pool, b, &line, &derivative(b));
        }
        pooled.close(&mut pool);
        let (mut expected, mut solution) = (Solved::BLANK, Solved::BLANK);
        expected.solve(&one_by_one, |_| WIDE);
        solution.solve(&pooled, |_| WIDE);
        for i in 0..2 {
            // shares times derivatives are rounded to f32
            assert!((solution.delta[i] - expected.delta[i]).abs() < 1e-5 * f64::from(expected.sigma[i]));
            assert!((solution.sigma[i] / expected.sigma[i] - 1.0).abs() < 1e-6);
            assert!((pooled.baseline[i] - one_by_one.baseline[i]).abs() < 1e-10);
            let variances = [&pooled, &one_by_one].map(|gaussian| gaussian.covariance.variance(i));
            assert!((variances[0] / variances[1] - 1.0).abs() < 1e-9);
        }
        assert!((pooled.slope - one_by_one.slope).norm() < 1e-6 * one_by_one.slope.norm());
        let gap = solution.log_evidence - expected.log_evidence;
        assert!(gap.abs() < 1e-4, "{gap}");
    }

    #[test]
    fn recentring_changes_nothing() {
        let mut gaussian = conditioned();
        let (mut before, mut after) = (Solved::BLANK, Solved::BLANK);
        before.solve(&gaussian, |_| WIDE);
        gaussian.recentre(&[0.01, -0.02]);
        after.solve(&gaussian, |_| WIDE);
        assert_equal(&gaussian, &[], 0.0);
        assert!((before.log_evidence - after.log_evidence).abs() < 1e-9);
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
            gaussian.condition([reading(b, innovation, &h)], |_| 0.0);
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
            let s = f64::from(VARIANCE) + baseline + solution.variance_of(&d);
            let e = f64::from(innovation) - gaussian.baseline(b) - d[0] * solution.delta[0] - d[1] * solution.delta[1];
            log_density -= 0.5 * (e * e / s + ln_density(s));
            gaussian.condition([reading(b, innovation, &h)], |_| 0.0);
        }
        solution.solve(&gaussian, |_| WIDE);
        assert!((solution.log_evidence - log_density).abs() < 1e-9, "{} {log_density}", solution.log_evidence);
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
        assert!(pull.abs() < 1e-3 * f64::from(solution.sigma[1]), "{pull}");
    }

    /// A million readings are as exact as one: their information is that of the sum.
    #[test]
    fn a_million_readings_lose_nothing() {
        let mut gaussian = Gaussian::<1, 1, 1, Independent<1>>::BLANK;
        gaussian.reset(|_| WIDE, |_| BASELINE);
        let n = 500_000;
        for _ in 0..n {
            gaussian.condition([reading(0, 1e-4, &[0.03]), reading(0, -1e-4, &[-0.03])], |_| 0.0);
        }
        let precision = 1.0 / f64::from(VARIANCE);
        let expected = 1.0 / square(WIDE.sigma) + 2.0 * f64::from(n) * square(0.03) * precision;
        assert!((gaussian.information.get(0, 0) / expected - 1.0).abs() < 1e-9);
        let baseline = 1.0 / (1.0 / square(BASELINE) + 2.0 * f64::from(n) * precision);
        assert!((gaussian.covariance.variance(0) / baseline - 1.0).abs() < 1e-9);
        assert!((gaussian.cost / (2.0 * f64::from(n) * square(1e-4) * precision) - 1.0).abs() < 1e-9);
    }

    /// Information that no rounding explains: the solution is the prior, and whole.
    #[test]
    fn what_cannot_be_solved_gives_the_prior() {
        let (mut gaussian, mut solution) = (conditioned(), Solved::BLANK);
        assert!(solution.solve(&gaussian, |_| WIDE));
        gaussian.information.fill_diagonal(-1.0);
        assert!(!solution.solve(&gaussian, |_| WIDE));
        assert_eq!((solution.sigma, solution.map_params), ([WIDE.sigma; 2], [WIDE.mean; 2]));
        assert_eq!((solution.covariance(0, 0), solution.covariance(0, 1)), (square(WIDE.sigma), 0.0));
    }
}
