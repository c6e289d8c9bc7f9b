//! A recording through the core in this process, as wire bytes.

use std::sync::Arc;

use estimator::FitQuality;
use inference::Recording;
use inference::stream::{self, Core};
use results::{EstimateRecord, Names};

use super::{Clock, Next, Source, SourceError, Times};

/// A recording and the core that it is streamed through.
pub struct Replay<'r> {
    recording: &'r Recording,
    names: Arc<Names>,
    core: Core,
    clock: Clock,
    next: usize,
    /// Frames predicted by a model that was linearised outside the range that it was made for.
    extrapolated: usize,
    /// From wire bytes to estimate, and what the core does between frames.
    pub times: Times,
}

impl<'r> Replay<'r> {
    /// At the first frame.
    pub fn new(recording: &'r Recording, names: &Arc<Names>, core: Core, clock: Clock) -> Self {
        Self { recording, names: names.clone(), core, clock, next: 0, extrapolated: 0, times: Times::default() }
    }

    /// Share of the frames so far that were predicted outside the range that the model was made for.
    pub fn extrapolated(&self) -> f64 {
        self.extrapolated as f64 / self.next.max(1) as f64
    }

    /// How well the model describes the frames so far.
    pub fn quality(&mut self) -> FitQuality {
        self.core.fit_quality()
    }
}

impl Source for Replay<'_> {
    fn next(&mut self) -> Result<Next, SourceError> {
        let Some(row) = self.recording.rows.get(self.next) else { return Ok(Next::End) };
        self.next += 1;
        let mut bytes = stream::wire(self.recording, row)?;
        self.times.preparing(|| self.core.slice());
        self.clock.wait();
        self.extrapolated += usize::from(!self.core.is_within());
        let estimate = self.times.of(|| self.core.ingest(&mut bytes));
        let estimate = estimate.map_err(|error| format!("frame {}: {error}", row.sequence))?;
        let mismatch = self.core.fit_quality().is_mismatch();
        let covariance = self.core.spread().covariance();
        Ok(Next::Estimate(Box::new(EstimateRecord::of(&self.names, estimate, &covariance, Some(mismatch)))))
    }
}
