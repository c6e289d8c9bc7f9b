//! What a feedback takes from the estimate: the response at the estimated vars, and the covariance of the params.

use super::{Estimator, IngestError, Model};
use crate::judged::Judged;
use crate::steer::{Feedback, Response, Steer};
use crate::surrogate::Steerable;

impl<
    G: Steerable<B, C, F, N>,
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
    /// Judge one machine cycle, and steer: bytes to setpoints, which are in the feedback's state then. The frame is to be learnt after
    /// that. See [`Estimator::judge`] and [`Steer::steer`].
    ///
    /// # Errors
    /// [`IngestError`]; posterior and setpoints are then as they were before.
    #[inline(never)]
    pub fn judge_and_steer<const CX: usize, const CY: usize, const TX: usize, const TY: usize>(
        &mut self,
        model: &Model<'_, G, B, C, F>,
        feedback: &Feedback<B, C>,
        state: &mut Steer<B, C, CX, CY, TX, TY>,
        bytes: &mut [u8],
    ) -> Result<Judged<B, C, F, W>, IngestError> {
        // at its place from the start: a copy is more than a kilobyte of stack
        let mut judged = self.judge(model, bytes);
        if let Ok(judged) = &mut judged {
            judged.nis = self.surprise(judged);
            // a frame that was taken in is within the ramp
            let momentum = model.setup.calibration.ramp.at(judged.frame.cycle_time_us).map_or(1.0, |at| at.momentum);
            let _ = state.steer(feedback, &self.response(model, momentum), judged);
        }
        judged
    }

    /// What can be done for the feedback after a frame, once [`Estimator::prepare`] has nothing more to do. See [`Steer::prepare`].
    pub fn prepare_steer<const CX: usize, const CY: usize, const TX: usize, const TY: usize>(
        &self,
        model: &Model<'_, G, B, C, F>,
        feedback: &Feedback<B, C>,
        state: &mut Steer<B, C, CX, CY, TX, TY>,
    ) -> bool {
        // gains are made in kicks, whatever ampere makes them
        state.prepare(feedback, &self.response(model, 1.0), |i| self.posterior.solution.covariance_row(i))
    }

    fn response<'a>(&'a self, model: &Model<'a, G, B, C, F>, momentum: f32) -> Response<'a, G, B, C, F, N> {
        Response {
            surrogate: model.surrogate,
            at: &self.tangent.linearised,
            kick_per_ampere: &model.setup.calibration.kick_per_ampere,
            momentum,
        }
    }
}
