//! The Gaussian of all frames so far, and its best point.

use serde::{Deserialize, Serialize};

use super::drift::Drift;
use crate::gaussian::{Correlated, Gaussian, Solution};
use crate::prior::Prior;
use crate::sizes::Layout;
use crate::state::state;

/// How far a baseline may be moved by the step of a var [m]: the orbit passes quadrupoles some millimetres off their centres, and 2 %
/// of such a deflection moves it by 0.1 mm.
const STEERED: f32 = 1e-4;
/// Least variance that is added to a param where others walk: one part in 1e9 of the prior's, since none would be a division by 0.
const LEAST: f32 = 1e-12;
/// A walk waits until it would enlarge the variance of the best known param by this share; error bars are then 0.5 % too small at
/// most. It costs a frame as much as half of one, and waits for the time between two.
const AFTER: f32 = 0.01;
/// One by this share does not: a frame after a long silence is weighed by what is still known.
const BEFORE: f32 = 0.04;
/// While the params have walked less than this share of an error bar, all frames so far have seen the same ring.
const WALKED: f32 = 0.1;

/// Random walk of what is constant in a campaign: standard deviation per square root of a second, 0 for what is constant.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Walk {
    /// Of each theta.
    pub params: f32,
    /// Of each baseline [m].
    pub baselines: f32,
}

impl Walk {
    /// All is constant.
    pub const NONE: Self = Self { params: 0.0, baselines: 0.0 };

    /// True if both are numbers, and none is negative.
    pub fn is_sound(&self) -> bool {
        [self.params, self.baselines].iter().all(|walk| walk.is_finite() && *walk >= 0.0)
    }
}

/// The posterior of `N` params; `K` channels, `T` entries of a triangle of `N`, `U` of one of `K`, `W` words.
#[derive(Debug, Clone)]
pub(super) struct Posterior<const K: usize, const N: usize, const T: usize, const U: usize, const W: usize> {
    /// Information on params and baselines.
    pub gaussian: Gaussian<K, N, T, Correlated<K, U>>,
    /// Its best point.
    pub solution: Solution<N, T, W>,
    /// Rms of the baseline orbit in x and y [m].
    pub orbit: [f32; 2],
    /// Time since the beginning, while params and baselines may have walked, and the last part of it, for which the params' walk is
    /// not counted yet [s].
    walked: f64,
    owed: f32,
    /// A param has stepped: what was read before is of another ring.
    stepped: bool,
    /// The param that was let loose since the last estimate.
    pub let_loose: Option<u16>,
    /// Evidence for steps.
    drift: Drift<N>,
    /// `ln` of the determinant of the information before the frame at hand, and what the frame has added to it [nat].
    log_determinant: f64,
    pub narrowed: f64,
    /// The Gaussian was not positive since the last estimate.
    pub unsolved: bool,
}

state!([const K: usize, const N: usize, const T: usize, const U: usize, const W: usize] Posterior<K, N, T, U, W> {
    gaussian,
    solution,
    orbit,
    walked,
    owed,
    stepped,
    let_loose,
    drift,
    log_determinant,
    narrowed,
    unsolved,
});

impl<const K: usize, const N: usize, const T: usize, const U: usize, const W: usize> Posterior<K, N, T, U, W> {
    /// Channels of the monitors; those of the tune meter follow.
    const BASELINES: usize = K - 2;

    /// Memory for one, all zero.
    pub const BLANK: Self = Self {
        gaussian: Gaussian::BLANK,
        solution: Solution::BLANK,
        orbit: [0.0; 2],
        walked: 0.0,
        owed: 0.0,
        stepped: false,
        let_loose: None,
        drift: Drift::NONE,
        log_determinant: 0.0,
        narrowed: 0.0,
        unsolved: false,
    };

    /// Nothing has walked or stepped, nothing has failed.
    pub fn clear(&mut self) {
        (self.orbit, self.walked, self.stepped, self.unsolved) = ([0.0; 2], 0.0, false, false);
        (self.let_loose, self.narrowed, self.owed) = (None, f64::MAX, 0.0);
        self.drift.clear();
    }

    /// Solve the Gaussian.
    #[inline(never)]
    pub fn solve(&mut self, layout: &Layout, prior: impl Fn(usize) -> Prior) {
        self.unsolved |= !self.solution.solve(&self.gaussian, prior);
        let ([x, y], first) = (layout.ring.monitors.map(usize::from), layout.first_vertical());
        // where times in the cycle have baselines of their own, the largest orbit
        let (monitors, [mut in_x, mut in_y]) = (first + usize::from(layout.room.monitors[1]), [0.0_f32; 2]);
        for at in (0..Self::BASELINES).step_by(monitors.max(1)) {
            in_x = in_x.max(self.gaussian.orbit(at, at + x));
            in_y = in_y.max(self.gaussian.orbit(at + first, at + first + y));
        }
        self.orbit = [in_x, in_y];
    }

    /// Time has passed before a frame [s]: baselines walk, and so do params, if it is long.
    pub fn pass(&mut self, walk: &Walk, seconds: f32, layout: &Layout, prior: impl Fn(usize) -> Prior + Copy) {
        self.walked += f64::from(seconds);
        self.owed += seconds;
        self.gaussian.spread_baselines((walk.baselines * walk.baselines * seconds).into(), Self::BASELINES);
        self.walk_by(BEFORE, walk, layout, prior);
    }

    /// Between frames: let the params walk for the time that they have not yet. True if there was some that counts.
    pub fn walk(&mut self, walk: &Walk, layout: &Layout, prior: impl Fn(usize) -> Prior + Copy) -> bool {
        self.walk_by(AFTER, walk, layout, prior)
    }

    /// Let the params walk, if that enlarges a variance by more than a share.
    #[inline(never)]
    fn walk_by(&mut self, share: f32, walk: &Walk, layout: &Layout, prior: impl Fn(usize) -> Prior + Copy) -> bool {
        let known = self.solution.sigma;
        let least = known.iter().copied().fold(f32::MAX, f32::min);
        let step = walk.params * walk.params * self.owed;
        if step <= share * least * least {
            return false;
        }
        self.owed = 0.0;
        // After a long silence a var is unknown, but not more than the range of the prior allows.
        let room = |i: usize| 2.0 * prior(i).sigma * prior(i).sigma - known.get(i).map_or(0.0, |sigma| sigma * sigma);
        self.spread(|i| step.min(room(i)), layout, prior);
        true
    }

    /// Take note of what is expected of the next frame.
    pub fn expect(&mut self) {
        self.drift.expect(&self.gaussian, &self.solution);
        self.log_determinant = self.solution.log_determinant;
    }

    /// Take note of how much the frame has added to what is known.
    pub fn narrow(&mut self) {
        self.narrowed = self.solution.log_determinant - self.log_determinant;
    }

    /// Evidence that a param has stepped lately [nat].
    pub fn step_evidence(&self, prior: impl Fn(usize) -> Prior) -> f32 {
        self.drift.likeliest(|i| 1.0 / (prior(i).sigma * prior(i).sigma)).evidence
    }

    /// Weigh what a frame has said of steps; if there is one, let the params loose, each by its probability to have stepped.
    ///
    /// The variance of such a mixture is the probability times the prior's. A normal distribution of that variance would have the
    /// right one of 24 candidates, all of them as probable, 3 sigma off after a step of 2 %. With the root of the probability it is
    /// 1.5 sigma, and 2 for one of probability 0.01.
    #[inline(never)]
    pub fn let_loose(&mut self, layout: &Layout, prior: impl Fn(usize) -> Prior + Copy) {
        self.drift.weigh(&self.gaussian, libm::exp(self.narrowed).max(1.0));
        let precision = |i: usize| 1.0 / (prior(i).sigma * prior(i).sigma);
        let Some(step) = self.drift.found(precision) else { return };
        let probability = |i: usize| step.probability.get(i).copied().unwrap_or(0.0);
        self.gaussian.spread_baselines(f64::from(STEERED) * f64::from(STEERED), Self::BASELINES);
        self.spread(|i| libm::sqrtf(probability(i)) * prior(i).sigma * prior(i).sigma, layout, prior);
        self.drift.clear();
        (self.stepped, self.let_loose) = (true, u16::try_from(step.param).ok());
    }

    /// True if a param has stepped: what was read before is of another ring.
    pub fn has_stepped(&self) -> bool {
        self.stepped
    }

    /// Take the time since the beginning as not passed, if no param has stepped since; returns what is to be passed again [s].
    pub fn pause(&mut self) -> f32 {
        if self.stepped { 0.0 } else { core::mem::take(&mut self.walked) as f32 }
    }

    /// What was learnt does not count: params are as unknown as the prior has them, about the origin, and baselines within `baseline`.
    #[inline(never)]
    pub fn doubt(&mut self, baseline: f32, layout: &Layout, prior: impl Fn(usize) -> Prior + Copy) {
        self.gaussian.centre();
        self.solution.delta = [0.0; N];
        self.gaussian.spread_baselines(f64::from(baseline) * f64::from(baseline), Self::BASELINES);
        self.spread(|i| prior(i).sigma * prior(i).sigma, layout, prior);
        self.drift.clear();
    }

    /// Add so much variance to each param.
    fn spread(&mut self, variance: impl Fn(usize) -> f32, layout: &Layout, prior: impl Fn(usize) -> Prior) {
        let sigma = core::array::from_fn(|i| libm::sqrt(variance(i).max(LEAST).into()));
        self.gaussian.walk(&sigma, &mut self.solution);
        self.solve(layout, prior);
    }

    /// True while all frames so far have seen the same ring, and the same baselines.
    pub fn is_still(&self, walk: &Walk) -> bool {
        if self.stepped {
            return false;
        }
        let time = libm::sqrt(self.walked) as f32;
        let walked = walk.params * time;
        let moved = walk.baselines * time;
        let least = |sigma: f32| WALKED * sigma;
        self.solution.sigma.iter().all(|sigma| walked <= least(*sigma))
            && (moved == 0.0
                || (0..Self::BASELINES).all(|b| moved <= least(libm::sqrt(self.gaussian.baseline_variance(b)) as f32)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sizes::Sizes;

    const PRIOR: Prior = Prior { mean: 0.0, sigma: 0.03, lower: -0.06, upper: 0.06 };
    const RING: Sizes = Sizes::new([1, 0], [0; 2], [2, 2, 0]);
    const LAYOUT: Layout = Layout { ring: RING, room: RING };
    const WALK: Walk = Walk { params: 1e-3, baselines: 0.0 };

    fn posterior() -> Posterior<3, 2, 3, 6, 1> {
        let mut posterior = Posterior::BLANK;
        posterior.clear();
        posterior.gaussian.reset(|_| Prior { sigma: 0.003, ..PRIOR }, |_| 0.02);
        posterior.solve(&LAYOUT, |_| PRIOR);
        posterior
    }

    /// Ten minutes at 5 Hz: what waits is never more than a share of the variance, and none of it is lost.
    #[test]
    fn a_walk_that_waits_is_walked_in_the_end() {
        let (mut posterior, mut walks) = (posterior(), 0);
        for frame in 1..=1000_u16 {
            posterior.pass(&WALK, 0.2, &LAYOUT, |_| PRIOR);
            walks += u32::from(posterior.walk(&WALK, &LAYOUT, |_| PRIOR));
            let expected = 9e-6 + 1e-6 * 0.2 * f32::from(frame);
            let share = posterior.solution.sigma[0] * posterior.solution.sigma[0] / expected;
            assert!((1.0 - AFTER..1.0 + 1e-5).contains(&share), "frame {frame}: {share}");
        }
        assert!((100..400).contains(&walks), "{walks}");
    }

    #[test]
    fn a_frame_after_a_long_silence_waits_for_the_walk() {
        let mut posterior = posterior();
        posterior.pass(&WALK, 100.0, &LAYOUT, |_| PRIOR);
        let variance = posterior.solution.sigma.map(|sigma| sigma * sigma);
        assert!(variance.iter().all(|v| (v / 109e-6 - 1.0).abs() < 1e-5), "{variance:?}");
        // and no longer than until nothing more is known than the prior says, twice over
        posterior.pass(&WALK, 1e6, &LAYOUT, |_| PRIOR);
        let variance = posterior.solution.sigma[0] * posterior.solution.sigma[0];
        assert!((variance / (2.0 * 9e-4) - 1.0).abs() < 1e-5, "{variance}");
    }
}
