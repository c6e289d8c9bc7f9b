//! Noise with a memory: white, slow and wandering.
//!
//! In units of its standard deviation the noise of a monitor in frame k is `white + slow + walk`, of variances
//!
//! `1 - share`; `share`, correlation `exp(-|k - l|/time)` between frames k and l; and `steps^2` for each frame that the walk goes on.
//!
//! Whitening is the Kalman filter of these two states: with the noise expected from the frames before, `m`, and its variance, `F`, the
//! innovations `(e - m)/sqrt F` are independent and of variance 1, and the determinant of the covariance is the product of all `F`. It
//! is a linear map and costs a few operations a frame. White and slow noise are larger by the level of the frame ([`Levels`]), the walk is not. Frames without a reading that counts are gaps.
//!
//! The mean over a pool of frames sees states of several frames: the later pools by its covariance `V` with the states in its last frame, the earlier
//! ones by the part `U` that the states in its first frame have in it. With `S` what the pools before tell of these states, a variance, and `A` the mean's own,
//! `F = A - U^T S U` and the gain is `(V - S' U)/F`, `S'` carried to the last frame (D. Foreman-Mackey et al., Astron. J. 154 (2017) 220, sect. 5). A pool of one frame is the Kalman filter.
//!
//! Source: A. C. Harvey, Forecasting, Structural Time Series Models and the Kalman Filter (1989), ch. 3.4; J. Durbin and
//! S. J. Koopman, Time Series Analysis by State Space Methods (2012), ch. 4.3 and 4.4.

use nalgebra::{DMatrix, Matrix2, Vector2};

use super::levels::Levels;

/// What of a monitor's noise remembers the frames before.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Memory {
    /// Share of the noise's variance that is slow [1].
    pub share: f64,
    /// Correlation time of the slow noise [frames].
    pub time: f64,
    /// Random walk, in standard deviations of the noise, per root frame.
    pub steps: f64,
}

/// The filter of one monitor, over pools of the frames in which its reading counts.
#[derive(Debug, Clone)]
pub struct Filter {
    steps: Vec<Step>,
}

/// One pool of the filter.
#[derive(Debug, Clone, Copy)]
struct Step {
    /// What is left in its first frame of the slow noise in the last one before, and in its last frame of that in its first.
    decay: [f64; 2],
    /// Share of the slow noise in its first frame that its mean has.
    level: f64,
    /// Share of an innovation that goes to the slow noise and to the walk in its last frame.
    gain: [f64; 2],
    /// `sqrt F`.
    root: f64,
}

impl Memory {
    /// White noise.
    pub const NONE: Self = Self { share: 0.0, time: 1.0, steps: 0.0 };

    /// True for white noise.
    pub fn is_none(self) -> bool {
        self.share == 0.0 && self.steps == 0.0
    }

    /// What is left of slow noise after some frames.
    pub(crate) fn decay(self, frames: usize) -> f64 {
        (-(frames as f64) / self.time).exp()
    }

    /// Variance of the mean noise over the frames of a pool, in rising order, the walk counted from `origin`: with each frame the slow noise and the
    /// walk of those before have one term more.
    fn variance(self, levels: &Levels, origin: usize, pool: &[usize]) -> f64 {
        let (mut sum, mut slow, mut walked, mut before) = (0.0, 0.0, 0.0, pool[0]);
        for &frame in pool {
            let level = levels.at(frame);
            slow *= self.decay(frame - before);
            let own = level * level + self.steps.powi(2) * (frame - origin) as f64;
            sum += own + 2.0 * (self.share * level * slow + self.steps.powi(2) * walked);
            slow += level;
            walked += (frame - origin) as f64;
            before = frame;
        }
        sum / (pool.len() as f64).powi(2)
    }

    /// Covariance of the noise in two frames, the walk counted from `origin`.
    #[cfg(test)]
    pub fn covariance(self, levels: &Levels, origin: usize, [one, other]: [usize; 2]) -> f64 {
        let white = if one == other { 1.0 - self.share } else { 0.0 };
        let stationary = white + self.share * self.decay(one.abs_diff(other));
        stationary * levels.at(one) * levels.at(other) + self.steps.powi(2) * (one.min(other) - origin) as f64
    }
}

impl Filter {
    /// Over pools of frames, all in rising order, the walk counted from `origin`.
    pub fn from_pools(memory: Memory, levels: &Levels, origin: usize, pools: &[impl AsRef<[usize]>]) -> Self {
        let (mut before, mut told) = (origin, Matrix2::zeros());
        let step = |pool: &[usize]| {
            let (first, last) = (pool[0], pool[pool.len() - 1]);
            let mean =
                |value: &dyn Fn(usize) -> f64| pool.iter().map(|&frame| value(frame)).sum::<f64>() / pool.len() as f64;
            let decay = [memory.decay(first - before), memory.decay(last - first)];
            let carried = decay.map(|decay| Matrix2::new(decay, 0.0, 0.0, 1.0));
            let of_first = Vector2::new(mean(&|frame| levels.at(frame) * memory.decay(frame - first)), 1.0);
            let slow = memory.share * mean(&|frame| levels.at(frame) * memory.decay(last - frame));
            let of_last = Vector2::new(slow, memory.steps.powi(2) * mean(&|frame| (frame - origin) as f64));
            told = carried[0] * told * carried[0];
            let seen = told * of_first;
            let variance = memory.variance(levels, origin, pool) - of_first.dot(&seen);
            let gain = (of_last - carried[1] * seen) / variance;
            told = carried[1] * told * carried[1] + gain * gain.transpose() * variance;
            before = last;
            Step { decay, level: of_first[0], gain: gain.into(), root: variance.sqrt() }
        };
        Self { steps: pools.iter().map(AsRef::as_ref).map(step).collect() }
    }

    /// Standard deviation of each pool's mean, given those before.
    pub(crate) fn roots(&self) -> impl Iterator<Item = f64> + '_ {
        self.steps.iter().map(|step| step.root)
    }

    /// Replace noise, one number for each of the pools, by its innovations.
    pub fn whiten<'a>(&self, noise: impl Iterator<Item = &'a mut f64>) {
        let (mut slow, mut walk) = (0.0, 0.0);
        for (value, step) in noise.zip(&self.steps) {
            slow *= step.decay[0];
            let innovation = *value - step.level * slow - walk;
            slow = step.decay[1] * slow + step.gain[0] * innovation;
            walk += step.gain[1] * innovation;
            *value = innovation / step.root;
        }
    }

    /// The same of every column.
    pub(crate) fn whiten_columns(&self, columns: &mut DMatrix<f64>) {
        columns.column_iter_mut().for_each(|mut column| self.whiten(column.iter_mut()));
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::DVector;

    use super::*;

    const SLOW_AND_WALKING: Memory = Memory { share: 0.3, time: 7.0, steps: 0.05 };
    /// Frames with gaps.
    const FRAMES: [usize; 9] = [3, 4, 5, 9, 10, 17, 18, 30, 31];

    fn dense(memory: Memory, levels: &Levels, origin: usize) -> DMatrix<f64> {
        let at = |i: usize, j: usize| memory.covariance(levels, origin, [FRAMES[i], FRAMES[j]]);
        DMatrix::from_fn(FRAMES.len(), FRAMES.len(), at)
    }

    fn some_noise(n: usize) -> DVector<f64> {
        DVector::from_fn(n, |i, _| (1.3 * (i * i) as f64 + 0.4).sin() * 2.0)
    }

    #[test]
    fn the_filter_whitens_as_the_cholesky_factor_of_the_covariance_does() {
        for memory in
            [SLOW_AND_WALKING, Memory { steps: 0.0, ..SLOW_AND_WALKING }, Memory { share: 0.0, ..SLOW_AND_WALKING }]
        {
            for (levels, pool) in [(Levels::CONSTANT, 1), (Levels::some(5..18, 2.5), 1), (Levels::some(5..18, 2.5), 4)]
            {
                let pools: Vec<&[usize]> = FRAMES.chunks(pool).collect();
                let mean = DMatrix::from_fn(pools.len(), FRAMES.len(), |p, i| {
                    if pools[p].contains(&FRAMES[i]) { 1.0 / pools[p].len() as f64 } else { 0.0 }
                });
                let factor = (&mean * dense(memory, &levels, 2) * mean.transpose()).cholesky().unwrap();
                let mut found = some_noise(pools.len());
                let expected = factor.l().solve_lower_triangular(&found).unwrap();
                let filter = Filter::from_pools(memory, &levels, 2, &pools);
                filter.whiten(found.iter_mut());
                assert!((found - expected).amax() < 1e-12, "rounding");
            }
        }
    }

    #[test]
    fn white_noise_stays_as_it_is_to_the_bit() {
        let noise = some_noise(FRAMES.len());
        let filter = Filter::from_pools(Memory::NONE, &Levels::CONSTANT, 0, &FRAMES.chunks(1).collect::<Vec<_>>());
        let mut found = noise.clone();
        filter.whiten(found.iter_mut());
        assert_eq!(found, noise);
    }
}
