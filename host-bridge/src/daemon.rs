//! The daemon's loop: a frame from the queue goes through the core, and what the core makes of it to every sink.
//!
//! ```text
//! source -> Queue -> take_frames: Engine (the core) -> Work -> hand_on: Outlet (shared memory, health, history, page, ..)
//! ```
//!
//! Two threads share this, so that the core takes the next frame while the estimate before it is published. Work goes from one to the
//! other in order. Both ends of the shared memory stay on the thread that made them, which is the one that hands on.

mod engine;
mod outlet;
mod work;

use core::time::Duration;
use std::io;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, SyncSender, channel, sync_channel};
use std::thread;

use estimator::StateError;

use crate::source::desk::Wish;
use crate::stop::Stop;
pub use engine::{Engine, model_of, resume};
pub use outlet::Outlet;
use shared_memory::PublishError;

use work::Work;

/// Estimates that wait to be published; then the core waits, and frames wait in the queue.
const AHEAD: usize = 64;
/// While more estimates wait to be published, readers are woken once for this many.
const TOGETHER: u32 = 8;
/// Longest wait for a frame, or for work, before anything else is looked at.
const GLANCE: Duration = Duration::from_millis(20);

/// Why the loop has ended before its source did.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DaemonError {
    /// The system gives no thread.
    #[error("no thread for the core: {0}")]
    Thread(#[from] io::Error),
    /// The core cannot be saved.
    #[error(transparent)]
    State(#[from] StateError),
    /// Estimates are not published any more.
    #[error(transparent)]
    Publish(#[from] PublishError),
}

/// Run until the source ends or somebody asks to stop.
///
/// # Errors
/// [`DaemonError`].
///
/// # Panics
/// If the core has panicked.
pub fn run(engine: Engine, mut outlet: Outlet, stop: &Stop) -> Result<(), DaemonError> {
    let (works, to_hand_on) = sync_channel(AHEAD);
    let (wishes, to_do) = channel();
    thread::scope(|scope| {
        let core = thread::Builder::new().name("core".into());
        let core = core.spawn_scoped(scope, move || take_frames(engine, &to_do, &works, stop))?;
        let handed_on = hand_on(&mut outlet, to_hand_on, &wishes);
        let taken = core.join().expect("the core does not panic");
        outlet.finish();
        handed_on?;
        Ok(taken?)
    })
}

/// Frames in, estimates out; between two frames what operators wish, a checkpoint if one is due, and what prepares for the next frame.
fn take_frames(
    mut engine: Engine,
    wishes: &Receiver<Wish>,
    works: &SyncSender<Work>,
    stop: &Stop,
) -> Result<(), StateError> {
    // false once nobody hands on
    let mut is_heard = true;
    while is_heard && !stop.is_requested() {
        if let Ok(wish) = wishes.try_recv() {
            is_heard &= works.send(Work::Done(engine.do_as_wished(wish))).is_ok();
        }
        if let Some(saved) = engine.save_if_due()? {
            is_heard &= works.send(Work::Checkpoint(saved)).is_ok();
        }
        engine.prepare();
        match engine.queue.pop(GLANCE) {
            Some(frame) => {
                if let Some(taken) = engine.take(frame) {
                    is_heard &= works.send(Work::Taken(Box::new(taken))).is_ok();
                }
            }
            None if engine.queue.is_over() => break,
            None => {}
        }
    }
    if let Some(saved) = engine.save_last()? {
        let _ = works.send(Work::LastCheckpoint(saved));
    }
    Ok(())
}

/// Each estimate to every sink, the shared memory first; between two, health once a second and what operators ask.
fn hand_on(outlet: &mut Outlet, works: Receiver<Work>, wishes: &Sender<Wish>) -> Result<(), PublishError> {
    let (mut next, mut unannounced) = (None, 0);
    loop {
        match next.take().map_or_else(|| works.recv_timeout(GLANCE), Ok) {
            Ok(Work::Taken(taken)) => {
                let taken = outlet.publish(*taken)?;
                unannounced += 1;
                next = works.try_recv().ok();
                // the last estimate of several that wait wakes the readers at once, a single one therefore too, and one before a checkpoint
                if !matches!(next, Some(Work::Taken(_))) || unannounced == TOGETHER {
                    outlet.announce();
                    unannounced = 0;
                }
                outlet.note(&taken);
            }
            Ok(Work::Checkpoint(saved)) => outlet.keep(saved),
            Ok(Work::LastCheckpoint(saved)) => outlet.keep_last(saved),
            Ok(Work::Done(done)) => outlet.reply(done),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return Ok(()),
        }
        outlet.look_around(wishes);
    }
}
