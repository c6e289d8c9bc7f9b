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

/// The filter of one monitor, over the frames in which its reading counts.
#[derive(Debug, Clone)]
pub struct Filter {
    steps: Vec<Step>,
}

/// One frame of the filter.
#[derive(Debug, Clone, Copy)]
struct Step {
    /// What is left of the slow noise of the frame before, and the level at which it is seen.
    decay: f64,
    level: f64,
    /// Share of an innovation that goes to the slow noise and to the walk.
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

    /// Covariance of white and slow noise in two frames so far apart, at the ordinary level.
    pub(crate) fn stationary(self, apart: usize) -> f64 {
        let white = if apart == 0 { 1.0 - self.share } else { 0.0 };
        white + self.share * self.decay(apart)
    }

    /// Covariance of the walk in two frames, counted from where it begins.
    pub(crate) fn walked(self, one: usize, other: usize) -> f64 {
        self.steps * self.steps * one.min(other) as f64
    }

    /// Covariance of the noise in two frames, the walk counted from `origin`.
    #[cfg(test)]
    pub fn covariance(self, levels: &Levels, origin: usize, [one, other]: [usize; 2]) -> f64 {
        let stationary = self.stationary(one.abs_diff(other)) * levels.at(one) * levels.at(other);
        stationary + self.walked(one - origin, other - origin)
    }

    /// Covariance of the states, some frames later.
    fn carry(self, covariance: &Matrix2<f64>, frames: usize) -> (Matrix2<f64>, Matrix2<f64>) {
        let decay = self.decay(frames);
        let carried = Matrix2::new(decay, 0.0, 0.0, 1.0);
        let new = [self.share * (1.0 - decay * decay), self.steps * self.steps * frames as f64];
        (carried, carried * covariance * carried + Matrix2::new(new[0], 0.0, 0.0, new[1]))
    }
}

impl Filter {
    /// Over some frames in rising order, the walk counted from `origin`.
    pub fn from_frames(memory: Memory, levels: &Levels, origin: usize, frames: &[usize]) -> Self {
        let (mut at, mut after) = (origin, Matrix2::new(memory.share, 0.0, 0.0, 0.0));
        let step = |&frame: &usize| {
            let (carried, before) = memory.carry(&after, frame - at);
            let level = levels.at(frame);
            let of_states = Vector2::new(level, 1.0);
            let seen = before * of_states;
            let variance = of_states.dot(&seen) + level * level * (1.0 - memory.share);
            at = frame;
            after = before - seen * seen.transpose() / variance;
            Step { decay: carried[(0, 0)], level, gain: (seen / variance).into(), root: variance.sqrt() }
        };
        Self { steps: frames.iter().map(step).collect() }
    }

    /// Replace noise, one number for each of the frames, by its innovations.
    pub fn whiten<'a>(&self, noise: impl Iterator<Item = &'a mut f64>) {
        let (mut slow, mut walk) = (0.0, 0.0);
        for (value, step) in noise.zip(&self.steps) {
            slow *= step.decay;
            let innovation = *value - step.level * slow - walk;
            slow += step.gain[0] * innovation;
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
            for levels in [Levels::CONSTANT, Levels::some(5..18, 2.5)] {
                let factor = dense(memory, &levels, 2).cholesky().unwrap();
                let noise = some_noise(FRAMES.len());
                let expected = factor.l().solve_lower_triangular(&noise).unwrap();
                let filter = Filter::from_frames(memory, &levels, 2, &FRAMES);
                let mut found = noise;
                filter.whiten(found.iter_mut());
                assert!((found - expected).amax() < 1e-12, "rounding");
            }
        }
    }

    #[test]
    fn white_noise_stays_as_it_is_to_the_bit() {
        let noise = some_noise(FRAMES.len());
        let filter = Filter::from_frames(Memory::NONE, &Levels::CONSTANT, 0, &FRAMES);
        let mut found = noise.clone();
        filter.whiten(found.iter_mut());
        assert_eq!(found, noise);
    }
}
