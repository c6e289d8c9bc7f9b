//! Many readings at once: settings of one kind share one derivative, and each monitor one baseline.

use super::{Covariance, Gaussian, Staged, ln_density};
use crate::linear::{Real, add, add_rounded, column};

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
    pub level: [f64; B],
    precision: [f64; B],
    /// Sum of precision times residual.
    pull: [f64; B],
}

impl<const B: usize> Pool<B> {
    /// Memory for one, all zero.
    pub const BLANK: Self = Self { level: [0.0; B], precision: [0.0; B], pull: [0.0; B] };
}

impl<const B: usize, const N: usize, const T: usize, V: Covariance<B>> Gaussian<B, N, T, V> {
    /// Begin to take in many readings at once; their residuals are counted from the baselines `level` [m].
    ///
    /// Where [`Gaussian::condition`] takes one product of rows a reading, this takes one a line and two a monitor:
    ///
    /// `information += sum of x^2/s h h^T - (sum of x/s h)(sum of x/s h)^T / (sum of 1/s)`.
    pub fn open(&mut self, pool: &mut Pool<B>, level: [f64; B]) {
        *pool = Pool { level, ..Pool::BLANK };
        let mut staged = Staged::NONE;
        for b in 0..B {
            // what is known of a baseline is one more reading
            let mut h = [0.0; N];
            if let Some(slope) = self.slope.get_mut(b) {
                h = core::mem::replace(slope, [V::Slope::ZERO; N]).map(Real::double);
            }
            let precision = 1.0 / self.covariance.variance(b);
            let r = self.baseline(b) - pool.level.get(b).copied().unwrap_or(0.0);
            self.cost += precision * r * r;
            let line = Line { one: precision, x: precision, xx: precision, r: precision * r, xr: precision * r };
            self.add_line(pool, &mut staged, b, &line, &h);
        }
        staged.settle(&mut self.information);
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

    /// Add lines, one of each monitor, whose derivatives are the columns of `h`; that of the first is of this channel.
    #[inline(never)]
    pub fn add_lines(&mut self, pool: &mut Pool<B>, first_channel: usize, lines: &[Line], h: &[f32]) {
        let mut staged = Staged::NONE;
        for (b, line) in lines.iter().enumerate().filter(|(_, line)| line.one > 0.0) {
            let mut of_line = [0.0; N];
            of_line.iter_mut().zip(column(h, N, b)).for_each(|(to, h)| *to = f64::from(*h));
            self.add_line(pool, &mut staged, first_channel + b, line, &of_line);
        }
        staged.settle(&mut self.information);
    }

    fn add_line(&mut self, pool: &mut Pool<B>, staged: &mut Staged<N>, b: usize, line: &Line, h: &[f64; N]) {
        let (Some(precision), Some(pull)) = (pool.precision.get_mut(b), pool.pull.get_mut(b)) else { return };
        *precision += line.one;
        *pull += line.r;
        if h.iter().any(|h| *h != 0.0) {
            self.stage(staged, h, line.xx);
            add(&mut self.vector, line.xr, h);
            self.slope.get_mut(b).into_iter().for_each(|sum| add_rounded(sum, line.x, h));
        }
    }

    fn stage(&mut self, staged: &mut Staged<N>, row: &[f64; N], weight: f64) {
        staged.push(row, weight);
        if staged.is_full() {
            staged.settle(&mut self.information);
        }
    }

    /// Eliminate the baselines from what a pool has taken in.
    pub fn close(&mut self, pool: &Pool<B>) {
        let Pool { level, precision, pull } = pool;
        let (mut variances, mut staged) = (*precision, Staged::NONE);
        for (b, (precision, (pull, level))) in precision.iter().zip(pull.iter().zip(level)).enumerate() {
            let Some(sum) = self.slope.get_mut(b) else { continue };
            let slope = sum.map(|sum| sum.double() / precision);
            *sum = slope.map(V::Slope::nearest);
            let mean = pull / precision;
            self.stage(&mut staged, &slope, -precision);
            add(&mut self.vector, -pull, &slope);
            self.cost -= pull * mean;
            self.volume += libm::log(precision * self.covariance.variance(b));
            self.baseline.get_mut(b).into_iter().for_each(|baseline| *baseline = level + mean);
        }
        variances.iter_mut().for_each(|variance| *variance = 1.0 / *variance);
        self.covariance.set(&variances);
        staged.settle(&mut self.information);
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{Solved, VARIANCE, WIDE, prior, reading, readings};
    use super::*;

    const SINGLE: Repeats = Repeats { number: 1, noise: VARIANCE, variance: VARIANCE };

    /// Lines of settings at two shares of one drive, some of it known before, are what the readings are one by one.
    #[test]
    fn a_pool_of_lines_is_its_readings() {
        let (mut one_by_one, mut pooled) = (prior(), prior());
        let derivative = |b: usize| if b == 0 { [0.05, -0.02] } else { [0.01, 0.04] };
        let residual = |b: usize, i: usize| 3e-3 + 2e-4 * libm::sinf((7 * b + i) as f32);
        let share = |i: usize| [1.0, -0.9, 0.0, 0.4][i % 4];
        for (b, innovation, h) in readings().into_iter().take(4) {
            one_by_one.condition([reading(b, innovation, &h)], &|_| 0.0);
            pooled.condition([reading(b, innovation, &h)], &|_| 0.0);
        }
        let mut pool = Pool::BLANK;
        pooled.open(&mut pool, [2.9e-3, 0.0]);
        let mut lines = [Line::default(); 2];
        for (b, line) in lines.iter_mut().enumerate() {
            let level = pool.level[b];
            for i in 0..20 {
                pooled.count(line, share(i), f64::from(residual(b, i)) - level, &SINGLE);
                let h = derivative(b).map(|h| share(i) * h);
                one_by_one.condition([reading(b, residual(b, i), &h)], &|_| 0.0);
            }
        }
        pooled.add_lines(&mut pool, 0, &lines, &[derivative(0), derivative(1)].concat());
        pooled.close(&pool);
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
        let each = pooled.slope.as_flattened().iter().zip(one_by_one.slope.as_flattened());
        let (off, all) = each.fold((0.0, 0.0), |sum, (a, b)| (sum.0 + (a - b) * (a - b), sum.1 + b * b));
        assert!(off < 1e-12 * all);
        let gap = solution.log_evidence - expected.log_evidence;
        assert!(gap.abs() < 1e-4, "{gap}");
    }
}
