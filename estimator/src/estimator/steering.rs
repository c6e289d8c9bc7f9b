//! What a feedback takes from the estimate: the response at the estimated vars, and the covariance of the params.

use super::{Estimator, Model};
use crate::estimate::Estimate;
use crate::steer::{Feedback, Response, Steer, Steered};
use crate::surrogate::Steerable;
use crate::wire::Frame;

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
    /// Setpoints after a frame and its estimate. See [`Steer::steer`].
    pub fn steer<const CX: usize, const CY: usize, const TX: usize, const TY: usize>(
        &self,
        model: &Model<'_, G, B, C, F>,
        feedback: &Feedback<B, C>,
        state: &mut Steer<B, C, CX, CY, TX, TY>,
        frame: &Frame<B, C, F, W>,
        estimate: &Estimate<B, N, W>,
    ) -> Steered {
        // a frame that was taken in is within the ramp
        let momentum = model.setup.calibration.ramp.at(frame.cycle_time_us).map_or(1.0, |at| at.momentum);
        state.steer(feedback, &self.response(model, momentum), frame, estimate)
    }

    /// What can be done for the feedback between frames; after [`Estimator::prepare`]. See [`Steer::prepare`].
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
