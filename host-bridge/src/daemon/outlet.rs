//! The sinks of the daemon, and what it says of itself.

use core::time::Duration;
use std::sync::Arc;
use std::sync::mpsc::Sender;
use std::time::Instant;

use estimator::FitQuality;
use inference::stream::Correction;
use results::output::{tell, warn};
use results::{EstimateRecord, Names, Remarked};
use shared_memory::{Asked, FrameWriter, PublishError, Publisher, Reply, SetpointWriter};

use super::work::{Done, Saved, Taken};
use crate::checkpoint::{self, Checkpoint, Head};
use crate::health::{HealthRecord, Reporter};
use crate::history::Recorder;
use crate::source::desk::{Desk, Wish, reply};
use crate::source::queue::{Arrived, Faults, Queue};
use crate::web::Board;

/// Faults are said no more often than this.
const PAUSE: Duration = Duration::from_secs(10);
/// Requests are looked for as often as this: a look costs as much as half a publication.
const LISTEN: Duration = Duration::from_millis(5);

/// An estimate that was published, and what it is of.
pub struct Published {
    record: EstimateRecord,
    frame: Arrived,
    fit: FitQuality,
    fitted: Option<Vec<f32>>,
}

/// Where estimates go.
pub struct Outlet {
    names: Arc<Names>,
    publisher: Publisher,
    reporter: Reporter,
    queue: Queue,
    remarked: Remarked,
    board: Arc<Board>,
    frames: Option<FrameWriter>,
    desk: Option<Desk>,
    /// What was asked, while the core does it.
    asked: Option<Asked>,
    checkpoints: Option<checkpoint::Keeper>,
    history: Option<Recorder>,
    setpoints: Option<SetpointWriter>,
    /// Number of the last frame, and of all frames; how well the model describes them.
    last: Option<([u32; 2], FitQuality)>,
    listened: Instant,
    said: (Faults, Instant),
}

impl Outlet {
    /// To shared memory, beginning with these counts of remarks; health is learnt.
    pub fn new(
        names: &Arc<Names>,
        publisher: Publisher,
        reporter: Reporter,
        remarked: Remarked,
        board: &Arc<Board>,
    ) -> Self {
        let (queue, now) = (board.queue.clone(), Instant::now());
        let said = (queue.faults(), now);
        Self {
            names: names.clone(),
            publisher,
            reporter,
            queue,
            remarked,
            board: board.clone(),
            frames: None,
            desk: None,
            asked: None,
            checkpoints: None,
            history: None,
            setpoints: None,
            last: None,
            listened: now,
            said,
        }
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

    /// From now on with checkpoints.
    #[must_use]
    pub fn with_checkpoints(mut self, keeper: Option<checkpoint::Keeper>) -> Self {
        self.checkpoints = keeper;
        self
    }

    /// From now on with a history.
    #[must_use]
    pub fn with_history(mut self, recorder: Option<Recorder>) -> Self {
        self.history = recorder;
        self
    }

    /// From now on with the set points of an orbit feedback.
    #[must_use]
    pub fn with_feedback(mut self, writer: Option<SetpointWriter>) -> Self {
        self.setpoints = writer;
        self
    }

    /// The estimate of a frame to shared memory; [`Outlet::announce`] and [`Outlet::note`] follow.
    pub(super) fn publish(&mut self, taken: Taken) -> Result<Published, PublishError> {
        let Taken { frame, estimate, correction, spread, fit, tables, fitted } = taken;
        self.publish_setpoints([estimate.sequence, estimate.frames], correction);
        let mismatch = Some(fit.is_mismatch());
        let mut record = EstimateRecord::of(&self.names, estimate, &spread.covariance(), mismatch);
        self.remarked.add(&record.remarks);
        (record.tables, record.remarked) = (Some(tables), self.remarked);
        self.publisher.send(&record)?;
        Ok(Published { record, frame, fit, fitted })
    }

    /// Wake the readers.
    pub(super) fn announce(&self) {
        self.publisher.announce();
    }

    /// All that need not be done before readers have the estimate: the frame itself, health, history, page.
    pub(super) fn note(&mut self, published: &Published) {
        let Published { record, frame, fit, fitted } = published;
        self.board.count(record, frame.at.elapsed());
        self.pass_on(&frame.bytes);
        self.last = Some(([record.sequence, record.frames], *fit));
        let readings = self.reporter.learn(record, &frame.bytes);
        if self.reporter.is_due() {
            self.publish_health();
        }
        self.record(record, frame.at);
        if let (Some(fitted), Some(readings)) = (fitted, readings) {
            let health = self.health(record, *fit);
            self.board.show(record, &health, &readings, fitted);
        }
    }

    fn health(&self, record: &EstimateRecord, fit: FitQuality) -> HealthRecord {
        self.reporter.health.record([record.sequence, record.frames], fit)
    }

    /// Publish what the feedback made of a frame; a failure is said, and ends that.
    fn publish_setpoints(&mut self, of: [u32; 2], correction: Option<Correction>) {
        let Some((writer, correction)) = self.setpoints.as_mut().zip(correction) else { return };
        if let Err(error) = writer.publish(of, &correction) {
            warn(format_args!("{error}; there is no feedback any more"));
            self.setpoints = None;
        }
    }

    /// Publish a frame; a failure is said, and ends that.
    fn pass_on(&mut self, frame: &[u8]) {
        if let Some(Err(error)) = self.frames.as_mut().map(|writer| writer.send(frame)) {
            warn(format_args!("{error}; frames are not published any more"));
            self.frames = None;
        }
    }

    fn publish_health(&mut self) {
        if let Some((last, fit)) = self.last {
            if let Some(history) = &mut self.history {
                history.note_states(&self.reporter.health.record(last, fit));
            }
            self.reporter.publish(last, fit);
        }
    }

    fn record(&mut self, record: &EstimateRecord, came: Instant) {
        let Some(history) = &mut self.history else { return };
        if history.note(record, came)
            && let Some((last, fit)) = self.last
        {
            history.record(record, &self.reporter.health.record(last, fit), came, now_ms());
        }
    }

    /// What is done however many estimates come: health every second, requests, faults.
    pub(super) fn look_around(&mut self, wishes: &Sender<Wish>) {
        if self.listened.elapsed() < LISTEN {
            return;
        }
        self.listened = Instant::now();
        if self.reporter.is_due() {
            self.publish_health();
        }
        if self.asked.is_none()
            && let Some((wish, asked)) = self.desk.as_mut().and_then(Desk::receive)
        {
            match wish {
                Wish::Feedback(true) if self.setpoints.is_none() => {
                    reply(asked, &Reply::Refused("its set points cannot be published".into()));
                }
                // a core that has ended takes no wish; whoever asked hears nothing
                wish => self.asked = wishes.send(wish).is_ok().then_some(asked),
            }
        }
        self.say_faults(PAUSE);
    }

    /// Tell whoever asked what became of it.
    pub(super) fn reply(&mut self, done: Result<Done, String>) {
        let answer = match done {
            Ok(Done::Snapshot(saved)) => Reply::Done(self.checkpoint(saved).encode()),
            Ok(Done::Anew(words)) => {
                tell(format_args!("asked for: {words}"));
                self.reporter.restart();
                self.last = None;
                Reply::Done(words.into_bytes())
            }
            Ok(Done::Switched(words)) => {
                tell(format_args!("asked for: {words}"));
                Reply::Done(words.into_bytes())
            }
            Err(why) => Reply::Refused(why),
        };
        if let Some(asked) = self.asked.take() {
            reply(asked, &answer);
        }
    }

    fn checkpoint(&self, saved: Saved) -> Checkpoint {
        let Saved { model, last, state } = saved;
        let health = self.reporter.health.clone();
        Checkpoint { head: Head::new(model, last, self.remarked, self.queue.faults(), health), state }
    }

    /// Save a checkpoint, unless the disk is busy.
    pub(super) fn keep(&mut self, saved: Saved) {
        let checkpoint = self.checkpoint(saved);
        if let Some(keeper) = &self.checkpoints {
            keeper.offer(checkpoint);
        }
    }

    /// Save the last one.
    pub(super) fn keep_last(&mut self, saved: Saved) {
        let checkpoint = self.checkpoint(saved);
        if let Some(mut keeper) = self.checkpoints.take() {
            keeper.finish(checkpoint);
        }
    }

    /// The end: what waits is written, and what went wrong is said.
    pub(super) fn finish(mut self) {
        if let Some(history) = self.history.take() {
            history.finish();
        }
        self.say_faults(Duration::ZERO);
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

/// Time [ms since 1970].
fn now_ms() -> u64 {
    shared_memory::now_ns() / 1_000_000
}
