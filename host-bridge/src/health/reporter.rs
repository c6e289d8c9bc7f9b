//! Health beside the loop: learnt from every frame, published between frames.

use core::time::Duration;
use std::time::Instant;

use estimator::{FitQuality, Sizes};
use results::EstimateRecord;
use results::output::warn;
use shared_memory::HealthWriter;

use super::{Health, measured};

/// It is published as often as this at least.
const BEAT: Duration = Duration::from_secs(1);

/// Health, and where it goes.
pub struct Reporter {
    /// Of the machine.
    pub health: Health,
    sizes: Sizes,
    /// Without one, it is learnt only.
    pub writer: Option<HealthWriter>,
    last: Option<Instant>,
    has_news: bool,
}

impl Reporter {
    /// Of a machine of these sizes.
    pub fn new(health: Health, sizes: Sizes) -> Self {
        Self { health, sizes, writer: None, last: None, has_news: false }
    }

    /// From now on published.
    #[must_use]
    pub fn with(mut self, writer: HealthWriter) -> Self {
        self.writer = Some(writer);
        self
    }

    /// Learn from a frame and what became of it; returns its readings [B] [m].
    pub fn learn(&mut self, record: &EstimateRecord, frame: &[u8]) -> Option<Vec<Option<f32>>> {
        // the core has taken it: it can be read
        let measured = measured(&self.sizes, frame).ok()?;
        self.has_news |= self.health.learn(record, &measured.currents);
        Some(measured.readings)
    }

    /// The core was reset.
    pub fn restart(&mut self) {
        self.health.restart();
        self.has_news = true;
    }

    /// True if something has changed since it was published, or that was a second ago.
    pub fn is_due(&self) -> bool {
        self.writer.is_some() && (self.has_news || self.last.is_none_or(|last| last.elapsed() >= BEAT))
    }

    /// Publish it as after this frame; a failure is said, and ends it.
    pub fn publish(&mut self, frame: [u32; 2], fit: FitQuality) {
        let record = self.health.record(frame, fit);
        let published = self.writer.as_mut().map_or(Ok(()), |writer| writer.publish(&record));
        if let Err(error) = published {
            warn(format_args!("{error}; health is not published any more"));
            self.writer = None;
        }
        (self.last, self.has_news) = (Some(Instant::now()), false);
    }
}
