//! Linearising anew, in slices between frames: the surrogate at the MAP, then all frames so far counted by it into a second
//! Gaussian. Until the last slice, frames are answered with the old linearisation, and count in the new one too.
//!
//! A damped Gauss-Newton step: halved while it leads uphill or to an unstable ring.

use heapless::Deque;

use super::pooling::{Late, Pooling, Work};
use super::{Estimator, Model, Tangent};
use crate::surrogate::{Surrogate, Unstable};

/// What a call of [`Estimator::prepare`] did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[must_use]
pub enum Prepared {
    /// Nothing: there is nothing to do before the next frame.
    Nothing,
    /// A slice of the work.
    Slice,
    /// The last slice of linearising anew: the new linearisation is in use.
    Linearised,
}

/// A param that has moved by this many error bars calls for a new linearisation.
const MOVED: f32 = 0.5;
/// Growth of chi-square that counts as uphill: more than rounding of the readings' means.
const UPHILL: f64 = 1.0;
/// Attempts at a step, each half as long as the one before; the next one goes back to the origin.
const ATTEMPTS: u32 = 4;
/// Frames that can wait to be counted. With a further one all is counted anew.
const LATE: usize = 2;

/// A new linearisation on its way.
#[derive(Debug, Clone)]
pub(super) struct Anew<
    L,
    P,
    const B: usize,
    const C: usize,
    const F: usize,
    const N: usize,
    const S: usize,
    const K: usize,
    const T: usize,
    const W: usize,
> {
    pub under_way: bool,
    /// Params at which the model is linearised.
    pub to: [f32; N],
    /// Attempts so far.
    attempts: u32,
    /// The past was due to be weighted anew: its chi-square has no value to compare with.
    reweighted: bool,
    pub tangent: Tangent<L, F>,
    pub work: Work<P, S, K, N, T>,
    /// Frames that came after what they belong to had been counted.
    pub late: Deque<Late<B, C, F, W>, LATE>,
}

impl<
    L,
    P,
    const B: usize,
    const C: usize,
    const F: usize,
    const N: usize,
    const S: usize,
    const K: usize,
    const T: usize,
    const W: usize,
> Anew<L, P, B, C, F, N, S, K, T, W>
{
    /// Memory for one, all zero.
    pub const fn blank(unlinearised: L) -> Self {
        Self {
            under_way: false,
            to: [0.0; N],
            attempts: 0,
            reweighted: false,
            tangent: Tangent::blank(unlinearised),
            work: Work::Past(Pooling::BLANK),
            late: Deque::new(),
        }
    }

    /// Stay with the old linearisation; a past that was due to be weighted anew is so still.
    pub fn give_up(&mut self, stale: &mut bool) {
        *stale |= self.under_way && self.reweighted;
        self.under_way = false;
    }
}

impl<
    G: Surrogate<B, C, F, N>,
    const B: usize,
    const C: usize,
    const F: usize,
    const N: usize,
    const S: usize,
    const K: usize,
    const T: usize,
    const U: usize,
    const W: usize,
> Estimator<G, B, C, F, N, S, K, T, U, W>
{
    /// True if the MAP has left the origin, or a past that still counts has to be weighted anew.
    pub(super) fn is_due(&self, model: &Model<'_, G, B, C, F>) -> bool {
        let each = self
            .posterior
            .solution
            .map_params
            .iter()
            .zip(self.posterior.gaussian.origin())
            .zip(&self.posterior.solution.sigma);
        let stale = self.past.stale && self.posterior.is_still(&model.setup.walk);
        stale || each.into_iter().any(|((map, origin), sigma)| (map - origin).abs() > MOVED * sigma)
    }

    /// Begin to linearise at the MAP.
    pub(super) fn begin(&mut self) {
        (self.anew.to, self.anew.attempts) = (self.posterior.solution.map_params, 0);
        self.anew.reweighted = core::mem::take(&mut self.past.stale);
        self.attempt();
    }

    fn attempt(&mut self) {
        self.anew.under_way = true;
        self.anew.attempts += 1;
        self.anew.tangent.supplies = self.past.campaign.mean_strength();
        self.anew.work = Work::Surrogate(G::BEGIN);
        self.anew.late.clear();
    }

    /// Try half the step; after the last attempt, go back to the origin; and if there is no ring even there, give up.
    fn retry(&mut self) {
        let from = self.posterior.gaussian.origin();
        match self.anew.attempts {
            ..ATTEMPTS => self.anew.to.iter_mut().zip(from).for_each(|(to, from)| *to = 0.5 * (*to + from)),
            ATTEMPTS => self.anew.to = *from,
            _ => return self.anew.give_up(&mut self.past.stale),
        }
        self.attempt();
    }

    /// One slice.
    #[inline(never)]
    pub(super) fn slice(&mut self, model: &Model<'_, G, B, C, F>) -> Prepared {
        let Tangent { linearised, supplies, .. } = &mut self.anew.tangent;
        match &mut self.anew.work {
            Work::Surrogate(progress) => match model.surrogate.advance(&self.anew.to, supplies, progress, linearised) {
                Ok(false) => {}
                Ok(true) => self.anew.work = Work::Following(0),
                Err(Unstable) => self.retry(),
            },
            Work::Following(plane) => {
                self.anew.tangent.follow(model.surrogate, *plane);
                *plane += 1;
                if *plane == 2 {
                    self.anew.work = Work::Past(Pooling::BLANK);
                }
            }
            Work::Past(_) => return self.count_past(model),
        }
        Prepared::Slice
    }

    /// Count a part of the past, or go over to the new linearisation. While the params walk, the past stays counted as it was.
    fn count_past(&mut self, model: &Model<'_, G, B, C, F>) -> Prepared {
        if !self.posterior.is_still(&model.setup.walk) {
            self.recentre(model);
            return self.go_over(model);
        }
        if self.pool_next(model) {
            return Prepared::Slice;
        }
        self.finish_pooling(model);
        let Work::Past(pooling) = &self.anew.work else { return Prepared::Slice };
        // A past that is weighted anew has another chi-square; the step is then judged with the next one.
        let any = self.anew.reweighted || self.past.stale || self.anew.attempts > ATTEMPTS;
        if !any && pooling.gaussian.cost() > self.posterior.gaussian.cost() + UPHILL {
            self.retry();
            return Prepared::Slice;
        }
        self.posterior.gaussian.copy(&pooling.gaussian);
        self.go_over(model)
    }

    fn go_over(&mut self, model: &Model<'_, G, B, C, F>) -> Prepared {
        core::mem::swap(&mut self.tangent, &mut self.anew.tangent);
        self.tangent.is_new = true;
        self.anew.under_way = false;
        self.solve(model);
        Prepared::Linearised
    }

    /// Linearise anew at once.
    ///
    /// # Errors
    /// [`Unstable`] if there is no ring even at the origin.
    pub(super) fn linearise_anew(&mut self, model: &Model<'_, G, B, C, F>) -> Result<(), Unstable> {
        self.begin();
        while self.anew.under_way {
            if self.slice(model) == Prepared::Linearised {
                return Ok(());
            }
        }
        Err(Unstable)
    }
}
