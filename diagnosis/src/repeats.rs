//! Readings that repeat a setting, and how likely they are for noise with a memory.
//!
//! What a setting changes, by the physics that the model holds or by any other, is the same in all its frames. A monitor's readings
//! less their prediction are therefore
//!
//! `r_k = baseline + change of the setting + noise_k`,
//!
//! with an unknown change of each run of frames in one setting, but for the setting that comes back most, as a rule all correctors at
//! 0 A: its frames are repeats of each other at all distances. Baseline and changes are diffuse states beside those of [`Memory`], so
//! that the density is that of the differences within settings, and no missing physics of a setting enters it. The noise's scale is
//! taken out in closed form. Where the level of the noise changes in time ([`Levels`]), that of a frame's white and slow noise is the larger by its factor.
//!
//! Source: J. Durbin and S. J. Koopman, Time Series Analysis by State Space Methods (2012), ch. 5 and 7.2, the diffuse likelihood, which
//! is that of H. D. Patterson and R. Thompson, Biometrika 58 (1971) 545, for contrasts.

use nalgebra::DMatrix;

use super::levels::Levels;
use super::memory::Memory;

/// A monitor's readings less their prediction, in frames that count.
#[derive(Debug, Clone)]
pub struct Repeats {
    readings: Vec<Repeat>,
    /// How many numbers were fitted to them before.
    fitted: f64,
}

/// One of them.
#[derive(Debug, Clone, Copy)]
struct Repeat {
    frame: usize,
    /// [m]
    value: f64,
    run: Run,
    /// Level of its noise [1].
    level: f64,
}

/// How a frame's setting goes on from the frame before.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Run {
    /// The setting that comes back most.
    Base,
    /// Another setting.
    New,
    /// The same setting as in the frame before.
    Same,
}

/// What some readings say of a memory.
#[derive(Debug, Clone, Default)]
pub struct Weighed {
    /// Differences, as many as there are readings less baseline, settings and what was fitted before.
    pub count: f64,
    /// Sum of their squares over their variances in units of the noise's [m^2].
    pub square: f64,
    /// Sum of `ln` of these variances.
    pub log_det: f64,
}

/// Variance of a diffuse state, in noise variances, and that above which a reading has told of nothing else: baselines are some thousand
/// sigma, and rounding spoils a filter at 1e12.
const DIFFUSE: f64 = 1e8;
const TELLING: f64 = 1e4;
/// Neighbours of one setting from which on they tell the noise by themselves.
const FEW: usize = 6;

/// The states of the filter: slow noise, walk with the baseline, and the change of the setting; lower half of their covariance.
struct State {
    mean: [f64; 3],
    covariance: [[f64; 3]; 3],
}

impl Run {
    /// Of every frame, from the setting of each.
    pub fn from_settings(settings: &[Option<usize>]) -> Vec<Self> {
        let mut count = std::collections::BTreeMap::<usize, usize>::new();
        settings.iter().flatten().for_each(|setting| *count.entry(*setting).or_default() += 1);
        let base = count.into_iter().max_by_key(|(_, frames)| *frames).map(|(setting, _)| setting);
        let run_of_frame = |i: usize| match settings[i] {
            None => Self::New,
            setting if setting == base => Self::Base,
            setting if i > 0 && settings[i - 1] == setting => Self::Same,
            Some(_) => Self::New,
        };
        (0..settings.len()).map(run_of_frame).collect()
    }
}

impl Repeats {
    /// From the frames that count, in rising order, and their readings less predictions [m].
    pub fn from_frames(frames: &[usize], values: &[f64], runs: &[Run]) -> Self {
        let first = values.first().copied().unwrap_or(0.0);
        let mut readings: Vec<Repeat> = Vec::new();
        for (&frame, &value) in frames.iter().zip(values) {
            // the first frame of a run may be missing
            let since = readings.last().map_or(0, |last| last.frame + 1);
            let begins = runs[since..=frame].iter().any(|run| *run != Run::Same) || readings.is_empty();
            let run = if runs[frame] == Run::Same && begins { Run::New } else { runs[frame] };
            readings.push(Repeat { frame, value: value - first, run, level: 1.0 });
        }
        Self { readings, fitted: 0.0 }
    }

    /// Without what follows known drives, rows frames (those given to [`Repeats::from_frames`]), columns drives, in prior standard deviations [m]: the
    /// orbit follows the supplies by unknown factors. `sigma`: noise [m].
    #[must_use]
    pub fn without(mut self, following: &DMatrix<f64>, sigma: f64) -> Self {
        let mut values = DMatrix::from_fn(self.readings.len(), 1, |i, _| self.readings[i].value);
        let mut known = following.clone();
        self.centre(&mut values);
        self.centre(&mut known);
        let information = known.tr_mul(&known) / sigma.powi(2);
        let mut normal = information.clone();
        (0..normal.ncols()).for_each(|k| normal[(k, k)] += 1.0);
        let Some(factor) = normal.cholesky() else { return self };
        let off = following * factor.solve(&(known.tr_mul(&values) / sigma.powi(2)));
        self.readings.iter_mut().zip(off.iter()).for_each(|(reading, off)| reading.value -= off);
        self.fitted = factor.solve(&information).trace();
        self
    }

    /// With the level of the noise in each frame.
    #[must_use]
    pub(crate) fn at_levels(mut self, levels: &Levels) -> Self {
        self.readings.iter_mut().for_each(|reading| reading.level = levels.at(reading.frame));
        self
    }

    /// Take the mean of its setting off each row.
    fn centre(&self, columns: &mut DMatrix<f64>) {
        let mut groups: Vec<Vec<usize>> = vec![Vec::new()];
        for (i, reading) in self.readings.iter().enumerate() {
            match reading.run {
                Run::Base => groups[0].push(i),
                Run::New => groups.push(vec![i]),
                Run::Same => groups.last_mut().expect("there is one").push(i),
            }
        }
        for mut column in columns.column_iter_mut() {
            for group in groups.iter().filter(|group| !group.is_empty()) {
                let mean = group.iter().map(|&i| column[i]).sum::<f64>() / group.len() as f64;
                group.iter().for_each(|&i| column[i] -= mean);
            }
        }
    }

    /// Standard deviation of the noise [m] by the differences of neighbours of one setting; none where there are few.
    pub(crate) fn of_neighbours(&self) -> Option<f64> {
        let repeated = |pair: &&[Repeat]| {
            let [one, other] = [pair[0], pair[1]];
            other.frame == one.frame + 1 && (other.run == Run::Same || (one.run == Run::Base && other.run == Run::Base))
        };
        let squares: Vec<f64> =
            self.readings.windows(2).filter(repeated).map(|pair| (pair[1].value - pair[0].value).powi(2)).collect();
        (squares.len() >= FEW).then(|| (0.5 * squares.iter().sum::<f64>() / squares.len() as f64).sqrt())
    }

    /// Each difference, with its frame: `(innovation, variance)`, the latter in units of the noise's.
    pub fn differences(&self, memory: Memory) -> impl Iterator<Item = (usize, f64, f64)> {
        let mut state = State::new(memory);
        let mut at = self.readings.first().map_or(0, |first| first.frame);
        self.readings.iter().filter_map(move |reading| {
            state.carry(memory, reading.frame - at);
            at = reading.frame;
            let (innovation, variance) = state.take(memory, reading);
            (variance < TELLING).then_some((reading.frame, innovation, variance))
        })
    }

    /// What they say of a memory.
    pub(crate) fn weigh(&self, memory: Memory) -> Weighed {
        let mut weighed = Weighed { count: -self.fitted, ..Weighed::default() };
        for (_, innovation, variance) in self.differences(memory) {
            weighed.count += 1.0;
            weighed.square += innovation * innovation / variance;
            weighed.log_det += variance.ln();
        }
        weighed
    }
}

impl Weighed {
    /// `ln` likelihood at the most likely scale of the noise, up to a constant.
    pub fn log_likelihood(&self) -> f64 {
        let n = self.count.max(1.0);
        -0.5 * (n * (self.square / n).max(f64::MIN_POSITIVE).ln() + self.log_det)
    }

    /// Most likely standard deviation of the noise [m]; none without differences.
    pub fn sigma(&self) -> Option<f64> {
        (self.count > 0.0).then(|| (self.square / self.count).sqrt())
    }
}

impl State {
    fn new(memory: Memory) -> Self {
        Self { mean: [0.0; 3], covariance: [[memory.share, 0.0, 0.0], [0.0, DIFFUSE, 0.0], [0.0, 0.0, 0.0]] }
    }

    /// Some frames later.
    fn carry(&mut self, memory: Memory, frames: usize) {
        if frames == 0 {
            return;
        }
        let decay = memory.decay(frames);
        self.mean[0] *= decay;
        let [slow, walk, change] = &mut self.covariance;
        slow[0] = slow[0] * decay * decay + memory.share * (1.0 - decay * decay);
        walk[0] *= decay;
        walk[1] += memory.steps * memory.steps * frames as f64;
        change[0] *= decay;
    }

    /// Innovation of a reading and its variance; learn from it.
    fn take(&mut self, memory: Memory, reading: &Repeat) -> (f64, f64) {
        if reading.run == Run::New {
            self.mean[2] = 0.0;
            self.covariance[2] = [0.0, 0.0, DIFFUSE];
        }
        let c = &mut self.covariance;
        let states = if reading.run == Run::Base { 2 } else { 3 };
        let level = reading.level;
        let mut seen = [level * c[0][0] + c[1][0], level * c[1][0] + c[1][1], 0.0];
        let mut expected = level * self.mean[0] + self.mean[1];
        if states == 3 {
            seen = [seen[0] + c[2][0], seen[1] + c[2][1], level * c[2][0] + c[2][1] + c[2][2]];
            expected += self.mean[2];
        }
        let variance = level * seen[0] + seen[1] + seen[2] + level * level * (1.0 - memory.share);
        let innovation = reading.value - expected;
        for i in 0..states {
            let gain = seen[i] / variance;
            self.mean[i] += gain * innovation;
            for j in 0..=i {
                c[i][j] -= gain * seen[j];
            }
        }
        (innovation, variance)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::DVector;

    use super::*;

    /// `ln` density of contrasts, `-(y^T P y + ln det S + ln det X^T S^-1 X)/2`, X the unknown baseline and changes.
    fn restricted(memory: Memory, levels: &Levels, frames: &[usize], y: &DVector<f64>, x: &DMatrix<f64>) -> (f64, f64) {
        let n = frames.len();
        let s = DMatrix::from_fn(n, n, |i, j| memory.covariance(levels, 0, [frames[i], frames[j]]));
        let factor = s.clone().cholesky().unwrap();
        let solved = factor.solve(x);
        let information = x.tr_mul(&solved);
        let best = information.clone().cholesky().unwrap().solve(&solved.tr_mul(y));
        let left = y - x * best;
        (left.dot(&factor.solve(&left)), s.determinant().ln() + information.determinant().ln())
    }

    #[test]
    fn the_filter_gives_the_likelihood_of_contrasts_within_settings() {
        let settings = [0, 0, 1, 1, 1, 2, 2, 0, 0, 0, 3, 3, 0, 0].map(Some);
        let runs = Run::from_settings(&settings);
        // frame 5 does not count, so that its run begins a frame later
        let frames: Vec<usize> = (0..settings.len()).filter(|frame| *frame != 5).collect();
        let y = DVector::from_fn(frames.len(), |i, _| (2.1 * (i * i) as f64).sin() + 30.0);
        let x = DMatrix::from_fn(frames.len(), 4, |i, k| {
            let setting = settings[frames[i]].unwrap();
            if k == 0 || k == setting { 1.0 } else { 0.0 }
        });
        let repeats = Repeats::from_frames(&frames, y.as_slice(), &runs);
        let larger = Levels::some(3..9, 2.0);
        let both_at = |memory: Memory, levels: &Levels| {
            let (square, log_det) = restricted(memory, levels, &frames, &y, &x);
            let found = repeats.clone().at_levels(levels).weigh(memory);
            assert_eq!(found.count, frames.len() as f64 - 4.0);
            // the diffuse variance is 1e8
            assert!((found.square - square).abs() < 1e-5 * square, "{} {square}", found.square);
            found.log_det - log_det
        };
        let both = |memory: Memory| both_at(memory, &Levels::CONSTANT);
        let slow = Memory { share: 0.3, time: 4.0, steps: 0.0 };
        let walking = Memory { share: 0.1, time: 3.0, steps: 0.2 };
        assert!((both(slow) - both(walking)).abs() < 1e-5);
        assert!((both(slow) - both(Memory::NONE)).abs() < 1e-5);
        assert!((both(slow) - both_at(walking, &larger)).abs() < 1e-5);
    }

    #[test]
    fn a_change_of_the_setting_by_any_physics_changes_nothing() {
        let settings = [0, 0, 1, 1, 1, 0, 0, 2, 2, 0].map(Some);
        let runs = Run::from_settings(&settings);
        let frames: Vec<usize> = (0..10).collect();
        let weigh = |change: f64| {
            let value = |i: usize| (1.7 * (i * i) as f64).sin() + change * settings[i].unwrap() as f64;
            let values: Vec<f64> = (0..10).map(value).collect();
            Repeats::from_frames(&frames, &values, &runs).weigh(Memory { share: 0.2, time: 5.0, steps: 0.1 }).square
        };
        assert!((weigh(0.0) / weigh(50.0) - 1.0).abs() < 1e-4, "the diffuse variance is 1e8");
    }
}
