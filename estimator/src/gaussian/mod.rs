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

mod baselines;
mod pool;
mod solution;
mod staged;
mod walk;

use crate::linear::{Real, add, add_rounded, difference, dot, dot_difference};
use crate::prior::Prior;
use crate::quarantine::Shift;
use crate::surrogate::Prediction;
use crate::triangle::Triangle;

use crate::state::state;
pub use baselines::{Correlated, Covariance, Independent};
use baselines::{Gain, Moves};
pub use pool::{Line, Pool, Repeats};
pub use solution::Solution;
use staged::Staged;

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

/// Information on `N` params and `B` baselines; `T` entries make a triangle of `N`.
#[derive(Debug, Clone, Copy)]
pub struct Gaussian<const B: usize, const N: usize, const T: usize, V: Covariance<B>> {
    /// Params at which the readings were linearised.
    origin: [f32; N],
    /// Information matrix of the params, baselines eliminated.
    information: Triangle<N, T, f64>,
    /// Information vector of `theta - origin`.
    vector: [f64; N],
    /// Baselines at the origin [m].
    baseline: [f64; B],
    /// How much less baseline a unit of a param leaves [m], a row for each monitor.
    slope: [[V::Slope; N]; B],
    /// Covariance of the baselines, params given [m^2].
    covariance: V,
    /// Chi-square of everything at the origin.
    cost: f64,
    /// `ln` of the product of all variances, those of readings times `2 pi`.
    volume: f64,
}

state!([const B: usize, const N: usize, const T: usize, V: Covariance<B>] Gaussian<B, N, T, V> {
    origin,
    information,
    vector,
    baseline,
    slope,
    covariance,
    cost,
    volume,
});

impl<const B: usize, const N: usize, const T: usize, V: Covariance<B>> Gaussian<B, N, T, V> {
    /// Memory for one, all zero; [`Gaussian::reset`] makes it a distribution.
    pub const BLANK: Self = Self {
        origin: [0.0; N],
        information: Triangle::ZERO,
        vector: [0.0; N],
        baseline: [0.0; B],
        slope: [[V::Slope::ZERO; N]; B],
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
        self.slope = [[V::Slope::ZERO; N]; B];
        self.covariance.set(&core::array::from_fn(|b| square(baseline(b))));
    }

    /// Become what another one is.
    pub fn copy<U: Covariance<B>>(&mut self, other: &Gaussian<B, N, T, U>) {
        (self.origin, self.vector, self.baseline) = (other.origin, other.vector, other.baseline);
        self.information = other.information;
        let each = self.slope.as_flattened_mut().iter_mut().zip(other.slope.as_flattened());
        each.for_each(|(to, from)| *to = V::Slope::nearest(from.double()));
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

    /// Baseline of a monitor at the origin [m].
    pub fn baseline(&self, b: usize) -> f64 {
        self.baseline.get(b).copied().unwrap_or(0.0)
    }

    /// Add the readings of a frame, of one channel each; `own` is what the uncertain linearisation adds to a variance, for a
    /// difference of reading and baseline of this derivative.
    #[inline(never)] // four rows and gains on the stack
    pub fn condition<'h>(&mut self, readings: impl IntoIterator<Item = Reading<'h>>, own: &dyn Fn(&[f64; N]) -> f64) {
        let (mut staged, mut moves) = (Staged::NONE, Moves::NONE);
        for reading in readings {
            self.add_reading(&reading, own, &mut staged, &mut moves);
        }
        self.settle(&mut staged, &mut moves);
    }

    #[inline(never)] // one copy, whatever the readings come from
    fn add_reading(
        &mut self,
        reading: &Reading<'_>,
        own: &dyn Fn(&[f64; N]) -> f64,
        staged: &mut Staged<N>,
        moves: &mut Moves<B>,
    ) {
        let channel = reading.channel;
        let (mut d, baseline_variance) = self.effective(channel, reading.slope);
        moves.wait_for(channel, staged.rows(), staged.count(), |gain, row| add(&mut d, -gain, row));
        let s = f64::from(reading.variance) + own(&d) + baseline_variance;
        let e = f64::from(reading.innovation) - self.baseline(channel);
        add(&mut self.vector, e / s, &d);
        self.cost += e * e / s;
        self.volume += ln_density(s);
        match self.covariance.condition(channel, s) {
            Gain::Own(gain) => self.move_baseline(channel, gain, e, &d),
            Gain::All(gain) => {
                add(&mut self.baseline, e, &gain);
                moves.push(staged.count(), &gain);
            }
        }
        staged.push(&d, 1.0 / s);
        if staged.is_full() {
            self.settle(staged, moves);
        }
    }

    #[inline(never)]
    fn settle(&mut self, staged: &mut Staged<N>, moves: &mut Moves<B>) {
        V::settle(moves, &mut self.slope, staged.rows());
        staged.settle(&mut self.information);
    }

    fn move_baseline(&mut self, b: usize, gain: f64, e: f64, d: &[f64; N]) {
        if let (Some(mean), Some(slope)) = (self.baseline.get_mut(b), self.slope.get_mut(b)) {
            *mean += gain * e;
            add_rounded(slope, gain, d);
        }
    }

    /// Count repeats whose mean has been added as one reading of a variance that is theirs over their number, but for what
    /// they share: their number, and the variance of each. The density of all `n` is that of their mean, over `sqrt(n)`, and the
    /// usual densities of `n - 1`.
    pub fn add_repeats(&mut self, number: u32, variance: f32) {
        let n = f64::from(number);
        self.volume += libm::log(n) + (n - 1.0) * ln_density(variance.into());
    }

    /// Squared deviations of repeats from their means, over their variance; `volume` is what the evidence pays for slopes that made
    /// them smaller, twice.
    pub fn add_scatter(&mut self, chi_square: f64, volume: f64) {
        self.cost += chi_square;
        self.volume += volume;
    }

    /// Variance of a baseline, params given [m^2].
    pub fn baseline_variance(&self, b: usize) -> f64 {
        self.covariance.variance(b)
    }

    /// Let the first `monitors` baselines walk at random by a variance [m^2].
    pub fn spread_baselines(&mut self, variance: f64, monitors: usize) {
        (0..monitors).for_each(|b| self.covariance.spread(b, variance));
    }

    /// The baselines have moved, those of monitors at each of so many times in the cycle; the readings so far move with them.
    pub fn move_baselines(&mut self, shift: &[Shift], times: usize) {
        let each = core::iter::repeat_n(shift, times).flatten();
        for (b, (baseline, shift)) in self.baseline.iter_mut().zip(each).enumerate() {
            *baseline += f64::from(shift.by);
            self.covariance.spread(b, shift.variance.into());
        }
    }

    /// Take the origin as the best point, for all that the readings say.
    pub fn centre(&mut self) {
        self.vector = [0.0; N];
    }

    /// Move the origin without changing the distribution.
    pub fn recentre(&mut self, origin: &[f32; N]) {
        let step = self.step_to(origin);
        let moved = self.information.multiply(&step);
        self.cost += dot(&step, &moved) - 2.0 * dot(&step, &self.vector);
        add(&mut self.vector, -1.0, &moved);
        self.baseline = self.baselines_at(origin);
        self.origin = *origin;
    }

    /// Baselines at some params [m].
    #[inline(never)]
    pub fn baselines_at(&self, params: &[f32; N]) -> [f64; B] {
        let (step, mut baselines) = (self.step_to(params), self.baseline);
        for (mean, slope) in baselines.iter_mut().zip(&self.slope) {
            *mean -= slope.iter().zip(&step).map(|(slope, step)| slope.double() * step).sum::<f64>();
        }
        baselines
    }

    /// Some params, relative to the origin.
    fn step_to(&self, params: &[f32; N]) -> [f64; N] {
        let mut step = [0.0; N];
        difference(params, &self.origin, &mut step);
        step
    }
}

impl<const B: usize, const N: usize, const T: usize, V: Covariance<B>> Gaussian<B, N, T, V> {
    /// Information on each param, the others given.
    pub fn informations(&self) -> [f64; N] {
        core::array::from_fn(|i| self.information.get(i, i))
    }

    /// Downhill pull on the params at a point, relative to the origin: minus half the derivative of chi-square.
    pub fn pull(&self, at: &[f64; N]) -> [f64; N] {
        let mut pull = self.vector;
        add(&mut pull, -1.0, &self.information.multiply(at));
        pull
    }

    /// Derivative of the difference between a reading and its baseline, and the variance of the baseline.
    #[inline(never)]
    pub fn effective(&self, b: usize, h: &[f32]) -> ([f64; N], f64) {
        let mut d = [0.0; N];
        self.slope.get(b).into_iter().for_each(|slope| difference(h, slope, &mut d));
        (d, self.covariance.variance(b))
    }
}

impl<const B: usize, const N: usize, const T: usize, const U: usize> Gaussian<B, N, T, Correlated<B, U>> {
    /// Innovation that is expected of a reading of derivative `h` at params off the origin, and the variance of its baseline.
    pub fn expected(&self, b: usize, h: &[f32], delta: &[f64; N]) -> (f64, f64) {
        let along = self.slope.get(b).map_or(0.0, |slope| dot_difference(h, slope, delta));
        (self.baseline(b) + along, self.covariance.variance(b))
    }

    /// Count what is predicted of the readings at a drive, and its derivative, to the baselines (`sign` 1) or off them (-1), at each of so
    /// many times in the cycle. It says nothing of the params.
    #[inline(never)]
    pub fn absorb<const M: usize, const F: usize>(&mut self, sign: f64, predicted: &Prediction<M, F, N>, times: usize) {
        let rows = predicted.jacobian.as_slice().chunks_exact(N.max(1));
        let each = core::iter::repeat_n(predicted.reading.iter().zip(rows), times).flatten();
        for ((baseline, slope), (reading, row)) in self.baseline.iter_mut().zip(&mut self.slope).zip(each) {
            *baseline += sign * f64::from(*reading);
            slope.iter_mut().zip(row).for_each(|(slope, h)| *slope -= sign * f64::from(*h));
        }
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
    pub(super) const WIDE: Prior = Prior { mean: 0.0, sigma: 0.03, lower: -0.06, upper: 0.06 };

    pub(super) type Solved = Solution<2, 3, 1>;

    /// Readings of two monitors of a ring with two params.
    pub(super) fn readings() -> Vec<(usize, f32, [f32; 2])> {
        (0..40)
            .map(|i| {
                let t = i as f32;
                let h = [0.05 * libm::sinf(t), 0.04 * libm::cosf(1.7 * t)];
                let noise = 1.5e-4 * libm::sinf(12.9 * t);
                (i % 2, 3e-3 + 0.02 * h[0] - 0.01 * h[1] + noise, h)
            })
            .collect()
    }

    pub(super) fn prior() -> Gaussian<2, 2, 3, Correlated<2, 3>> {
        let mut gaussian = Gaussian::BLANK;
        gaussian.reset(|_| WIDE, |_| BASELINE);
        gaussian
    }

    pub(super) const VARIANCE: f32 = 1.5e-4 * 1.5e-4;
    pub(super) fn reading(channel: usize, innovation: f32, slope: &[f32]) -> Reading<'_> {
        Reading { channel, innovation, variance: VARIANCE, slope }
    }

    fn conditioned() -> Gaussian<2, 2, 3, Correlated<2, 3>> {
        let mut gaussian = prior();
        for (b, innovation, h) in readings() {
            gaussian.condition([reading(b, innovation, &h)], &|_| 0.0);
        }
        gaussian
    }

    /// Standard deviations by which the params move before some readings.
    type Moves<'m> = &'m [(usize, [f64; 2])];

    /// The same by brute force: params and baselines as four unknowns, in f64; and `ln` of the product of the predictive densities.
    fn batch(moves: Moves) -> (Vector4<f64>, Matrix4<f64>, f64) {
        let (prior, base) = (square(WIDE.sigma), square(BASELINE));
        let mut p = Matrix4::from_diagonal(&Vector4::new(prior, prior, base, base));
        let (mut x, mut log_density) = (Vector4::zeros(), 0.0);
        for (i, (b, innovation, h)) in readings().into_iter().enumerate() {
            for (_, sigma) in moves.iter().filter(|(at, _)| *at == i) {
                p[(0, 0)] += sigma[0] * sigma[0];
                p[(1, 1)] += sigma[1] * sigma[1];
            }
            let mut row = Vector4::new(f64::from(h[0]), f64::from(h[1]), 0.0, 0.0);
            row[2 + b] = 1.0;
            let variance = (row.transpose() * p * row)[0] + f64::from(VARIANCE);
            let (gain, e) = (p * row / variance, f64::from(innovation) - row.dot(&x));
            x += gain * e;
            p -= gain * (row.transpose() * p);
            log_density -= 0.5 * (e * e / variance + ln_density(variance));
        }
        (x, p, log_density)
    }

    fn assert_equal(gaussian: &Gaussian<2, 2, 3, Correlated<2, 3>>, moves: Moves) {
        let mut solution = Solved::BLANK;
        assert!(solution.solve(gaussian, |_| WIDE));
        let (x, p, log_density) = batch(moves);
        assert!((solution.log_evidence - log_density).abs() < 1e-9, "{} {log_density}", solution.log_evidence);
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
        assert_equal(&conditioned(), &[]);
    }

    #[test]
    fn recentring_changes_nothing() {
        let mut gaussian = conditioned();
        let (mut before, mut after) = (Solved::BLANK, Solved::BLANK);
        before.solve(&gaussian, |_| WIDE);
        gaussian.recentre(&[0.01, -0.02]);
        after.solve(&gaussian, |_| WIDE);
        assert_equal(&gaussian, &[]);
        assert!((before.log_evidence - after.log_evidence).abs() < 1e-9);
    }

    /// The readings, with something done to the params before some of them.
    fn conditioned_with(
        moves: Moves,
        mut act: impl FnMut(&mut Gaussian<2, 2, 3, Correlated<2, 3>>, &mut Solved, [f64; 2]),
    ) {
        let (mut gaussian, mut solution) = (prior(), Solved::BLANK);
        for (i, (b, innovation, h)) in readings().into_iter().enumerate() {
            for (_, sigma) in moves.iter().filter(|(at, _)| *at == i) {
                solution.solve(&gaussian, |_| WIDE);
                act(&mut gaussian, &mut solution, *sigma);
            }
            gaussian.condition([reading(b, innovation, &h)], &|_| 0.0);
        }
        assert_equal(&gaussian, moves);
    }

    #[test]
    fn a_walk_is_a_kalman_prediction() {
        let moves = [(10, [2e-2, 1e-2]), (25, [1e-3, 2e-2])];
        conditioned_with(&moves, |gaussian, solution, sigma| gaussian.walk(&sigma, solution));
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
        let pull = gaussian.pull(&gaussian.step_to(&solution.map_params))[1] / gaussian.information.get(1, 1);
        assert!(pull.abs() < 1e-3 * f64::from(solution.sigma[1]), "{pull}");
    }

    /// A million readings are as exact as one: their information is that of the sum.
    #[test]
    fn a_million_readings_lose_nothing() {
        let mut gaussian = Gaussian::<1, 1, 1, Independent<1, f64>>::BLANK;
        gaussian.reset(|_| WIDE, |_| BASELINE);
        let n = 500_000;
        for _ in 0..n {
            gaussian.condition([reading(0, 1e-4, &[0.03]), reading(0, -1e-4, &[-0.03])], &|_| 0.0);
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
