//! The times in the cycle at which frames are read. Fields that the momentum does not scale, remanent ones above all, turn a beam
//! of lower momentum by more, so that along a ramp each time has baselines of its own: as many channels as there are monitors,
//! for each time, then those of the tune meter.

use heapless::Vec;

use super::{Estimator, IngestError, Model};
use crate::beyond::Beyond;
use crate::ramp::{TIMES, is_same_time, milliseconds};
use crate::state::state;
use crate::surrogate::Surrogate;
use crate::wire::Frame;

/// Times in the cycle that have baselines; none without a ramp.
#[derive(Debug, Clone)]
pub(super) struct Times {
    /// In the order in which they came [us].
    known: Vec<u32, TIMES>,
    /// Root of their number, less 1, so that none is all zero.
    root_less_1: f32,
}

state!([] Times { known, root_less_1 });

impl Times {
    /// None so far.
    pub const NONE: Self = Self { known: Vec::new(), root_less_1: 0.0 };

    /// Which one a time in the cycle is [us].
    fn index(&self, time_us: u32) -> Option<usize> {
        self.known.iter().position(|known| is_same_time(*known, time_us))
    }

    /// Root of their number: by this factor the error of an RF offset grows that all times share, and each counts by itself.
    pub fn root(&self) -> f32 {
        1.0 + self.root_less_1
    }

    /// How many sets of baselines are in use.
    pub fn count(&self) -> usize {
        self.known.len().max(1)
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
    /// Times in the cycle for which there are baselines.
    pub(super) const TIMES: usize = match (K - 2).checked_div(B) {
        Some(times) => times,
        None => 1,
    };

    /// Refuse a frame of a time in the cycle for which no baselines are left.
    pub(super) fn check_time(
        &self,
        model: &Model<'_, G, B, C, F>,
        frame: &Frame<B, C, F, W>,
    ) -> Result<(), IngestError> {
        let known = &self.times.known;
        let time_us = frame.cycle_time_us;
        if !model.setup.calibration.ramp.is_given()
            || known.len() < Self::TIMES.min(TIMES)
            || self.times.index(time_us).is_some()
        {
            return Ok(());
        }
        let latest = known.last().copied().unwrap_or(time_us);
        let what = "time in the cycle in ms, for which no baselines are left,";
        Err(IngestError::Beyond(Beyond { what, limit: milliseconds(latest), got: milliseconds(time_us) }))
    }

    /// Take note of a frame's time in the cycle, for which there are baselines.
    pub(super) fn note_time(&mut self, model: &Model<'_, G, B, C, F>, frame: &Frame<B, C, F, W>) {
        if model.setup.calibration.ramp.is_given() && self.times.index(frame.cycle_time_us).is_none() {
            // there is room: it was checked
            let _ = self.times.known.push(frame.cycle_time_us);
            self.times.root_less_1 = libm::sqrtf(self.times.count() as f32) - 1.0;
        }
        self.predicted.first_channel = self.first_channel(frame.cycle_time_us);
    }

    /// First channel of the baselines at a time in the cycle [us].
    pub(super) fn first_channel(&self, time_us: u32) -> usize {
        self.times.index(time_us).map_or(0, |index| index * B)
    }

    /// Time in the cycle by which a frame's setting is known [us]: that of its baselines.
    pub(super) fn setting_time(&self, time_us: u32) -> u32 {
        self.times.index(time_us).and_then(|index| self.times.known.get(index)).copied().unwrap_or(time_us)
    }
}
