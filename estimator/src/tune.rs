//! The tune meter: its noise learnt from one frame to the next, and the mean of its readings.
//!
//! With constant params the sufficient statistic is the mean tune at the mean strength of the supplies. What each frame's
//! supplies add is known, and is subtracted before two tunes are compared.

use crate::campaign::{move_mean, ratio, ratio_steps};
use crate::monitor::{Gate, Noise};
use crate::state::state;
use crate::wire::TuneCode;

/// Order of magnitude of its noise [1]; what is learnt reaches from 3e-5 to 0.1.
const SCALE: f32 = 1e-3;
/// Steps of a mean within one of a reading, as a power of two.
const FRACTION: u32 = 10;
/// Steps of a reading in a turn.
const TURN: i32 = TuneCode::LIMIT;

/// The tune meter in one plane; `F` supplies.
#[derive(Debug, Clone)]
pub struct TuneMeter<const F: usize> {
    noise: Noise,
    /// Mean reading, in parts of a step.
    mean: i32,
    count: u32,
    /// Mean of `ln` of the supplies' factors over the readings in the mean, in steps.
    strength: [i32; F],
    /// Sum of squared deviations from the mean.
    scatter: f64,
    last: Option<(TuneCode, [f32; F])>,
    /// The tune is linear in what is not known of the params: it counts.
    pub is_linear: bool,
}

state!([const F: usize] TuneMeter<F> { noise, mean, count, strength, scatter, last, is_linear });

impl<const F: usize> TuneMeter<F> {
    /// Memory for one.
    pub const BLANK: Self =
        Self { noise: Noise::BLANK, mean: 0, count: 0, strength: [0; F], scatter: 0.0, last: None, is_linear: false };

    /// Restart without readings.
    pub fn clear(&mut self) {
        *self = Self { noise: Noise::unknown(SCALE), ..Self::BLANK };
    }

    /// Take a reading at `ln` of the supplies' factors; true if it counts. `ripple` is what a change of these factors makes
    /// of the tune.
    ///
    /// A reading counts if it agrees with the one before: a jump is refused, and so is the reading after it.
    pub fn hear(&mut self, code: TuneCode, strength: &[f32; F], gate: Gate, ripple: impl Fn(&[f32; F]) -> f32) -> bool {
        let Some((last, before)) = self.last.replace((code, *strength)) else { return false };
        let mut change = *strength;
        change.iter_mut().zip(before).for_each(|(change, before)| *change -= before);
        let difference = wrapped(code.value() - last.value() - ripple(&change));
        self.noise.learn(difference);
        let counts = gate.agree(difference, 0.0, self.noise.sigma());
        if counts {
            self.add(code, strength, ripple);
        }
        counts
    }

    /// Count a reading into the mean: the squared distance from it grows the sum of squared deviations by `(n - 1)/n`.
    fn add(&mut self, code: TuneCode, strength: &[f32; F], ripple: impl Fn(&[f32; F]) -> f32) {
        let (mean, mut change, before) = self.mean();
        change.iter_mut().zip(strength).for_each(|(change, s)| *change = s - *change);
        let deviation = wrapped(code.value() - mean - ripple(&change));
        self.scatter += f64::from(deviation) * f64::from(deviation) * f64::from(before) / (f64::from(before) + 1.0);
        self.count = self.count.saturating_add(1);
        // the whole turns that bring it next to the mean
        let distance = code.steps() - (self.mean >> FRACTION);
        let turns = if self.count == 1 { 0 } else { (distance + distance.signum() * TURN / 2) / TURN };
        move_mean(&mut self.mean, (code.steps() - turns * TURN) << FRACTION, self.count);
        for (mean, s) in self.strength.iter_mut().zip(strength) {
            move_mean(mean, ratio_steps(*s), self.count);
        }
    }

    /// Update its noise; true if readings so far need re-weighting.
    pub fn judge(&mut self) -> bool {
        self.noise.revise()
    }

    /// Variance of one reading [1]; none before enough of them have shown it.
    pub fn variance(&self) -> Option<f32> {
        let sigma = self.noise.sigma();
        sigma.is_finite().then_some(sigma * sigma)
    }

    /// Sum of squared deviations of the readings that count from their mean [1].
    pub fn scatter(&self) -> f64 {
        self.scatter
    }

    /// Mean of the readings that count [1], the mean of `ln` of the supplies' factors over them, and their number.
    pub fn mean(&self) -> (f32, [f32; F], u32) {
        let steps = self.mean as f32 / (1 << FRACTION) as f32;
        (steps * TuneCode::TURNS_PER_LSB, self.strength.map(ratio), self.count)
    }
}

/// The difference of two tunes, each known up to an integer.
pub fn wrapped(difference: f32) -> f32 {
    difference - libm::roundf(difference)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn meter(tunes: impl IntoIterator<Item = f64>) -> (TuneMeter<1>, usize) {
        let mut meter = TuneMeter::BLANK;
        meter.clear();
        let used = tunes.into_iter().filter(|tune| {
            let code = TuneCode::nearest(*tune - libm::floor(*tune)).unwrap();
            let used = meter.hear(code, &[0.0], Gate::default(), |_| 0.0);
            meter.judge();
            used
        });
        let used = used.count();
        (meter, used)
    }

    /// Uniform in ±1e-3, by the bits of a sine.
    fn scatter(i: u32) -> f64 {
        let hashed = 43_758.545 * libm::sin(12.9898 * f64::from(i) + 0.1);
        1e-3 * (2.0 * (hashed - libm::floor(hashed)) - 1.0)
    }

    #[test]
    fn noise_and_mean_are_those_of_the_readings_even_across_an_integer() {
        for design in [0.83, 0.0002, 0.9999] {
            let (meter, used) = meter((0..400).map(|i| design + scatter(i)));
            let (mean, _, count) = meter.mean();
            assert_eq!((used, count), (399, 399));
            assert!(f64::from(wrapped(mean - design as f32)).abs() < 1e-4, "{mean}");
            // uniform in ±1e-3: 5.8e-4 rms, and the 68 % quantile of a difference over sqrt 2 is 6.2e-4
            let sigma = libm::sqrtf(meter.variance().unwrap());
            assert!((5e-4..8e-4).contains(&sigma), "{sigma}");
            let rms = libm::sqrt(meter.scatter() / f64::from(count));
            assert!((rms / 5.8e-4 - 1.0).abs() < 0.1, "{rms}"); // 1/sqrt(800)
        }
    }

    #[test]
    fn a_jump_and_the_reading_after_it_do_not_count() {
        let jump = |i: u32| if i == 50 { 0.1 } else { 0.0 };
        let (meter, used) = meter((0..100).map(|i| 0.83 + scatter(i) + jump(i)));
        assert_eq!(used, 97);
        assert!((meter.mean().0 - 0.83).abs() < 2e-4);
    }

    #[test]
    fn supply_ripple_is_not_noise() {
        let mut meter = TuneMeter::<1>::BLANK;
        meter.clear();
        for i in 0..100 {
            let strength = 2e-4 * f32::from(i as i16 % 7 - 3);
            let code = TuneCode::nearest(0.83 - 7.0 * f64::from(strength)).unwrap();
            meter.hear(code, &[strength], Gate::default(), |change| -7.0 * change[0]);
            meter.judge();
        }
        let sigma = libm::sqrtf(meter.variance().unwrap());
        assert!(sigma < 5e-5, "{sigma}"); // the smallest that a histogram of this scale tells
        let (mean, [strength], _) = meter.mean();
        assert!((mean + 7.0 * strength - 0.83).abs() < 1e-6, "{mean}");
    }
}
