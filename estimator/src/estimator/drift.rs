//! Steps of single params, by a test directed at each: a step of 2 % does not show in the NIS of a frame.
//!
//! What a frame says of the params, against what was expected of it, is its score: with its readings' derivatives `d`, variances
//! `s`, and innovations `e`, `h = sum of d e/s`, whose expectation grows by `dY nu` once params have stepped by `nu`; `dY = sum of
//! d d^T/s` is the information that the frame has added. Innovations of different frames are independent, so that the evidence
//! for a step of one param by `nu` since some frame is a sum over the frames since then of
//!
//! `(nu h_i - nu^2 dY_ii/2)/f`,   `variance of h_i = dY_ii + (dY P dY)_ii <= f dY_ii`,   `f = det(Y + dY)/det Y`:
//!
//! `f` bounds what the posterior's own covariance `P` adds, so that the evidence is never overstated. While the posterior still
//! narrows fast, `f` is large, and nothing can be said of steps. The sum is kept for the frame since which it is largest, for
//! each param and sign.
//!
//! That something has stepped is known within some frames, mostly by the tunes; which param it was, takes the orbits of many
//! more. So each param is let loose by the probability that it is the one: no wrong neighbour is taken for the right one, and
//! the frames that come decide.
//!
//! Source: E. S. Page, Biometrika 41 (1954) 100; M. Basseville and I. Nikiforov, Detection of Abrupt Changes (1993), ch. 2 and 7;
//! one Gaussian for many hypotheses as in G. Ackerson and K. Fu, IEEE Trans. Autom. Control 15 (1970) 10.

use crate::gaussian::{Gaussian, Solution};

/// Step that is looked for, of theta: steps of 1 to 4 % are found nearly as fast as by a test for just their size, and a lag
/// behind a slow drift of less than half of it counts as none.
const STEP: f64 = 0.015;
/// Evidence at which a param has stepped [nat].
const ENOUGH: f32 = 12.0;

/// Evidence for steps of `N` params.
#[derive(Debug, Clone)]
pub(super) struct Drift<const N: usize> {
    /// Best point before the frame at hand, information on each param, and `ln` of its determinant.
    mean: [f64; N],
    information: [f64; N],
    log_determinant: f64,
    /// Evidence for a step up, and for one down [nat].
    evidence: [[f32; N]; 2],
}

/// A step that was found.
#[derive(Debug, Clone, Copy)]
pub(super) struct Step<const N: usize> {
    /// The most probable param.
    pub param: usize,
    /// Probability of each to be the one.
    pub probability: [f32; N],
}

impl<const N: usize> Drift<N> {
    /// No evidence.
    pub const NONE: Self = Self { mean: [0.0; N], information: [0.0; N], log_determinant: 0.0, evidence: [[0.0; N]; 2] };

    /// Begin anew.
    pub fn clear(&mut self) {
        *self = Self::NONE;
    }

    /// Take note of what is expected of the next frame.
    pub fn expect<const B: usize, const T: usize, const W: usize>(
        &mut self,
        gaussian: &Gaussian<B, N, T>,
        solution: &Solution<N, T, W>,
    ) {
        (self.mean, self.log_determinant) = (solution.delta, solution.log_determinant);
        self.information = gaussian.informations();
    }

    /// Weigh what the frame has said; returns the step, if there is one.
    pub fn weigh<const B: usize, const T: usize, const W: usize>(
        &mut self,
        gaussian: &Gaussian<B, N, T>,
        solution: &Solution<N, T, W>,
    ) -> Option<Step<N>> {
        let narrowed = libm::exp(solution.log_determinant - self.log_determinant);
        let score = gaussian.pull(&self.mean);
        let gained = gaussian.informations();
        let (mut most, mut param) = (0.0, 0);
        for (sign, evidence) in [STEP, -STEP].into_iter().zip(&mut self.evidence) {
            let each = score.iter().zip(gained.iter().zip(&self.information));
            for (i, (evidence, (score, (now, before)))) in evidence.iter_mut().zip(each).enumerate() {
                let news = (sign * score - 0.5 * STEP * STEP * (now - before)) / narrowed;
                *evidence = (*evidence + news as f32).max(0.0);
                if *evidence > most {
                    (most, param) = (*evidence, i);
                }
            }
        }
        (most > ENOUGH).then(|| Step { param, probability: self.probability(most) })
    }

    /// Probability of each param to be the one that has stepped, all of them as probable beforehand.
    fn probability(&self, most: f32) -> [f32; N] {
        let [up, down] = &self.evidence;
        let mut weight = [0.0; N];
        weight.iter_mut().zip(up.iter().zip(down)).for_each(|(to, (up, down))| *to = libm::expf(up.max(*down) - most));
        let all: f32 = weight.iter().sum();
        weight.map(|weight| weight / all)
    }
}
