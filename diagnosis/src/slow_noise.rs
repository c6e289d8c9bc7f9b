//! What the noise of all monitors remembers: the share of slow noise, its correlation time and a random walk, learnt from repeats.
//!
//! The likelihood is that of `repeats.rs`, summed over the monitors. Each of these has, with a small probability, noise of its own kind,
//! so that one monitor that wanders by itself says nothing of the others:
//!
//! `ln L = sum over monitors of ln((1 - OWN) L_b + OWN best L_b)`.
//!
//! Priors have their mode at none, with ordinary sizes as widths (half-normal). Slow noise, walk, both and neither are compared by
//! their evidence (Laplace, in the logarithms), and only what is more likely than not is taken over.

use nalgebra::DVector;
use twin::Measured;

use super::half_normal::HalfNormal;
use super::laplace::Peak;
use super::memory::Memory;
use super::repeats::Repeats;

/// What is learnt; 0 with its upper range as error for what is not needed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Slow {
    /// Share of the noise's variance that is slow [1].
    pub share: Measured,
    /// Its correlation time [frames].
    pub time: Measured,
    /// Random walk of a monitor [m per root frame].
    pub walk: Measured,
}

/// Probability that the noise of a monitor is of its own kind: one or two of some tens are faulty in a way that screening does not see.
pub(super) const OWN: f64 = 0.03;
/// Width of the prior of the share: electronics with more slow noise than a quarter are not ordinary.
pub const SHARE: f64 = 0.25;
/// Largest share: some noise is white.
const MOST: f64 = 0.9;
/// Shortest and longest correlation times that differ from white noise and from a walk, the latter over the number of frames; the prior
/// of the logarithm has them two widths from its mean.
const TIMES: [f64; 2] = [1.0, 0.2];
/// Walk of more than this many prior widths is no ordinary noise: it is left to the search.
const WANDERING: f64 = 4.0;
/// Values at which a monitor's own best is sought, in the units of the priors, and starts of the search for the common ones.
const SHARES: [f64; 4] = [0.0, 0.2, 0.6, 2.0];
const STEPS: [f64; 5] = [0.0, 0.25, 0.7, 2.0, 8.0];
/// Passes over noise scale and memory.
const PASSES: usize = 2;
/// Points at which the range of what is not needed is integrated.
const RANGE: usize = 12;

/// Coordinates: share, time and walk (in units of the mean noise) of all monitors.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Common {
    share: f64,
    time: f64,
    steps: f64,
}

/// Which of them are free.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Free {
    slow: bool,
    walk: bool,
}

/// Repeats of the monitors, and what each would have by itself.
struct Learner<'r> {
    repeats: &'r [Repeats],
    /// Noise of each over the mean.
    relative: Vec<f64>,
    frames: f64,
    /// `ln` likelihood of white noise, and of the best of its own kind over that.
    white: Vec<f64>,
    own: Vec<f64>,
    /// Starts for the common ones, with their `ln` likelihood over that of white noise.
    starts: Vec<(Common, f64)>,
}

impl Slow {
    /// White noise, of which nothing is known.
    pub const NONE: Self = Self {
        share: Measured { value: 0.0, sigma: 0.0 },
        time: Measured { value: 0.0, sigma: 0.0 },
        walk: Measured { value: 0.0, sigma: 0.0 },
    };

    /// Learn from repeats of monitors whose noise is about `sigma` each [m], in a recording of so many frames.
    pub fn learn(repeats: &[Repeats], sigma: &[f64], frames: usize) -> Self {
        if repeats.is_empty() {
            return Self::NONE;
        }
        let mean = sigma.iter().sum::<f64>() / sigma.len() as f64;
        let mut relative: Vec<f64> = sigma.iter().map(|sigma| sigma / mean).collect();
        let mut found = Self::NONE;
        for _ in 0..PASSES {
            let learner = Learner::from_repeats(repeats, relative.clone(), frames);
            found = learner.learn(mean);
            let memory = |b: usize| found.memory(relative[b] * mean);
            relative = (0..repeats.len())
                .map(|b| repeats[b].weigh(memory(b)).sigma().map_or(relative[b], |sigma| sigma / mean))
                .collect();
            if found.is_none() {
                break;
            }
        }
        found
    }

    /// True if the noise is white as far as can be seen.
    pub fn is_none(&self) -> bool {
        self.share.value == 0.0 && self.walk.value == 0.0
    }

    /// The memory of a monitor of some noise [m].
    pub(crate) fn memory(&self, sigma: f64) -> Memory {
        if self.is_none() {
            return Memory::NONE;
        }
        Memory { share: self.share.value, time: self.time.value.max(TIMES[0]), steps: self.walk.value / sigma }
    }
}

impl<'r> Learner<'r> {
    fn from_repeats(repeats: &'r [Repeats], relative: Vec<f64>, frames: usize) -> Self {
        let log_likelihood_of =
            |common: Common, b: usize| repeats[b].weigh(common.memory(relative[b])).log_likelihood();
        let white: Vec<f64> = (0..repeats.len()).map(|b| log_likelihood_of(Common::NONE, b)).collect();
        let frames = frames as f64;
        let over_white = |common: Common| (0..repeats.len()).map(|b| log_likelihood_of(common, b) - white[b]).collect();
        let tried: Vec<(Common, Vec<f64>)> = grid(frames).into_iter().map(|one| (one, over_white(one))).collect();
        let best = |b: usize| tried.iter().map(|(_, logs)| logs[b]).fold(0.0, f64::max);
        let own: Vec<f64> = (0..repeats.len()).map(best).collect();
        let starts = tried.iter().map(|(one, logs)| (*one, together(logs, &own))).collect();
        Self { repeats, relative, frames, white, own, starts }
    }

    /// `ln` likelihood over that of white noise, each monitor's own kind allowed for.
    fn likelihood(&self, common: Common) -> f64 {
        let gain_of_monitor =
            |b: usize| self.repeats[b].weigh(common.memory(self.relative[b])).log_likelihood() - self.white[b];
        together(&(0..self.repeats.len()).map(gain_of_monitor).collect::<Vec<_>>(), &self.own)
    }

    /// `ln` prior density of the logarithms of what is free.
    fn log_prior(&self, common: Common, free: Free) -> f64 {
        let half_normal = |x: f64| core::f64::consts::FRAC_2_PI.sqrt().ln() - 0.5 * x * x + x.ln();
        let slow = if free.slow {
            let [mean, width] = log_time(self.frames);
            let z = (common.time.ln() - mean) / width;
            half_normal(common.share / SHARE) - 0.5 * z * z - 0.5 * (core::f64::consts::TAU * width * width).ln()
        } else {
            0.0
        };
        slow + if free.walk { half_normal(common.steps / steps(self.frames)) } else { 0.0 }
    }

    /// The most likely model, `mean` being the mean noise [m].
    fn learn(&self, mean: f64) -> Slow {
        let nothing = self.likelihood(Common::NONE);
        let models = [(true, false), (false, true), (true, true)].map(|(slow, walk)| Free { slow, walk });
        let mut best: Option<(Free, Peak)> = None;
        for free in models {
            let posterior = |(one, log): &(Common, f64)| log + self.log_prior(*one, free);
            let of_model = self.starts.iter().filter(|(one, _)| one.is_of(free));
            let Some((start, _)) = of_model.max_by(|a, b| posterior(a).total_cmp(&posterior(b))) else { continue };
            let density = |x: &DVector<f64>| {
                let common = Common::at(x, free);
                self.likelihood(common) + self.log_prior(common, free)
            };
            let least = best.as_ref().map_or(nothing, |(_, peak)| peak.log_integral);
            let peak = Peak::find(density, &start.coordinates(free), &self.bounds(free));
            best = peak.filter(|peak| peak.log_integral > least).map(|peak| (free, peak)).or(best);
        }
        let (common, sigma) = best.map_or((Common::NONE, [0.0; 3]), |(free, peak)| Common::measured(&peak, free));
        let range = |common: &dyn Fn(f64) -> Common, width: f64| self.range(common, width);
        let [centre, _] = log_time(self.frames);
        let time = if common.share > 0.0 { common.time } else { centre.exp() };
        let share_sigma = match common.share {
            0.0 => range(&|share| Common { share, time, ..common }, SHARE),
            share => share * sigma[0],
        };
        let walk_sigma = match common.steps {
            0.0 => range(&|steps| Common { steps, ..common }, steps(self.frames)),
            steps => steps * sigma[2],
        };
        let time = if common.share > 0.0 { common.time } else { 0.0 };
        Slow {
            share: Measured { value: common.share, sigma: share_sigma },
            time: Measured { value: time, sigma: time * sigma[1] },
            walk: Measured { value: common.steps * mean, sigma: walk_sigma * mean },
        }
    }

    /// Root mean square, by its posterior, of what is not needed.
    fn range(&self, common: &dyn Fn(f64) -> Common, width: f64) -> f64 {
        HalfNormal::from_log_likelihood(|size| self.likelihood(common(size.min(MOST))), width, RANGE).square.sqrt()
    }

    fn bounds(&self, free: Free) -> Vec<[f64; 2]> {
        let slow = [[SHARE * 1e-3, MOST], [0.5 * TIMES[0], 2.0 * TIMES[1] * self.frames]];
        let walk = [steps(self.frames) * 1e-2, steps(self.frames) * WANDERING];
        let slow = slow.into_iter().filter(|_| free.slow);
        slow.chain(free.walk.then_some(walk)).map(|bounds| bounds.map(f64::ln)).collect()
    }
}

impl Common {
    const NONE: Self = Self { share: 0.0, time: 1.0, steps: 0.0 };

    /// The memory of a monitor of some noise over the mean.
    fn memory(self, relative: f64) -> Memory {
        Memory { share: self.share, time: self.time, steps: self.steps / relative }
    }

    fn is_of(&self, free: Free) -> bool {
        (self.share > 0.0) == free.slow && (self.steps > 0.0) == free.walk
    }

    fn at(x: &DVector<f64>, free: Free) -> Self {
        let slow = if free.slow { [x[0].exp(), x[1].exp()] } else { [0.0, 1.0] };
        Self { share: slow[0], time: slow[1], steps: if free.walk { x[x.len() - 1].exp() } else { 0.0 } }
    }

    fn coordinates(&self, free: Free) -> DVector<f64> {
        let slow = [self.share, self.time].into_iter().filter(|_| free.slow);
        DVector::from_vec(slow.chain(free.walk.then_some(self.steps)).map(f64::ln).collect())
    }

    /// A peak, with the standard deviations of the logarithms of share, time and walk.
    fn measured(peak: &Peak, free: Free) -> (Self, [f64; 3]) {
        let slow = if free.slow { [peak.sigma(0), peak.sigma(1)] } else { [0.0; 2] };
        let walk = if free.walk { peak.sigma(peak.at.len() - 1) } else { 0.0 };
        (Self::at(&peak.at, free), [slow[0], slow[1], walk])
    }
}

/// Sum over the monitors of `ln` likelihood, where each may have noise of its own kind, of which `own` is the best.
fn together(logs: &[f64], own: &[f64]) -> f64 {
    let one = |(log, own): (&f64, &f64)| {
        let best = own.max(*log);
        best + ((1.0 - OWN) * (log - best).exp() + OWN * (own - best).exp()).ln()
    };
    logs.iter().zip(own).map(one).sum()
}

/// Width of the prior of the walk, in units of the noise: over the campaign a monitor wanders by as much as it is noisy.
pub fn steps(frames: f64) -> f64 {
    frames.sqrt().recip()
}

/// Mean and width of `ln` of the correlation time.
fn log_time(frames: f64) -> [f64; 2] {
    let [shortest, longest] = [TIMES[0].ln(), (TIMES[1] * frames).max(2.0 * TIMES[0]).ln()];
    [0.5 * (shortest + longest), 0.25 * (longest - shortest)]
}

/// Shares, times and walks.
fn grid(frames: f64) -> Vec<Common> {
    let [mean, width] = log_time(frames);
    let times = [-1.5, 0.0, 1.5].map(|z| (mean + z * width).exp());
    let of_share = |share: f64| {
        let times = if share == 0.0 { vec![1.0] } else { times.to_vec() };
        times
            .into_iter()
            .flat_map(move |time| STEPS.map(|step| Common { share: share * SHARE, time, steps: step * steps(frames) }))
    };
    SHARES.into_iter().flat_map(of_share).collect()
}
