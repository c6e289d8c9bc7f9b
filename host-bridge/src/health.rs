//! Health of every monitor and corrector, from what becomes of each frame: filtered ratios with hysteresis, on top of what the core
//! decides about the weight of readings.
//!
//! A monitor is judged by its own readings: whether it reports, whether its reading was within the gate, and how large its learnt noise is.
//! A corrector is judged by the frames in which its current is on: their normalised innovation squared per reading (NIS), which is 1 on average if
//! the orbit moved as the model says. All correctors that are on in a frame are judged alike, so that a feedback that moves all of
//! them at once tells of none in particular. While frames without any corrector surprise as well, correctors are not judged: the beam is.

mod filter;
mod instrument;
mod reporter;
#[cfg(test)]
mod tests;

use estimator::{FitQuality, FrameError, Layout, MonitorState, Sizes};
use serde::{Deserialize, Serialize};
use training::rooms::largest;

use filter::Filter;
use instrument::{Bounds, Instrument, Limits, Sample};
pub use reporter::Reporter;
use results::{EstimateRecord, ReadingUse};
pub use shared_memory::{Condition, HealthRecord, State};

/// Frames over which a monitor is judged.
const MONITOR: u32 = 64;
/// Frames with its current on over which a corrector is judged: a campaign has a few.
const CORRECTOR: u32 = 16;

/// A monitor is noisy at the core's own bound. The noise is learnt, so that it is as slow as the core; no good monitor passes. Five
/// jumps in 64 frames are far from the core's gate, which good readings pass once in two million. Half of the reports missing is dead.
const MONITORS: Limits = Limits {
    scatter: Bounds { begins: 1.5, ends: 1.25 },
    jumps: Bounds { begins: 0.05, ends: 0.01 },
    missing: Bounds { begins: 0.5, ends: 0.1 },
    probation: 128,
};
/// A corrector that surprises in 15 to 60 % of its frames jumps; in more, it does not do what its read-back says: it is dead.
/// NIS of 33 readings has a standard deviation of 0.25, a mean over 16 of them 0.04: 1.5 is not passed by chance.
const CORRECTORS: Limits = Limits {
    scatter: Bounds { begins: 1.5, ends: 1.2 },
    jumps: Bounds { begins: 0.15, ends: 0.05 },
    missing: Bounds { begins: 0.6, ends: 0.3 },
    probation: 16,
};
/// NIS per reading above which a frame surprises: eight standard deviations of 33 readings.
const SURPRISE: f32 = 3.0;
/// A corrector whose current is at least this share of the largest that it has had is on.
const ON: f32 = 0.2;
/// Share of frames without correctors that surprise, above which correctors are not judged.
const UNCLEAR: f32 = 0.3;

/// Health of a machine; serialised with each checkpoint.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Health {
    /// Expected noise of each monitor [B] [m].
    noise: Vec<f32>,
    monitors: Vec<Instrument<MONITOR>>,
    correctors: Vec<Corrector>,
    /// Whether frames without any corrector surprise.
    beam: Filter<CORRECTOR>,
}

#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
struct Corrector {
    instrument: Instrument<CORRECTOR>,
    /// Largest current so far [A].
    largest: f32,
}

impl Corrector {
    /// Whether a current is on; the largest is remembered.
    fn is_on(&mut self, current: f32) -> bool {
        self.largest = self.largest.max(current.abs());
        current.abs() > ON * self.largest
    }
}

impl Health {
    /// Of a machine with this expected noise of its monitors [B] [m], and this many correctors.
    pub fn new(noise: &[f32], correctors: usize) -> Self {
        Self {
            noise: noise.to_vec(),
            monitors: vec![Instrument::default(); noise.len()],
            correctors: vec![Corrector::default(); correctors],
            beam: Filter::default(),
        }
    }

    /// The core was reset: what was filtered is of another posterior.
    pub fn restart(&mut self) {
        *self = Self::new(&self.noise, self.correctors.len());
    }

    /// True if it is of a machine of these sizes, as one from a checkpoint has to be.
    pub fn is_of(&self, monitors: usize, correctors: usize) -> bool {
        self.monitors.len() == monitors && self.correctors.len() == correctors && self.noise.len() == monitors
    }

    /// Learn from a frame with these currents [C] [A]; true if the state of anything has changed.
    pub fn learn(&mut self, record: &EstimateRecord, currents: &[f32]) -> bool {
        // without beam no reading tells of a monitor
        let monitors = !record.remarks.put_aside && self.learn_of_monitors(record);
        self.learn_of_correctors(record, currents) || monitors
    }

    fn learn_of_monitors(&mut self, record: &EstimateRecord) -> bool {
        let mut has_changed = false;
        for (b, (instrument, expected)) in self.monitors.iter_mut().zip(&self.noise).enumerate() {
            let sample = match (record.monitor_state[b], record.reading[b]) {
                (MonitorState::Dead, _) | (_, ReadingUse::Absent) => Sample::Missing,
                (_, ReadingUse::Rejected) => Sample::Jump,
                (_, ReadingUse::Used) => Sample::Scatter(record.monitor_sigma[b] / expected),
            };
            has_changed |= instrument.add(sample, &MONITORS);
        }
        has_changed
    }

    fn learn_of_correctors(&mut self, record: &EstimateRecord, currents: &[f32]) -> bool {
        let nis = record.nis_per_reading().filter(|_| !record.remarks.put_aside);
        let surprises = nis.is_none_or(|nis| nis > SURPRISE);
        let on: Vec<bool> =
            self.correctors.iter_mut().zip(currents).map(|(corrector, current)| corrector.is_on(*current)).collect();
        if !on.contains(&true) {
            self.beam.add(f32::from(u8::from(surprises)));
            return false;
        }
        if self.beam.mean() > UNCLEAR {
            return false;
        }
        let sample = nis.filter(|_| !surprises).map_or(Sample::Surprise, Sample::Scatter);
        let of_those_on = self.correctors.iter_mut().zip(on).filter(|(_, is_on)| *is_on);
        of_those_on
            .fold(false, |has_changed, (corrector, _)| corrector.instrument.add(sample, &CORRECTORS) | has_changed)
    }

    /// As it is published after a frame of this number, and this many frames.
    pub fn record(&self, [sequence, frames]: [u32; 2], fit: FitQuality) -> HealthRecord {
        HealthRecord {
            sequence,
            frames,
            fit,
            monitors: self.monitors.iter().map(condition).collect(),
            correctors: self.correctors.iter().map(|corrector| condition(&corrector.instrument)).collect(),
        }
    }
}

fn condition<const SAMPLES: u32>(instrument: &Instrument<SAMPLES>) -> Condition {
    Condition { state: instrument.state(), ratios: instrument.ratios() }
}

/// What health, and who looks at it, needs of a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Measured {
    /// Currents of the correctors [C] [A].
    pub currents: Vec<f32>,
    /// Reading of each monitor that reports [B] [m].
    pub readings: Vec<Option<f32>>,
}

/// That of the bytes of a frame of a ring of these sizes.
///
/// # Errors
/// [`FrameError`].
pub fn measured(sizes: &Sizes, frame: &[u8]) -> Result<Measured, FrameError> {
    let [monitors, correctors] = [sizes.monitors, sizes.correctors].map(|each| each.iter().sum::<u16>());
    let ring = Sizes::new([monitors.into(), 0], [correctors.into(), 0], [0, 0, sizes.supplies.into()]);
    let frame = largest::Frame::decode(&Layout { ring, room: largest::SIZES }, &mut frame.to_vec())?;
    let currents = frame.corrector.iter().take(correctors.into()).map(|code| code.value());
    let readings = frame.reading.iter().take(monitors.into()).enumerate();
    let readings = readings.map(|(b, code)| frame.valid.has(b).then(|| code.value()));
    Ok(Measured { currents: currents.collect(), readings: readings.collect() })
}
