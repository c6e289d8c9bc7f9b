//! What is said of a frame, and of the estimator.

use super::Estimator;
use super::whole::Whole;
use crate::drive::Drive;
use crate::estimate::{MonitorState, Remarks};
use crate::judged::{Expected, Judged, Screened};
use crate::monitor::Monitor;
use crate::surrogate::Surrogate;
use crate::wire::Frame;

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
    /// Put together what was found of a frame.
    pub(super) fn judged(
        &mut self,
        frame: Frame<B, C, F, W>,
        drive: Drive<C, F>,
        (whole, expected): (Whole, Expected<B, W>),
        (cell, screened): (Option<u16>, Screened<W>),
    ) -> Judged<B, C, F, W> {
        let remarks = Remarks {
            put_aside: whole == Whole::Aside,
            baselines_moved: whole == Whole::Moved,
            unsolved: self.posterior.unsolved,
            slices: core::mem::take(&mut self.slices),
            let_loose: self.posterior.let_loose,
        };
        let linearised = core::mem::take(&mut self.tangent.is_new);
        let health = core::array::from_fn(|b| self.monitors.get(b).map(Monitor::health).unwrap_or_default());
        Judged { frame, nis: 0.0, linearised, remarks, health, drive, expected, cell, screened }
    }

    /// What is to be said of a frame, and of the posterior since that was said last.
    pub fn remark(&mut self, judged: &Judged<B, C, F, W>) -> Remarks {
        let unsolved = core::mem::take(&mut self.posterior.unsolved);
        Remarks { unsolved, let_loose: self.posterior.let_loose.take(), ..judged.remarks }
    }

    /// True if the surrogate was linearised within the range that it was made for; outside it extrapolates.
    pub fn is_within(&self, surrogate: &G) -> bool {
        surrogate.is_within(&self.tangent.linearised)
    }

    /// True if an operator should look: a monitor is not ok, or a var is clipped.
    pub fn needs_attention(&self) -> bool {
        self.monitors.iter().any(|m| m.state() != MonitorState::Ok) || !self.posterior.solution.clipped.is_empty()
    }
}
