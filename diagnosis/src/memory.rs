//! Noise with a memory: white, slow and wandering.
//!
//! In units of its standard deviation the noise of a monitor in frame k is `white + slow + walk`, of variances
//!
//! `1 - share`; `share`, correlation `exp(-|k - l|/time)` between frames k and l; and `steps^2` for each frame that the walk goes on.
//!
//! Whitening is the Kalman filter of these two states: with the noise expected from the frames before, `m`, and its variance, `F`, the
//! innovations `(e - m)/sqrt F` are independent and of variance 1, and the determinant of the covariance is the product of all `F`. It
//! is a linear map and costs a few operations a frame. Frames without a reading that counts are gaps.
//!
//! Source: A. C. Harvey, Forecasting, Structural Time Series Models and the Kalman Filter (1989), ch. 3.4; J. Durbin and
//! S. J. Koopman, Time Series Analysis by State Space Methods (2012), ch. 4.3 and 4.4.

use nalgebra::{DMatrix, Matrix2, Matrix2xX, RowDVector, Vector2};

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
    /// What is left of the slow noise of the frame before.
    decay: f64,
    /// Share of an innovation that goes to the slow noise and to the walk.
    gain: [f64; 2],
    /// `sqrt F`.
    root: f64,
}

/// The states, slow noise and walk, before and after the reading of a frame: covariances, and what carries them over from the frame
/// before.
struct Belief {
    carried: Matrix2<f64>,
    before: Matrix2<f64>,
    after: Matrix2<f64>,
    /// Variance of the reading.
    variance: f64,
}

/// What kept frames say of the noise in left-out ones.
pub struct Interpolation {
    kept: Vec<bool>,
    beliefs: Vec<Belief>,
}

/// Least variance of a state, in noise variances: far below anything that can be learnt, and far above rounding.
const LEAST: f64 = 1e-12;

impl Memory {
    /// White noise.
    pub const NONE: Self = Self { share: 0.0, time: 1.0, steps: 0.0 };

    /// True for white noise.
    pub fn is_none(self) -> bool {
        self.share == 0.0 && self.steps == 0.0
    }

    /// What is left of slow noise after some frames.
    pub fn decay(self, frames: usize) -> f64 {
        (-(frames as f64) / self.time).exp()
    }

    /// Covariance of the noise in two frames, the walk counted from frame 0.
    pub fn covariance(self, one: usize, other: usize) -> f64 {
        let white = if one == other { 1.0 - self.share } else { 0.0 };
        white + self.share * self.decay(one.abs_diff(other)) + self.steps * self.steps * one.min(other) as f64
    }

    /// Covariance of the states, some frames later.
    fn carry(self, covariance: &Matrix2<f64>, frames: usize) -> (Matrix2<f64>, Matrix2<f64>) {
        let decay = self.decay(frames);
        let carried = Matrix2::new(decay, 0.0, 0.0, 1.0);
        let new = [self.share * (1.0 - decay * decay), self.steps * self.steps * frames as f64];
        (carried, carried * covariance * carried + Matrix2::new(new[0], 0.0, 0.0, new[1]))
    }

    /// The states from frame to frame; `counts` tells which of them have a reading.
    fn beliefs(self, origin: usize, frames: &[usize], counts: &[bool]) -> Vec<Belief> {
        let (mut at, mut after) = (origin, Matrix2::new(self.share, 0.0, 0.0, 0.0));
        let one = |(&frame, &counts): (&usize, &bool)| {
            let (carried, before) = self.carry(&after, frame - at);
            let seen = before.column_sum();
            let variance = seen.sum() + 1.0 - self.share;
            at = frame;
            after = if counts { before - seen * seen.transpose() / variance } else { before };
            Belief { carried, before, after, variance }
        };
        frames.iter().zip(counts).map(one).collect()
    }
}

impl Belief {
    /// Share of an innovation that goes to each state.
    fn gain(&self) -> Vector2<f64> {
        self.before.column_sum() / self.variance
    }
}

impl Filter {
    /// Over some frames in rising order, the walk counted from `origin`.
    pub fn of(memory: Memory, origin: usize, frames: &[usize]) -> Self {
        let step = |belief: Belief| Step {
            decay: belief.carried[(0, 0)],
            gain: belief.gain().into(),
            root: belief.variance.sqrt(),
        };
        Self { steps: memory.beliefs(origin, frames, &vec![true; frames.len()]).into_iter().map(step).collect() }
    }

    /// Replace noise, one number for each of the frames, by its innovations.
    pub fn whiten<'a>(&self, noise: impl Iterator<Item = &'a mut f64>) {
        let (mut slow, mut walk) = (0.0, 0.0);
        for (value, step) in noise.zip(&self.steps) {
            slow *= step.decay;
            let innovation = *value - slow - walk;
            slow += step.gain[0] * innovation;
            walk += step.gain[1] * innovation;
            *value = innovation / step.root;
        }
    }

    /// The same of every column.
    pub fn whiten_columns(&self, columns: &mut DMatrix<f64>) {
        columns.column_iter_mut().for_each(|mut column| self.whiten(column.iter_mut()));
    }

    /// `ln` of the covariance's determinant.
    pub fn log_det(&self) -> f64 {
        self.steps.iter().map(|step| 2.0 * step.root.ln()).sum()
    }
}

impl Interpolation {
    /// From kept frames to others, both in rising order; the walk is counted from `origin`.
    pub fn of(memory: Memory, origin: usize, kept: &[usize], others: &[usize]) -> Self {
        let mut all: Vec<(usize, bool)> =
            kept.iter().map(|&frame| (frame, true)).chain(others.iter().map(|&frame| (frame, false))).collect();
        all.sort_unstable();
        let (frames, kept): (Vec<usize>, Vec<bool>) = all.into_iter().unzip();
        Self { beliefs: memory.beliefs(origin, &frames, &kept), kept }
    }

    /// How much the states of a frame follow those of the next, `G`.
    fn back(&self, k: usize) -> Matrix2<f64> {
        let next = &self.beliefs[k + 1];
        let certain = next.before + Matrix2::from_diagonal_element(LEAST);
        let inverse = certain.try_inverse().unwrap_or_else(Matrix2::zeros);
        self.beliefs[k].after * next.carried.transpose() * inverse
    }

    /// Noise expected in the left-out frames for that of the kept ones, rows frames, any number of columns:
    /// `x_k = f_k + G_k (x_k+1 - p_k+1)`, `f` after and `p` before the reading of the frame.
    pub fn expected(&self, kept: &DMatrix<f64>) -> DMatrix<f64> {
        let (before, mut states) = self.forward(kept);
        for k in (0..states.len().saturating_sub(1)).rev() {
            let off = &states[k + 1] - &before[k + 1];
            states[k] += self.back(k) * off;
        }
        let left = states.iter().zip(&self.kept).filter(|(_, kept)| !**kept);
        let rows: Vec<RowDVector<f64>> = left.map(|(states, _)| states.row_sum()).collect();
        if rows.is_empty() { DMatrix::zeros(0, kept.ncols()) } else { DMatrix::from_rows(&rows) }
    }

    /// States before and after the reading of each frame, a column for each column of noise.
    fn forward(&self, kept: &DMatrix<f64>) -> (Vec<Matrix2xX<f64>>, Vec<Matrix2xX<f64>>) {
        let mut states = Matrix2xX::zeros(kept.ncols());
        let (mut before, mut after) = (Vec::new(), Vec::new());
        let mut rows = kept.row_iter();
        for (belief, is_kept) in self.beliefs.iter().zip(&self.kept) {
            states.row_mut(0).scale_mut(belief.carried[(0, 0)]);
            before.push(states.clone());
            if let Some(row) = is_kept.then(|| rows.next()).flatten() {
                let innovation = row - states.row_sum();
                states += belief.gain() * innovation;
            }
            after.push(states.clone());
        }
        (before, after)
    }

    /// Variance of the noise in the left-out frames about what is expected, white noise included.
    pub fn variances(&self, memory: Memory) -> Vec<f64> {
        let mut smoothed: Vec<Matrix2<f64>> = self.beliefs.iter().map(|belief| belief.after).collect();
        for k in (0..smoothed.len().saturating_sub(1)).rev() {
            let (g, less) = (self.back(k), smoothed[k + 1] - self.beliefs[k + 1].before);
            smoothed[k] += g * less * g.transpose();
        }
        let left = smoothed.iter().zip(&self.kept).filter(|(_, kept)| !**kept);
        left.map(|(covariance, _)| covariance.sum() + 1.0 - memory.share).collect()
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::DVector;

    use super::*;

    const SLOW_AND_WALKING: Memory = Memory { share: 0.3, time: 7.0, steps: 0.05 };
    /// Frames with gaps.
    const FRAMES: [usize; 9] = [3, 4, 5, 9, 10, 17, 18, 30, 31];

    fn dense(memory: Memory, origin: usize, rows: &[usize], columns: &[usize]) -> DMatrix<f64> {
        let at = |i: usize, j: usize| memory.covariance(rows[i] - origin, columns[j] - origin);
        DMatrix::from_fn(rows.len(), columns.len(), at)
    }

    fn some_noise(n: usize) -> DVector<f64> {
        DVector::from_fn(n, |i, _| (1.3 * (i * i) as f64 + 0.4).sin() * 2.0)
    }

    #[test]
    fn the_filter_whitens_as_the_cholesky_factor_of_the_covariance_does() {
        for memory in
            [SLOW_AND_WALKING, Memory { steps: 0.0, ..SLOW_AND_WALKING }, Memory { share: 0.0, ..SLOW_AND_WALKING }]
        {
            let factor = dense(memory, 2, &FRAMES, &FRAMES).cholesky().unwrap();
            let noise = some_noise(FRAMES.len());
            let expected = factor.l().solve_lower_triangular(&noise).unwrap();
            let filter = Filter::of(memory, 2, &FRAMES);
            let mut found = noise;
            filter.whiten(found.iter_mut());
            assert!((found - expected).amax() < 1e-12, "rounding");
            assert!((filter.log_det() - factor.determinant().ln()).abs() < 1e-12, "rounding");
        }
    }

    #[test]
    fn white_noise_stays_as_it_is_to_the_bit() {
        let noise = some_noise(FRAMES.len());
        let filter = Filter::of(Memory::NONE, 0, &FRAMES);
        let mut found = noise.clone();
        filter.whiten(found.iter_mut());
        assert_eq!((found, filter.log_det()), (noise, 0.0));
    }

    #[test]
    fn what_is_expected_of_left_out_frames_is_the_conditional_of_the_covariance() {
        let out = [4, 10, 17, 31];
        let kept: Vec<usize> = FRAMES.into_iter().filter(|frame| !out.contains(frame)).collect();
        for memory in
            [SLOW_AND_WALKING, Memory { steps: 0.0, ..SLOW_AND_WALKING }, Memory { share: 0.0, ..SLOW_AND_WALKING }]
        {
            let noise = DMatrix::from_columns(&[some_noise(kept.len()), some_noise(kept.len()).add_scalar(1.0)]);
            let factor = dense(memory, 3, &kept, &kept).cholesky().unwrap();
            let cross = dense(memory, 3, &out, &kept);
            let left = dense(memory, 3, &out, &out) - &cross * factor.solve(&cross.transpose());
            let interpolation = Interpolation::of(memory, 3, &kept, &out);
            // a state without variance is inverted as if it had the least
            let off = interpolation.expected(&noise) - cross * factor.solve(&noise);
            assert!(off.amax() < 1e-7, "{}", off.amax());
            for (variance, expected) in interpolation.variances(memory).into_iter().zip(left.diagonal().iter()) {
                assert!((variance - expected).abs() < 1e-7, "{variance} {expected}");
            }
        }
    }
}
