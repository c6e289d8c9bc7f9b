//! The Gaussian of all frames so far, and its best point.

use serde::{Deserialize, Serialize};

use crate::gaussian::{Correlated, Gaussian, Solution};
use crate::prior::Prior;
use crate::sizes::Layout;

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
    /// Time that the params have walked for [s].
    walked: f64,
    /// The Gaussian was not positive since the last estimate.
    pub unsolved: bool,
}

impl<const K: usize, const N: usize, const T: usize, const U: usize, const W: usize> Posterior<K, N, T, U, W> {
    /// Memory for one, all zero.
    pub const BLANK: Self =
        Self { gaussian: Gaussian::BLANK, solution: Solution::BLANK, orbit: [0.0; 2], walked: 0.0, unsolved: false };

    /// Nothing has walked, nothing has failed.
    pub fn clear(&mut self) {
        (self.orbit, self.walked, self.unsolved) = ([0.0; 2], 0.0, false);
    }

    /// Solve the Gaussian.
    #[inline(never)]
    pub fn solve(&mut self, layout: &Layout, prior: impl Fn(usize) -> Prior) {
        self.unsolved |= !self.solution.solve(&self.gaussian, prior);
        let ([x, y], first) = (layout.ring.monitors.map(usize::from), layout.first_vertical());
        self.orbit = [self.gaussian.orbit(0, x), self.gaussian.orbit(first, first + y)];
    }

    /// Let params and baselines walk for a time [s]; false if nothing has to.
    #[inline(never)]
    pub fn walk<const B: usize>(
        &mut self,
        walk: &Walk,
        seconds: f32,
        layout: &Layout,
        prior: impl Fn(usize) -> Prior + Copy,
    ) -> bool {
        if seconds <= 0.0 || *walk == Walk::NONE {
            return false;
        }
        self.walked += f64::from(seconds);
        let variance = |noise: f32| noise * noise * seconds;
        self.gaussian.spread_baselines(variance(walk.baselines).into(), B);
        // After a long silence the vars are unknown, but not more than the range of the prior allows.
        let room = |(i, sigma): (usize, &f32)| 2.0 * prior(i).sigma * prior(i).sigma - sigma * sigma;
        let params = self.solution.sigma.iter().take(layout.params());
        let smallest = params.enumerate().map(room).fold(f32::MAX, f32::min);
        let variance = variance(walk.params).min(smallest.max(0.0));
        if variance > 0.0 {
            self.gaussian.walk(libm::sqrtf(variance), &mut self.solution);
            self.solve(layout, prior);
        }
        true
    }

    /// True while all frames so far have seen the same ring, and the same baselines.
    pub fn is_still<const B: usize>(&self, walk: &Walk) -> bool {
        let time = libm::sqrt(self.walked) as f32;
        let walked = walk.params * time;
        let moved = walk.baselines * time;
        let least = |sigma: f32| WALKED * sigma;
        self.solution.sigma.iter().all(|sigma| walked <= least(*sigma))
            && (moved == 0.0 || (0..B).all(|b| moved <= least(libm::sqrt(self.gaussian.baseline_variance(b)) as f32)))
    }
}
