//! Steps of single params, by a test directed at each: a step of 2 % does not show in the NIS of a frame.
//!
//! What a frame says of the params, against what was expected of it, is its score: with its readings' derivatives `d`, variances
//! `s`, and innovations `e`, `h = sum of d e/s`, whose expectation grows by `dY nu` once params have stepped by `nu`; `dY = sum of
//! d d^T/s` is the information that the frame has added. Innovations of different frames are independent, so that their sum over
//! the last frames, older ones forgotten, is compared with its own variance: the evidence for a step of param `i` alone, of a size
//! that is as probable as its prior has it, is
//!
//! `z_i^2/2`,   `z_i = (sum of h_i/f)/sqrt(1/sigma_i^2 + sum of dY_ii/f)`,   `variance of h_i = dY_ii + (dY P dY)_ii <= f dY_ii`,
//!
//! with the prior's `sigma_i`: correctors that stand still say hardly anything of the vars, and an orbit that drifts by itself would
//! else be the evidence of absurd steps. The factor `f = det(Y + dY)/det Y` bounds what the posterior's own covariance `P` adds, so
//! that `z` is never overstated. While the posterior still narrows fast, `f` is large, and nothing can be said of steps.
//!
//! That something has stepped is known within some frames, mostly by the tunes; which param it was, takes the orbits of some
//! hundred more, since neighbours by phase advance act alike. So all are let loose, each by its probability to be the one, and
//! the frames that come decide: nobody is taken for the wrong one.
//!
//! Source: A. Willsky and H. Jones, IEEE Trans. Autom. Control 21 (1976) 108; M. Basseville and I. Nikiforov, Detection of Abrupt
//! Changes (1993), ch. 7.

use crate::gaussian::{Covariance, Gaussian, Solution};
use crate::state::state;

/// Frames after which the score of one has lost all but 1/e of its weight: a step that the tunes show, and one that only orbits do.
const WINDOWS: [f32; 2] = [8.0, 48.0];
/// Evidence at which a param has stepped [nat]: 4.9 standard deviations.
const ENOUGH: f32 = 12.0;

/// Evidence for steps of `N` params.
#[derive(Debug, Clone)]
pub(super) struct Drift<const N: usize> {
    /// Best point before the frame at hand, and information on each param.
    mean: [f64; N],
    information: [f64; N],
    windows: [[Score; N]; WINDOWS.len()],
}

state!([const N: usize] Drift<N> { mean, information, windows });

/// Sum of the scores of a param, and its variance.
#[derive(Debug, Clone, Copy)]
struct Score {
    sum: f32,
    variance: f32,
}

state!([] Score { sum, variance });

/// A step that was found.
#[derive(Debug, Clone, Copy)]
pub(super) struct Step<const N: usize> {
    /// The param that has most probably stepped.
    pub param: usize,
    /// Evidence that it has [nat].
    pub evidence: f32,
    /// Probability of each param to be the one that has stepped, all of them as probable beforehand.
    pub probability: [f32; N],
}

impl Score {
    const NONE: Self = Self { sum: 0.0, variance: 0.0 };

    fn add(&mut self, kept: f32, score: f32, variance: f32) {
        self.sum = kept * self.sum + score;
        self.variance = kept * kept * self.variance + variance;
    }

    /// Evidence of a step whose size is normal about 0, of this precision [nat].
    fn evidence(&self, precision: f32) -> f32 {
        0.5 * self.sum * self.sum / (self.variance + precision)
    }
}

impl<const N: usize> Drift<N> {
    /// No evidence.
    pub const NONE: Self = Self { mean: [0.0; N], information: [0.0; N], windows: [[Score::NONE; N]; WINDOWS.len()] };

    /// Begin anew.
    pub fn clear(&mut self) {
        *self = Self::NONE;
    }

    /// Take note of what is expected of the next frame.
    pub fn expect<const B: usize, const T: usize, const W: usize, V: Covariance<B>>(
        &mut self,
        gaussian: &Gaussian<B, N, T, V>,
        solution: &Solution<N, T, W>,
    ) {
        (self.mean, self.information) = (solution.delta, gaussian.informations());
    }

    /// Weigh what the frame has said, which has enlarged the determinant of the information by this factor.
    pub fn weigh<const B: usize, const T: usize, V: Covariance<B>>(
        &mut self,
        gaussian: &Gaussian<B, N, T, V>,
        narrowed: f64,
    ) {
        let (score, information) = (gaussian.pull(&self.mean), gaussian.informations());
        for (scores, window) in self.windows.iter_mut().zip(WINDOWS) {
            let kept = 1.0 - 1.0 / window;
            let each = score.iter().zip(information.iter().zip(&self.information));
            for (to, (score, (now, before))) in scores.iter_mut().zip(each) {
                to.add(kept, (score / narrowed) as f32, ((now - before) / narrowed) as f32);
            }
        }
    }

    /// The step for which there is most evidence; `precision` is that of the prior of a param.
    pub fn likeliest(&self, precision: impl Fn(usize) -> f32) -> Step<N> {
        let mut step = Step { param: 0, evidence: 0.0, probability: [0.0; N] };
        for scores in &self.windows {
            let own = scores.iter().enumerate().map(|(i, score)| (i, score.evidence(precision(i))));
            let (param, evidence) = own.clone().fold((0, 0.0), |most, this| if this.1 > most.1 { this } else { most });
            if evidence > step.evidence {
                // of more evidence than it takes, what tells candidates apart is the error of linearising
                let counts = (ENOUGH / evidence).min(1.0);
                let weight = |(_, own): (usize, f32)| libm::expf(counts * (own - evidence));
                let all: f32 = own.clone().map(weight).sum();
                (step.param, step.evidence) = (param, evidence);
                step.probability.iter_mut().zip(own).for_each(|(to, this)| *to = weight(this) / all);
            }
        }
        step
    }

    /// That step, if the evidence suffices.
    pub fn found(&self, precision: impl Fn(usize) -> f32) -> Option<Step<N>> {
        Some(self.likeliest(precision)).filter(|step| step.evidence > ENOUGH)
    }
}
