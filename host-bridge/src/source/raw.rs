//! The core in this process, fed by raw frames, and its checkpoints.

use core::time::Duration;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use crc::{CRC_32_ISO_HDLC, Crc};
use estimator::surrogate::Unstable;
use estimator::{IngestError, Prepared, StateError, Tables as _};
use inference::stream::{Core, Feedback};
use training::{LINE, Tables};

use super::desk::{Desk, Wish, reply};
use super::queue::{Faults, Queue};
use super::{Next, Source, SourceError};
use crate::checkpoint::{self, Checkpoint, CheckpointError, Head, Keeper, Model};
use crate::health::{Health, Reporter};
use crate::output::warn;
use crate::record::{EstimateRecord, Names, Remarked};
use crate::sink::shared_memory::{FrameWriter, HealthWriter, Reply, SetpointWriter};

/// Longest wait for a frame before somebody's wish to stop is looked at.
const GLANCE: Duration = Duration::from_millis(100);
/// Faults are said no more often than this.
const PAUSE: Duration = Duration::from_secs(10);

/// Of what a core's state is.
///
/// # Errors
/// What JSON has to say of the setup.
pub fn model_of(core: &mut Core) -> Result<Model, serde_json::Error> {
    let setup = Crc::<u32>::new(&CRC_32_ISO_HDLC).checksum(&serde_json::to_vec(&core.setup.on_wire())?);
    Ok(Model { tables: core.tables.digest::<LINE>(), setup, layout: core.state_layout() })
}

/// Go on at the last checkpoint, or at the one before; one that is not loaded is set aside. Returns what it is of.
pub fn resume(core: &mut Core, path: &Path, model: &Model) -> Option<Head> {
    [path.to_owned(), checkpoint::previous(path)].iter().find_map(|path| {
        let loaded = checkpoint::read(path, model).and_then(|found| {
            let Some(Checkpoint { head, state }) = found else { return Ok(None) };
            core.load(&state).map_err(CheckpointError::from)?;
            Ok(Some(head))
        });
        loaded.unwrap_or_else(|error| {
            let aside = match checkpoint::set_aside(path) {
                Ok(name) => format!("set aside as {}", name.display()),
                Err(error) => format!("and it cannot be set aside: {error}"),
            };
            warn(format_args!("{}: not loaded: {error}; {aside}", path.display()));
            None
        })
    })
}

/// The orbit feedback of a running core.
pub struct Steering {
    /// What is wanted.
    pub wanted: Feedback,
    /// Its set points are computed and published.
    pub is_on: bool,
    /// Where they go; none once that has failed.
    pub writer: Option<SetpointWriter>,
}

/// Checkpoints of a running core.
struct Checkpoints {
    keeper: Keeper,
    every: u32,
    /// Frames since the last one.
    since: u32,
}

/// The core, the frames that wait for it, and its checkpoints.
pub struct Raw {
    core: Core,
    names: Arc<Names>,
    queue: Queue,
    model: Model,
    checkpoints: Option<Checkpoints>,
    reporter: Reporter,
    desk: Option<Desk>,
    frames: Option<FrameWriter>,
    steering: Option<Steering>,
    /// Taken, and not published yet.
    taken: Option<Vec<u8>>,
    /// Last frame of the checkpoint, until the first frame says what was lost.
    resumed: Option<u32>,
    /// Nothing is left to do before the next frame.
    is_prepared: bool,
    /// Number of the last frame, and of all frames.
    last: Option<[u32; 2]>,
    remarked: Remarked,
    said: (Faults, Instant),
}

impl Raw {
    /// Frames of a queue through a core, of this model, which is at its prior or was resumed.
    pub fn new(core: Core, names: &Arc<Names>, queue: Queue, model: Model, resumed: Option<&Head>) -> Self {
        let said = (queue.faults(), Instant::now());
        let sizes = core.tables.sizes();
        let correctors = sizes.correctors.iter().sum::<u16>().into();
        let kept = resumed.map(|head| head.health.clone()).filter(|kept| kept.is_of(names.monitors.len(), correctors));
        let health = kept.unwrap_or_else(|| Health::new(&core.setup.noise, correctors));
        Self {
            core,
            names: names.clone(),
            queue,
            model,
            checkpoints: None,
            reporter: Reporter::new(health, sizes),
            desk: None,
            frames: None,
            steering: None,
            taken: None,
            resumed: resumed.map(|head| head.sequence),
            is_prepared: false,
            last: None,
            remarked: resumed.map_or(Remarked::default(), |head| head.remarked),
            said,
        }
    }

    /// From now on with a checkpoint every so many frames.
    #[must_use]
    pub fn with_checkpoints(mut self, keeper: Option<Keeper>, every: u32) -> Self {
        self.checkpoints = keeper.map(|keeper| Checkpoints { keeper, every, since: 0 });
        self
    }

    /// From now on with its health published.
    #[must_use]
    pub fn with_health(mut self, writer: HealthWriter) -> Self {
        self.reporter.writer = Some(writer);
        self
    }

    /// From now on open to requests.
    #[must_use]
    pub fn with_requests(mut self, desk: Desk) -> Self {
        self.desk = Some(desk);
        self
    }

    /// From now on with its frames published.
    #[must_use]
    pub fn with_frames(mut self, writer: Option<FrameWriter>) -> Self {
        self.frames = writer;
        self
    }

    /// From now on with an orbit feedback, whose set points are published.
    #[must_use]
    pub fn with_feedback(mut self, steering: Option<Steering>) -> Self {
        self.steering = steering;
        self.steer();
        self
    }

    /// The end: a last checkpoint, and what went wrong.
    ///
    /// # Errors
    /// [`StateError`].
    pub fn finish(mut self) -> Result<(), StateError> {
        self.pass_on();
        if let (Some(last), Some(mut checkpoints)) = (self.last, self.checkpoints.take()) {
            let file = self.file(last)?;
            checkpoints.keeper.finish(file);
        }
        self.say_faults(Duration::ZERO);
        Ok(())
    }

    /// Work between two frames: the frame, health and a checkpoint if they are due, then slices of what prepares for the next frame, one at least, and
    /// more until that frame waits.
    fn between(&mut self) -> Result<(), StateError> {
        self.pass_on();
        if let Some(last) = self.last.filter(|_| self.reporter.is_due()) {
            let fit = self.core.fit_quality();
            self.reporter.publish(last, fit);
        }
        if let Some(last) = self.last.filter(|_| self.is_due()) {
            let file = self.file(last)?;
            if let Some(checkpoints) = &mut self.checkpoints {
                checkpoints.keeper.offer(file);
                checkpoints.since = 0;
            }
        }
        while !self.is_prepared {
            self.is_prepared = self.core.slice() == Prepared::Nothing;
            if !self.queue.is_empty() {
                break;
            }
        }
        Ok(())
    }

    /// Publish the last frame; a failure is said, and ends that.
    fn pass_on(&mut self) {
        let Some(frame) = self.taken.take() else { return };
        if let Some(Err(error)) = self.frames.as_mut().map(|writer| writer.send(&frame)) {
            warn(format_args!("{error}; frames are not published any more"));
            self.frames = None;
        }
    }

    /// Publish what the feedback made of a frame; a failure is said, and ends that.
    fn publish_setpoints(&mut self, of: [u32; 2]) {
        let Some((steering, correction)) = self.steering.as_mut().zip(self.core.correction()) else { return };
        if let Some(Err(error)) = steering.writer.as_mut().map(|writer| writer.publish(of, &correction)) {
            warn(format_args!("{error}; there is no feedback any more"));
            (steering.is_on, steering.writer) = (false, None);
            self.steer();
        }
    }

    /// The feedback as it is switched: from the next frame on, as if that were the first.
    fn steer(&mut self) {
        let steering = self.steering.as_ref().filter(|steering| steering.is_on);
        self.core.steer(steering.map(|steering| &steering.wanted));
    }

    fn switch(&mut self, on: bool) -> Result<Vec<u8>, String> {
        let steering = self.steering.as_mut().filter(|steering| steering.writer.is_some());
        steering.ok_or("its set points cannot be published")?.is_on = on;
        self.steer();
        let said = format!("the orbit feedback is {}", if on { "on" } else { "off" });
        warn(format_args!("asked for: {said}"));
        Ok(said.into_bytes())
    }

    /// Do what operators ask for, one request at a time.
    fn obey(&mut self) {
        let Some((wish, asked)) = self.desk.as_mut().and_then(Desk::receive) else { return };
        let done = match wish {
            Wish::Snapshot => self.snapshot(),
            Wish::Reset => self.reset(),
            Wish::Model(tables) => self.adopt(*tables),
            Wish::Feedback(on) => self.switch(on),
        };
        reply(asked, &done.map_or_else(Reply::Refused, Reply::Done));
    }

    fn snapshot(&mut self) -> Result<Vec<u8>, String> {
        let last = self.last.ok_or("no frame has come yet")?;
        self.file(last).map_err(|error| error.to_string())
    }

    fn reset(&mut self) -> Result<Vec<u8>, String> {
        let (tables, setup) = (self.core.tables.clone(), self.core.setup.clone());
        self.core = Core::with_tables(tables, setup).map_err(|error| error.to_string())?;
        self.steer();
        self.begin_anew("the core is at its prior");
        self.last = None;
        Ok(b"the core is at its prior".to_vec())
    }

    fn adopt(&mut self, tables: Tables) -> Result<Vec<u8>, String> {
        self.core.prepare();
        let adopted = self.core.adopt(tables);
        adopted.map_err(|Unstable| "with these tables the ring is not stable at the vars at hand".to_owned())?;
        self.model = model_of(&mut self.core).map_err(|error| error.to_string())?;
        let said = format!("the tables are now {:08x}", self.model.tables);
        self.begin_anew(&said);
        Ok(said.into_bytes())
    }

    /// What was filtered is of another posterior.
    fn begin_anew(&mut self, why: &str) {
        warn(format_args!("asked for: {why}"));
        self.reporter.restart();
        self.is_prepared = false;
    }

    fn is_due(&self) -> bool {
        self.checkpoints.as_ref().is_some_and(|checkpoints| checkpoints.since >= checkpoints.every)
    }

    /// The core as a checkpoint; what it has begun between frames is finished first.
    fn file(&mut self, last: [u32; 2]) -> Result<Vec<u8>, StateError> {
        self.core.prepare();
        self.is_prepared = true;
        let mut state = Vec::new();
        self.core.save(&mut state)?;
        let health = self.reporter.health.clone();
        let head = Head::new(self.model, last, self.remarked, self.queue.faults(), health);
        Ok(Checkpoint { head, state }.encode())
    }

    fn take(&mut self, frame: Vec<u8>) -> Next {
        let estimate = match self.core.ingest(&mut frame.clone()) {
            Ok(estimate) => estimate,
            Err(error) => {
                self.queue.count(|faults| match error {
                    IngestError::Frame(_) => faults.damaged += 1,
                    _ => faults.refused += 1,
                });
                return Next::Nothing;
            }
        };
        let mismatch = self.core.fit_quality().is_mismatch();
        let mut record = EstimateRecord::of(&self.names, &estimate, |i| self.core.covariance_row(i), Some(mismatch));
        record.tables = Some(self.model.tables);
        self.reporter.learn(&record, &frame);
        self.taken = self.frames.is_some().then_some(frame);
        self.is_prepared = false;
        self.last = Some([record.sequence, record.frames]);
        self.publish_setpoints([record.sequence, record.frames]);
        self.remarked.add(&record.remarks);
        self.checkpoints.iter_mut().for_each(|checkpoints| checkpoints.since += 1);
        if let Some(before) = self.resumed.take() {
            warn(lost(before, record.sequence));
        }
        Next::Estimate(Box::new(record))
    }

    /// Say what went wrong since it was said last, if that is long enough ago.
    fn say_faults(&mut self, pause: Duration) {
        let faults = self.queue.faults();
        if faults != self.said.0 && self.said.1.elapsed() >= pause {
            warn(format_args!("so far {faults}"));
            self.said = (faults, Instant::now());
        }
    }
}

/// What was lost between the last frame of a checkpoint and the first frame after it.
fn lost(before: u32, first: u32) -> String {
    match first.wrapping_sub(before) {
        1 => format!("frame {first} follows the checkpoint: nothing was lost"),
        gap @ 2..=0x7fff_ffff => format!(
            "frames {} to {} were lost since the checkpoint: {}",
            before.wrapping_add(1),
            first.wrapping_sub(1),
            gap - 1
        ),
        _ => format!(
            "frame {first} is of another epoch than the checkpoint's frame {before}: how many were lost is not known"
        ),
    }
}

impl Source for Raw {
    fn next(&mut self) -> Result<Next, SourceError> {
        self.obey();
        self.between()?;
        self.say_faults(PAUSE);
        Ok(match self.queue.pop(GLANCE) {
            Some(frame) => self.take(frame),
            None if self.queue.is_over() => Next::End,
            None => Next::Nothing,
        })
    }

    fn remarked(&self) -> Remarked {
        self.remarked
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_lost_is_said_in_numbers() {
        assert_eq!(lost(7, 8), "frame 8 follows the checkpoint: nothing was lost");
        assert_eq!(lost(7, 11), "frames 8 to 10 were lost since the checkpoint: 3");
        assert_eq!(lost(u32::MAX, 1), "frames 0 to 0 were lost since the checkpoint: 1");
        assert!(lost(7, 3).contains("another epoch"));
    }
}
