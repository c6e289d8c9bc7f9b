//! The core of the daemon with the frames that wait for it, and what is done to it between frames.

use core::time::Duration;
use std::path::Path;
use std::time::Instant;

use crc::{CRC_32_ISO_HDLC, Crc};
use estimator::surrogate::Unstable;
use estimator::{FitQuality, Hold, IngestError, Prepared, StateError, Tables as _};
use inference::stream::{Core, Feedback};
use results::output::{tell, warn};
use training::{LINE, Tables};

use super::work::{Done, Saved, Taken};
use crate::checkpoint::{self, Checkpoint, CheckpointError, Head, Model};
use crate::source::desk::Wish;
use crate::source::queue::{Arrived, Queue};

/// What the posterior expects of readings is worked out, for the page, no more often than this: of ten frames a second, each.
const FITTED: Duration = Duration::from_millis(50);

/// Readings are compared with the model as often as this, by the time of frames [us]: that takes as long as several frames while vars do
/// not walk.
const COMPARED_US: u64 = 100_000;

/// While as many frames wait, only one in so many is followed by a slice of preparation, which takes as long as a frame.
const BEHIND: u32 = 16;

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

/// When a checkpoint is due.
#[derive(Debug)]
struct Saving {
    every: u32,
    /// Frames since the last one.
    since: u32,
}

/// The orbit feedback.
struct Steering {
    /// What is wanted.
    wanted: Feedback,
    /// Set points are computed.
    is_on: bool,
}

/// The core, and the frames that wait for it.
pub struct Engine {
    core: Core,
    pub(super) queue: Queue,
    model: Model,
    saving: Option<Saving>,
    steering: Option<Steering>,
    /// Last frame of the checkpoint, until the first frame says what was lost.
    resumed: Option<u32>,
    /// Nothing is left to do before the next frame.
    is_prepared: bool,
    /// The feedback waits for its gains, which are made last of what is done between frames.
    owes_gains: bool,
    /// Number of the last frame, and of all frames.
    last: Option<[u32; 2]>,
    fitted: Option<Instant>,
    /// How the readings fit the model, and the time of the frame since which it is so [us].
    compared: Option<(u64, FitQuality)>,
}

impl Engine {
    /// Frames of a queue through a core, of this model, which is at its prior or was resumed after a frame; with a checkpoint every so many frames.
    pub fn new(core: Core, queue: Queue, model: Model, resumed: Option<u32>, every: Option<u32>) -> Self {
        let saving = every.map(|every| Saving { every, since: 0 });
        Self {
            core,
            queue,
            model,
            saving,
            steering: None,
            resumed,
            is_prepared: false,
            owes_gains: false,
            last: None,
            fitted: None,
            compared: None,
        }
    }

    /// From now on with an orbit feedback, if one is wanted, on or to be switched on.
    #[must_use]
    pub fn with_feedback(mut self, wanted: Option<Feedback>, is_on: bool) -> Self {
        self.steering = wanted.map(|wanted| Steering { wanted, is_on });
        self.steer();
        self
    }

    /// The feedback as it is switched: from the next frame on, as if that were the first.
    fn steer(&mut self) {
        let steering = self.steering.as_ref().filter(|steering| steering.is_on);
        self.core.steer(steering.map(|steering| &steering.wanted));
    }

    /// Take a frame; one that the core refuses is counted.
    pub(super) fn take(&mut self, frame: Arrived) -> Option<Taken> {
        let estimate = match self.core.ingest(&mut frame.bytes.clone()) {
            Ok(estimate) => estimate,
            Err(error) => {
                self.queue.count(|faults| match error {
                    IngestError::Frame(_) => faults.damaged += 1,
                    _ => faults.refused += 1,
                });
                return None;
            }
        };
        self.is_prepared = false;
        self.last = Some([estimate.sequence, estimate.frames]);
        self.saving.iter_mut().for_each(|saving| saving.since += 1);
        if let Some(before) = self.resumed.take() {
            tell(lost(before, estimate.sequence));
        }
        let fitted = self.fitted_if_due();
        let (spread, fit) = (self.core.spread(), self.compare_if_due(estimate.time_us));
        let correction = self.core.correction();
        self.owes_gains = correction.as_ref().is_some_and(|made| made.steered.hold == Some(Hold::Unprepared));
        Some(Taken { frame, estimate, correction, spread, fit, tables: self.model.tables, fitted })
    }

    fn compare_if_due(&mut self, time_us: u64) -> FitQuality {
        match self.compared {
            Some((at, fit)) if time_us.abs_diff(at) < COMPARED_US => fit,
            _ => {
                let fit = self.core.fit_quality();
                self.compared = Some((time_us, fit));
                fit
            }
        }
    }

    fn fitted_if_due(&mut self) -> Option<Vec<f32>> {
        let is_due = self.fitted.is_none_or(|last| last.elapsed() >= FITTED);
        is_due.then(|| {
            self.fitted = Some(Instant::now());
            self.core.fitted()
        })
    }

    /// Slices of what prepares for the next frame: one at least, and more until that frame waits; fewer when many do. A feedback without gains comes
    /// before it: where frames come as fast as they are taken, it would never have them.
    pub(super) fn prepare(&mut self) {
        if !self.owes_gains && self.queue.len() >= BEHIND as usize && !self.frames().is_multiple_of(BEHIND) {
            return;
        }
        while !self.is_prepared {
            self.is_prepared = self.core.slice() == Prepared::Nothing;
            if !self.queue.is_empty() && !self.owes_gains {
                break;
            }
        }
    }

    /// Frames taken so far.
    fn frames(&self) -> u32 {
        self.last.map_or(0, |[_, frames]| frames)
    }

    /// The core's part of a checkpoint, if one is due: it waits until nothing is under way, which it would have to finish while frames wait, but no longer than
    /// until the next one is due.
    pub(super) fn save_if_due(&mut self) -> Result<Option<Saved>, StateError> {
        let most = if self.is_prepared { 1 } else { 2 };
        let is_due = self.saving.as_ref().is_some_and(|saving| saving.since >= most * saving.every);
        let Some(last) = self.last.filter(|_| is_due) else { return Ok(None) };
        self.saving.iter_mut().for_each(|saving| saving.since = 0);
        self.save(last).map(Some)
    }

    /// The same at the end, if any frame has come and checkpoints are kept.
    pub(super) fn save_last(&mut self) -> Result<Option<Saved>, StateError> {
        let last = self.last.filter(|_| self.saving.is_some());
        last.map(|last| self.save(last)).transpose()
    }

    /// What the core has begun between frames is finished first.
    fn save(&mut self, last: [u32; 2]) -> Result<Saved, StateError> {
        self.core.prepare();
        self.is_prepared = true;
        let mut state = Vec::new();
        self.core.save(&mut state)?;
        Ok(Saved { model: self.model, last, state })
    }

    /// Do what an operator wishes.
    pub(super) fn do_as_wished(&mut self, wish: Wish) -> Result<Done, String> {
        match wish {
            Wish::Snapshot => self.snapshot(),
            Wish::Reset => self.reset(),
            Wish::Model(tables) => self.adopt(*tables),
            Wish::Feedback(on) => self.switch(on),
        }
    }

    fn snapshot(&mut self) -> Result<Done, String> {
        let last = self.last.ok_or("no frame has come yet")?;
        self.save(last).map(Done::Snapshot).map_err(|error| error.to_string())
    }

    fn reset(&mut self) -> Result<Done, String> {
        let (tables, setup) = (self.core.tables.clone(), self.core.setup.clone());
        self.core = Core::with_tables(tables, setup).map_err(|error| error.to_string())?;
        self.steer();
        (self.last, self.is_prepared, self.compared) = (None, false, None);
        Ok(Done::Anew("the core is at its prior".into()))
    }

    fn switch(&mut self, on: bool) -> Result<Done, String> {
        self.steering.as_mut().ok_or("no orbit feedback is configured")?.is_on = on;
        self.steer();
        Ok(Done::Switched(format!("the orbit feedback is {}", if on { "on" } else { "off" })))
    }

    fn adopt(&mut self, tables: Tables) -> Result<Done, String> {
        self.core.prepare();
        let adopted = self.core.adopt(tables);
        adopted.map_err(|Unstable| "with these tables the ring is not stable at the vars at hand".to_owned())?;
        self.model = model_of(&mut self.core).map_err(|error| error.to_string())?;
        (self.is_prepared, self.compared) = (false, None);
        Ok(Done::Anew(format!("the tables are now {:08x}", self.model.tables)))
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
