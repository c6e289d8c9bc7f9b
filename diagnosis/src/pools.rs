//! Pools: consecutive frames of one setting, whose mean readings are what a fit sees.
//!
//! Everything that the machine does in a setting is the same in all its frames, so that their mean tells of it what they tell together
//! (for noise that remembers the frames before, all but a little); a campaign of 346 frames has 104. What differs within a pool, read-backs
//! and supplies, is known and taken off before. A pool lasts a 32nd of the campaign at most, so that a slow change is not averaged out. Its frames have
//! noise of one level, and the same of the monitors that have noise in common within a frame: where one misses a frame, its mean is over other frames than its
//! neighbours', and a jitter of the momentum no longer shifts all means together.

use nalgebra::{DMatrix, DVector};
use twin::Drives;

/// Pools of the frames of a campaign.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Pools {
    /// Pool of each frame.
    pub of_frame: Vec<usize>,
    /// How many there are.
    pub count: usize,
}

/// Longest pool, as a part of the campaign.
const PARTS: usize = 32;

impl Pools {
    /// From the setting of each frame, and whether its noise is like that of the frame before; a frame without a setting has a pool of its own.
    pub fn from_settings(settings: &[Option<usize>], is_like_before: impl Fn(usize) -> bool) -> Self {
        let longest = settings.len().div_ceil(PARTS);
        let (mut of_frame, mut count, mut first) = (Vec::with_capacity(settings.len()), 0, 0);
        for (i, setting) in settings.iter().enumerate() {
            let is_same = i > 0 && setting.is_some() && settings[i - 1] == *setting && is_like_before(i);
            if !is_same || i - first >= longest {
                (first, count) = (i, count + 1);
            }
            of_frame.push(count - 1);
        }
        Self { of_frame, count }
    }

    /// Frames of each pool.
    pub fn frames(&self) -> Vec<Vec<usize>> {
        let mut frames = vec![Vec::new(); self.count];
        self.of_frame.iter().enumerate().for_each(|(frame, &pool)| frames[pool].push(frame));
        frames
    }

    /// How many readings of each pool count, rows pools.
    pub fn counts(&self, columns: usize, counts: impl Fn(usize, usize) -> bool) -> DMatrix<f64> {
        let mut all = DMatrix::zeros(self.count, columns);
        for (frame, &pool) in self.of_frame.iter().enumerate() {
            (0..columns).filter(|&c| counts(frame, c)).for_each(|c| all[(pool, c)] += 1.0);
        }
        all
    }

    /// Means over the frames that count, rows pools; 0 where none does.
    pub fn means(&self, values: &DMatrix<f64>, counts: impl Fn(usize, usize) -> bool) -> DMatrix<f64> {
        let mut sums = DMatrix::<f64>::zeros(self.count, values.ncols());
        for (frame, &pool) in self.of_frame.iter().enumerate() {
            (0..values.ncols()).filter(|&c| counts(frame, c)).for_each(|c| sums[(pool, c)] += values[(frame, c)]);
        }
        sums.zip_map(&self.counts(values.ncols(), counts), |sum: f64, count: f64| sum / count.max(1.0))
    }

    /// Mean drives.
    pub fn drives(&self, drives: &Drives) -> Drives {
        let mean = |column: &DVector<f64>| {
            let column = DMatrix::from_column_slice(column.len(), 1, column.as_slice());
            self.means(&column, |_, _| true).column(0).into_owned()
        };
        Drives {
            kick: self.means(&drives.kick, |_, _| true),
            rf_offset: mean(&drives.rf_offset),
            time: mean(&drives.time),
            ..drives.clone()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pool_is_a_run_of_one_setting_and_no_longer_than_a_part_of_the_campaign() {
        let settings: Vec<Option<usize>> =
            [0, 0, 0, 1, 1, 0].map(Some).into_iter().chain([None, None]).chain([Some(2); 88]).collect();
        let pools = Pools::from_settings(&settings, |_| true);
        assert_eq!(pools.of_frame[..12], [0, 0, 0, 1, 1, 2, 3, 4, 5, 5, 5, 6], "a 32nd of 96 frames is 3");
        assert_eq!(pools.count, 5 + 88_usize.div_ceil(3));
        let pools = Pools::from_settings(&settings, |frame| ![2, 4].contains(&frame));
        assert_eq!(pools.of_frame[..6], [0, 0, 1, 2, 3, 4], "and where the noise is another");
    }

    #[test]
    fn means_are_those_of_the_readings_that_count() {
        let pools = Pools { of_frame: vec![0, 0, 1, 1], count: 2 };
        let values = DMatrix::from_column_slice(4, 1, &[1.0, f64::NAN, 4.0, 8.0]);
        let counts = |frame: usize, _: usize| frame != 1;
        assert_eq!(pools.means(&values, counts).as_slice(), [1.0, 6.0]);
        assert_eq!(pools.counts(1, counts).as_slice(), [1.0, 2.0]);
        assert_eq!(pools.means(&values, |_, _| false).as_slice(), [0.0, 0.0]);
    }
}
