//! A frame that was judged, and not yet learnt: what a feedback acts on.
//!
//! The setpoints of the correctors, and the reply that tells them, do not wait until a frame is learnt: that takes two thirds of the
//! time, and what one frame adds to the vars is less than their error bars. Steering has the frame's orbit, and the vars of the frame
//! before.

use super::Estimator;
use super::screen::Screened;
use super::whole::{Expected, Whole};
use crate::drive::Drive;
use crate::estimate::{Health, MonitorState, Remarks};
use crate::monitor::Monitor;
use crate::surrogate::Surrogate;
use crate::wire::Frame;

/// A frame, and which of its readings count: `B` monitors, `C` correctors, `F` supplies, `W` words.
#[derive(Debug, Clone)]
#[must_use = "it is to be learnt"]
pub struct Judged<const B: usize, const C: usize, const F: usize, const W: usize> {
    /// The frame.
    pub frame: Frame<B, C, F, W>,
    /// Normalised innovation squared of the readings used, once the frame is learnt: on average one a reading. Where it is steered by,
    /// before that: each by itself, its correlation with others and tunes left out.
    pub nis: f32,
    /// The model was linearised anew since the frame before.
    pub linearised: bool,
    /// What is to be said of the frame as a whole, and so far of the posterior.
    pub remarks: Remarks,
    /// State of every monitor.
    pub health: [Health; B],
    pub(crate) drive: Drive<C, F>,
    pub(crate) expected: Expected<B, W>,
    /// The stored setting that it repeats.
    pub(crate) cell: Option<u16>,
    pub(crate) screened: Screened<W>,
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

    /// True if an operator should look: a monitor is not ok, or a var is clipped.
    pub fn needs_attention(&self) -> bool {
        self.monitors.iter().any(|m| m.state() != MonitorState::Ok) || !self.posterior.solution.clipped.is_empty()
    }
}
