//! Monitors: noise learnt from repeats, a gate against jumps, and the state of each.
//!
//! Noise is learnt from the difference of readings that repeat a setting, not from the model's residuals: those contain
//! the mismatch that the tool looks for. The gate likewise passes a reading that its repeats confirm, whatever the model
//! predicts ([`crate::Beside`]). Batch fits use these same definitions. Where nothing is repeated, residuals are all there is; what all monitors
//! share of them is the model's ([`Peers`]).
//!
//! What is old is forgotten, so that a monitor that turns noisy or recovers is found at any age of the stream.

use micromath::F32Ext;
use serde::{Deserialize, Serialize};

use crate::estimate::{Health, MonitorState};
use crate::state::state;
use crate::wire::PositionCode;

/// Decides whether two readings, or a reading and its prediction, agree.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Gate {
    /// Standard deviations allowed. At 5, one good reading in two million is refused.
    pub sigmas: f32,
}

impl Gate {
    /// True if two readings of noise `sigma` each may be of the same orbit.
    pub fn agree(&self, one: f32, other: f32, sigma: f32) -> bool {
        self.expects(one - other, 2.0 * sigma * sigma)
    }

    /// True if an innovation is within the gate of its variance.
    pub fn expects(&self, innovation: f32, variance: f32) -> bool {
        innovation * innovation <= self.sigmas * self.sigmas * variance
    }
}

impl Default for Gate {
    fn default() -> Self {
        Self { sigmas: 5.0 }
    }
}

/// Bins of the histogram: a quarter of an octave each.
const BINS: usize = 48;
/// Bins in an octave.
const PER_OCTAVE: f32 = 4.0;
/// Bin of a difference as large as the expected noise.
const CENTRE: f32 = 20.0;
/// Share of a normal distribution within one standard deviation.
const ONE_SIGMA: f32 = 0.682_689_5;
/// Standard error of `ln sigma` from one sigma's quantile of n differences is this over `sqrt(n)`:
/// `sqrt(p (1 - p))/(2 phi(1))` = 0.96, and 1.2 times that since neighbouring differences share a reading.
const QUANTILE_ERROR: f32 = 1.15;
/// Standard errors by which the repeats must contradict the expected noise before it is replaced.
const CONTRADICTION: f32 = 4.0;
/// Standard errors by which they must contradict a noise that was learnt already.
const REVISION: f32 = 0.5;
/// Standard errors within which they must be of the expected noise before that is taken up again.
const PARDON: f32 = 2.0;
/// Differences needed before the noise is revised at all.
const ENOUGH: u32 = 8;
/// Differences at which half of them are forgotten: more than a campaign has, and noise that turns fourfold passes the 68 % quantile
/// at 1.5 times the old within 200 more.
const FULL: u32 = 512;

/// The noise of one monitor, learnt from differences of repeats.
///
/// A histogram of the logarithm of their size is a robust scale: its 68 % quantile does not depend on how far a tenth of
/// the readings jump, nor on the order of the frames. Interpolating between quarter-octave bins and micromath's `exp`
/// (0.25 %) together cost less than 2 %, small against the 7 % statistical error of a campaign's 270 differences (test
/// `the_scale_is_right_for_normal_noise`).
#[derive(Debug, Clone)]
pub struct Noise {
    expected: f32,
    sigma: f32,
    total: u32,
    histogram: [u16; BINS],
}

state!([] Noise { expected, sigma, total, histogram });

impl Noise {
    /// Memory for one, all zero.
    pub const BLANK: Self = Self { expected: 0.0, sigma: 0.0, total: 0, histogram: [0; BINS] };

    /// Expect `sigma` [m].
    pub fn expecting(sigma: f32) -> Self {
        Self { expected: sigma, sigma, ..Self::BLANK }
    }

    /// Expect nothing but the order of magnitude: infinite until enough differences tell [m].
    pub fn unknown(scale: f32) -> Self {
        Self { expected: scale, sigma: f32::INFINITY, ..Self::BLANK }
    }

    /// Noise in use [m].
    pub fn sigma(&self) -> f32 {
        self.sigma
    }

    /// Learn from the difference of two readings that repeat a setting [m].
    pub fn learn(&mut self, difference: f32) {
        let size = difference.abs() * core::f32::consts::FRAC_1_SQRT_2 / self.expected;
        let bin = (libm::log2f(size.max(1e-6)) * PER_OCTAVE + CENTRE).clamp(0.0, (BINS - 1) as f32) as usize;
        if let Some(count) = self.histogram.get_mut(bin) {
            *count += 1;
            self.total += 1;
            if self.total >= FULL {
                self.forget_half();
            }
        }
    }

    fn forget_half(&mut self) {
        self.histogram.iter_mut().for_each(|count| *count /= 2);
        self.total = self.histogram.iter().map(|&count| u32::from(count)).sum();
    }

    /// True once there are enough differences to tell.
    pub const fn is_told(&self) -> bool {
        self.total >= ENOUGH
    }

    /// Noise estimated from the differences so far [m]; none before there are enough.
    pub fn learnt(&self) -> Option<f32> {
        if !self.is_told() {
            return None;
        }
        let target = ONE_SIGMA * self.total as f32;
        let mut below = 0.0;
        for (bin, &count) in self.histogram.iter().enumerate() {
            let count = f32::from(count);
            if below + count >= target {
                let edge = bin as f32 + (target - below) / count - CENTRE;
                return Some(self.expected * F32Ext::exp(edge / PER_OCTAVE * core::f32::consts::LN_2));
            }
            below += count;
        }
        None
    }

    /// Learn from the surprise of a reading that nothing repeats [m]: a difference has twice its variance.
    pub fn learn_alone(&mut self, surprise: f32) {
        self.learn(core::f32::consts::SQRT_2 * surprise);
    }

    /// Take over what was learnt if it contradicts the noise in use, or the expected noise if it no longer contradicts that;
    /// true if the noise changed.
    pub fn revise(&mut self) -> bool {
        let Some(learnt) = self.learnt() else { return false };
        let error = QUANTILE_ERROR / libm::sqrtf(self.total as f32);
        let contradicts = |noise: f32, errors: f32| libm::logf(learnt / noise).abs() > errors * error;
        let errors = if self.sigma == self.expected { CONTRADICTION } else { REVISION };
        if !contradicts(self.sigma, errors) {
            return false;
        }
        self.sigma = if contradicts(self.expected, PARDON) { learnt } else { self.expected };
        true
    }
}

/// Frames without a report after which a monitor counts as dead.
const SILENCE: u16 = 20;
/// Identical codes in a row after which a monitor counts as stuck: noise of 1500 steps makes that once in 1e9 frames.
const STUCK: u16 = 4;
/// Codes in a row that change by less than this share of the expected noise after which a monitor counts as flat: it reads its own
/// electronics and no beam. Of a monitor that reads one, 5.6 % of the changes are as small: eight in a row come once in 1e10 frames.
const FLAT: u16 = 8;
const FLAT_SHARE: f32 = 0.1;
/// A flat monitor reads the beam again when its code changes by this many times that share: 78 % of the changes of one that reads a beam do.
const BACK: i32 = 4;
/// Share of rejected readings above which a monitor counts as jumping; normal noise gives 6e-7.
const JUMPY: f32 = 0.01;
/// Fewest rejected readings for that.
const FEWEST_JUMPS: u16 = 3;
/// Reports after which half of them, and of the rejected ones, are forgotten: more than a campaign has.
const MANY: u16 = 512;
/// Factor on the variance of a monitor that jumps: its smaller jumps pass the gate.
const JUMPING: f32 = 2.0;
/// Ratio to the expected noise above which a monitor is noisy.
const NOISY: f32 = 1.5;

/// One monitor.
#[derive(Debug, Clone)]
pub struct Monitor {
    /// Its noise.
    pub noise: Noise,
    state: MonitorState,
    jumps: bool,
    silent: u16,
    unchanged: u16,
    flat: u16,
    /// Change of a code that counts as none for that.
    flatness: i32,
    /// Lately.
    reported: u16,
    refused: u16,
    /// In all.
    rejected: u32,
    last_code: i32,
}

state!([] Monitor {
    noise,
    state,
    jumps,
    silent,
    unchanged,
    flat,
    flatness,
    reported,
    refused,
    rejected,
    last_code,
});

impl Monitor {
    /// Memory for one, all zero.
    pub const BLANK: Self = Self {
        noise: Noise::BLANK,
        state: MonitorState::Ok,
        jumps: false,
        silent: 0,
        unchanged: 0,
        flat: 0,
        flatness: 0,
        reported: 0,
        refused: 0,
        rejected: 0,
        last_code: 0,
    };

    /// Restart with an expected noise [m].
    pub fn expect(&mut self, sigma: f32) {
        let flatness = (FLAT_SHARE * sigma / PositionCode::METRES_PER_LSB) as i32;
        *self = Self { noise: Noise::expecting(sigma), flatness, ..Self::BLANK };
    }

    /// Take note of a report (a code) or its absence; true if the reading can be used.
    pub fn hear(&mut self, code: Option<i32>) -> bool {
        let Some(code) = code else {
            self.silent = self.silent.saturating_add(1);
            return false;
        };
        let step = code.saturating_sub(self.last_code).saturating_abs();
        let flatness = if self.flat < FLAT { self.flatness } else { self.flatness.saturating_mul(BACK) };
        self.unchanged = if step == 0 { self.unchanged.saturating_add(1) } else { 0 };
        self.flat = if step <= flatness { self.flat.saturating_add(1) } else { 0 };
        self.last_code = code;
        let moving = self.unchanged < STUCK && self.flat < FLAT;
        self.silent = if moving { 0 } else { self.silent.saturating_add(1) };
        self.reported = self.reported.saturating_add(u16::from(moving));
        if self.reported >= MANY {
            (self.reported, self.refused) = (self.reported / 2, self.refused / 2);
        }
        moving
    }

    /// Count a reading that is not used.
    pub fn reject(&mut self) {
        self.rejected = self.rejected.saturating_add(1);
        self.refused = self.refused.saturating_add(1);
    }

    /// So many of the last rejected readings were right: a repeat has confirmed them.
    pub fn pardon(&mut self, readings: u8) {
        self.rejected = self.rejected.saturating_sub(readings.into());
        self.refused = self.refused.saturating_sub(readings.into());
    }

    /// Update the monitor's state; true if its readings so far need re-weighting.
    pub fn judge(&mut self) -> bool {
        let (jumped, noise_changed) = (self.jumps, self.noise.revise());
        self.jumps = self.refused >= FEWEST_JUMPS && f32::from(self.refused) > JUMPY * f32::from(self.reported);
        self.state = if self.silent >= SILENCE {
            MonitorState::Dead
        } else if self.noise.sigma > NOISY * self.noise.expected {
            MonitorState::Noisy
        } else if self.jumps {
            MonitorState::Jumps
        } else {
            MonitorState::Ok
        };
        noise_changed || jumped != self.jumps
    }

    /// Variance of one reading, as weighted [m^2].
    pub fn variance(&self) -> f32 {
        let variance = self.noise.sigma * self.noise.sigma;
        if self.jumps { JUMPING * variance } else { variance }
    }

    /// True if it is known to jump, noisy or not.
    pub const fn jumps(&self) -> bool {
        self.jumps
    }

    /// Its state.
    pub fn state(&self) -> MonitorState {
        self.state
    }

    /// State, noise and rejections, as an estimate carries them.
    pub fn health(&self) -> Health {
        Health {
            state: self.state,
            noise: self.noise.sigma,
            weighted_as: libm::sqrtf(self.variance()),
            rejected: self.rejected,
        }
    }
}

/// Median size of a standard normal number.
const MEDIAN: f32 = 0.674_489_8;
/// Share of itself by which the scale of all surprises moves in a frame where all are above it: its own error is then 2 %.
const FOLLOWS: f32 = 1.0 / 32.0;

/// How far the readings of all monitors together are off, over what is expected: what they share is the model's mismatch, and only
/// what a monitor is off beyond that is its noise. It is the median of all surprises, followed from frame to frame.
///
/// Source: H. Robbins and S. Monro, Ann. Math. Stat. 22 (1951) 400, ex. 2.
#[derive(Debug, Clone)]
pub struct Peers {
    /// By how much more than expected, as a share of that.
    excess: f32,
}

state!([] Peers { excess });

impl Peers {
    /// As expected; all zero.
    pub const EXPECTED: Self = Self { excess: 0.0 };

    /// Take note of the surprises in a frame, each over its standard deviation.
    pub fn hear(&mut self, surprises: impl Iterator<Item = f32>) {
        let (mut all, mut above) = (0.0, 0.0);
        for surprise in surprises {
            all += 1.0;
            above += f32::from(u8::from(surprise.abs() > MEDIAN * self.scale()));
        }
        if all > 0.0 {
            self.excess = (self.scale() * (1.0 + FOLLOWS * (2.0 * above / all - 1.0)) - 1.0).max(0.0);
        }
    }

    /// By this factor, 1 at least.
    pub fn scale(&self) -> f32 {
        1.0 + self.excess
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Normal numbers by the sum of twelve uniform ones (kurtosis 2.9), seed fixed.
    fn noise(n: usize) -> impl Iterator<Item = f32> {
        let mut state = 0x2545_f491_4f6c_dd1d_u64;
        let mut uniform = move || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 40) as f32 / (1u64 << 24) as f32
        };
        (0..n).map(move |_| (0..12).map(|_| uniform()).sum::<f32>() - 6.0)
    }

    fn learnt(sigma: f32, jump_every: usize, n: usize) -> Noise {
        let mut readings = noise(n + 1).enumerate().map(|(i, z)| {
            let jump = if i % jump_every == jump_every - 1 { 5e-3 } else { 0.0 };
            sigma * z + jump
        });
        let mut learner = Noise::expecting(1.5e-4);
        let mut last = readings.next().unwrap();
        for z in readings {
            learner.learn(z - last);
            last = z;
        }
        learner
    }

    #[test]
    fn micromath_exp_is_good_to_a_quarter_percent() {
        let worst = (-200..200)
            .map(|i| {
                let x = i as f32 * 0.02;
                (F32Ext::exp(x) / libm::expf(x) - 1.0).abs()
            })
            .fold(0.0, f32::max);
        assert!(worst < 0.0025, "{worst}");
    }

    #[test]
    fn the_scale_is_right_for_normal_noise() {
        let scale = learnt(1.5e-4, usize::MAX, 20_000).learnt().unwrap() / 1.5e-4;
        // the last 256 to 512 count: 1.15/sqrt(256) = 7 %, two of them
        assert!((scale - 1.0).abs() < 0.15, "{scale}");
    }

    #[test]
    fn jumps_of_every_twentieth_reading_hardly_move_the_scale() {
        let scale = learnt(1.5e-4, 20, 20_000).learnt().unwrap() / 1.5e-4;
        // a tenth of the differences hold a jump: the quantile moves from 68 % to 76 %, from 1.0 to 1.17 sigma, two times 7 % off
        assert!((1.02..1.33).contains(&scale), "{scale}");
    }

    #[test]
    fn expected_noise_stays_and_a_noisy_monitor_is_revised() {
        let mut good = learnt(1.5e-4, usize::MAX, 240);
        assert!(!good.revise());
        assert_eq!(good.sigma(), 1.5e-4);
        let mut bad = learnt(6e-4, usize::MAX, 24);
        assert!(bad.revise());
        assert!((bad.sigma() / 6e-4 - 1.0).abs() < 0.5, "{}", bad.sigma()); // 1.15/sqrt(24) = 0.23, two of them
    }

    #[test]
    fn silent_and_stuck_monitors_are_dead_until_they_report() {
        let mut monitor = Monitor::BLANK;
        monitor.expect(1.5e-4);
        for _ in 0..SILENCE {
            monitor.hear(None);
        }
        monitor.judge();
        assert_eq!(monitor.health().state, MonitorState::Dead);
        monitor.hear(Some(5));
        monitor.judge();
        assert_eq!(monitor.health().state, MonitorState::Ok);
        let used = (0..100).filter(|_| monitor.hear(Some(5))).count();
        assert_eq!(used, usize::from(STUCK) - 1);
        monitor.judge();
        assert_eq!(monitor.health().state, MonitorState::Dead);
    }

    /// Electronics without a beam scatter by a thirtieth of the noise; a monitor whose noise is a third of the expected one is no such.
    #[test]
    fn flat_monitors_are_dead_until_they_read_the_beam() {
        let mut monitor = Monitor::BLANK;
        monitor.expect(1.5e-4);
        let mut codes = noise(1000).map(|z| (z * 50.0) as i32);
        let used = (0..1000).filter(|_| monitor.hear(codes.next())).count();
        assert_eq!(used, usize::from(FLAT) - 1);
        monitor.judge();
        assert_eq!(monitor.health().state, MonitorState::Dead);
        let mut codes = noise(1000).map(|z| (z * 500.0) as i32);
        let used = (0..1000).filter(|_| monitor.hear(codes.next())).count();
        monitor.judge();
        assert!(used > 990 && monitor.health().state == MonitorState::Ok, "{used}");
    }

    #[test]
    fn a_long_stream_does_not_overflow() {
        let mut noise = Noise::expecting(1.0);
        (0..1_000_000).for_each(|_| noise.learn(1.0));
        assert!(noise.learnt().is_some());
    }

    /// Readings that repeat nothing, of a monitor that turns four times noisier after so many of them, and recovers.
    #[test]
    fn noise_that_turns_is_learnt_at_any_age_and_pardoned() {
        for age in [300, 3_000, 100_000] {
            let mut learner = Noise::expecting(1.5e-4);
            let mut readings = noise(age + 1000);
            let mut learn = |n: usize, sigma: f32| {
                readings.by_ref().take(n).for_each(|z| {
                    learner.learn_alone(sigma * z);
                    learner.revise();
                });
                learner.sigma() / 1.5e-4
            };
            assert_eq!(learn(age, 1.5e-4), 1.0, "after {age}");
            let noisy = learn(300, 6e-4);
            assert!(noisy > NOISY, "after {age}: {noisy}");
            assert_eq!(learn(700, 1.5e-4), 1.0, "after {age}");
        }
    }

    #[test]
    fn what_all_monitors_share_is_not_noise() {
        let mut peers = Peers::EXPECTED;
        let mut readings = noise(33 * 2000);
        let mut hear = |peers: &mut Peers, scale: f32| {
            (0..1000).for_each(|_| peers.hear(readings.by_ref().take(33).map(|z| scale * z)));
        };
        hear(&mut peers, 1.0);
        assert!((1.0..1.06).contains(&peers.scale()), "{}", peers.scale()); // 2 % of its own, three of them
        hear(&mut peers, 2.0);
        assert!((1.88..2.12).contains(&peers.scale()), "{}", peers.scale());
    }
}
