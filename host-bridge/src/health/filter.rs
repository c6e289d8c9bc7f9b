//! A running mean of what comes, for decisions that no single sample takes.

use serde::{Deserialize, Serialize};

/// An exponential mean over about `SAMPLES` samples; over all of them while there are fewer.
///
/// `m += (z - m)/min(n, SAMPLES)`: after a change of the samples from 0 to 1, k further ones make it `1 - (1 - 1/SAMPLES)^k`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Filter<const SAMPLES: u32> {
    mean: f32,
    /// Samples so far, at most `SAMPLES`.
    count: u32,
}

impl<const SAMPLES: u32> Filter<SAMPLES> {
    /// Take a sample; one that is no number is left out.
    pub fn add(&mut self, sample: f32) {
        if !sample.is_finite() {
            return;
        }
        self.count = (self.count + 1).min(SAMPLES);
        self.mean += (sample - self.mean) / self.count as f32;
    }

    /// The mean; 0 without a sample.
    pub fn mean(&self) -> f32 {
        self.mean
    }

    /// True once there were a quarter of its samples: before, nothing is decided.
    pub fn is_settled(&self) -> bool {
        4 * self.count >= SAMPLES
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_comes_through_exponentially() {
        let mut filter = Filter::<64>::default();
        (0..100).for_each(|_| filter.add(0.0));
        for k in 1..200 {
            filter.add(1.0);
            let expected = 1.0 - (1.0 - 1.0 / 64.0_f32).powi(k);
            // rounding of k additions of numbers below 1
            assert!((filter.mean() - expected).abs() < k as f32 * f32::EPSILON, "{k}: {} {expected}", filter.mean());
        }
    }

    #[test]
    fn the_first_samples_are_averaged_and_decide_nothing() {
        let mut filter = Filter::<16>::default();
        [3.0, 5.0, f32::NAN, f32::INFINITY].into_iter().for_each(|sample| filter.add(sample));
        assert_eq!((filter.mean(), filter.is_settled()), (4.0, false));
        [4.0, 4.0].into_iter().for_each(|sample| filter.add(sample));
        assert_eq!((filter.mean(), filter.is_settled()), (4.0, true));
    }
}
