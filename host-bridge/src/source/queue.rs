//! Frames on their way to the core: so many wait. Beyond them either the oldest is dropped and counted, or whoever brings the next
//! one waits.

use core::fmt;
use core::time::Duration;
use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use serde::{Deserialize, Serialize};

use crate::stop::Stop;

/// Longest wait before somebody's wish to stop is looked at.
const GLANCE: Duration = Duration::from_millis(100);

/// What went wrong on the way to the core, since the first start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Faults {
    /// Frames dropped, as the buffer was full.
    pub dropped: u64,
    /// Packets that were damaged, cut off or too long.
    pub damaged: u64,
    /// Frames that the core refused: repeated, out of order, beyond the model.
    pub refused: u64,
    /// Connections that were lost.
    pub disconnected: u64,
    /// Checkpoints that were not saved.
    pub unsaved: u64,
}

/// What there is of it, with commas in between.
impl fmt::Display for Faults {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { dropped, damaged, refused, disconnected, unsaved } = *self;
        let all = [
            (dropped, "frames dropped from a full buffer"),
            (damaged, "packets damaged"),
            (refused, "frames refused"),
            (disconnected, "connections lost"),
            (unsaved, "checkpoints not saved"),
        ];
        let said: Vec<String> =
            all.iter().filter(|(count, _)| *count > 0).map(|(count, what)| format!("{count} {what}")).collect();
        f.write_str(&said.join(", "))
    }
}

/// A frame as it came.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Arrived {
    /// On the wire, with the zero byte at its end.
    pub bytes: Vec<u8>,
    /// When it was put into the queue.
    pub at: Instant,
}

/// Both ends of it.
#[derive(Debug, Clone)]
pub struct Queue(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    state: Mutex<State>,
    news: Condvar,
    /// A frame was taken.
    space: Condvar,
    room: usize,
}

#[derive(Debug, Default)]
struct State {
    frames: VecDeque<Arrived>,
    faults: Faults,
    is_closed: bool,
    /// The core waits for a frame; whoever brings one waits for room. Nobody else is woken, which is a call of the system.
    is_awaited: bool,
    waits_for_room: bool,
}

impl Queue {
    /// Empty, for so many frames, with these faults so far.
    pub fn new(room: usize, faults: Faults) -> Self {
        let state = Mutex::new(State { faults, ..State::default() });
        Self(Arc::new(Shared { state, news: Condvar::new(), space: Condvar::new(), room }))
    }

    /// Put a frame in; if there is no room, the oldest is dropped.
    pub fn push(&self, frame: Vec<u8>) {
        let mut state = self.state();
        if state.frames.len() >= self.0.room {
            state.frames.pop_front();
            state.faults.dropped += 1;
        }
        self.put(state, frame);
    }

    fn put(&self, mut state: MutexGuard<'_, State>, bytes: Vec<u8>) {
        state.frames.push_back(Arrived { bytes, at: Instant::now() });
        let is_awaited = state.is_awaited;
        drop(state);
        if is_awaited {
            self.0.news.notify_one();
        }
    }

    /// Put a frame in as soon as there is room, or somebody asks to stop: then it is left out.
    pub fn push_patiently(&self, frame: Vec<u8>, stop: &Stop) {
        let mut state = self.state();
        while state.frames.len() >= self.0.room && !stop.is_requested() {
            state.waits_for_room = true;
            state = self.0.space.wait_timeout(state, GLANCE).unwrap_or_else(PoisonError::into_inner).0;
        }
        if !stop.is_requested() {
            self.put(state, frame);
        }
    }

    /// No more will come.
    pub fn close(&self) {
        self.state().is_closed = true;
        self.0.news.notify_one();
    }

    /// True if no frame waits and none will come.
    pub fn is_over(&self) -> bool {
        let state = self.state();
        state.is_closed && state.frames.is_empty()
    }

    /// Take the oldest frame; none if none comes for so long.
    pub fn pop(&self, patience: Duration) -> Option<Arrived> {
        let is_idle = |state: &mut State| {
            state.is_awaited = state.frames.is_empty() && !state.is_closed;
            state.is_awaited
        };
        let wait = self.0.news.wait_timeout_while(self.state(), patience, is_idle);
        let mut state = wait.unwrap_or_else(PoisonError::into_inner).0;
        state.is_awaited = false;
        let frame = state.frames.pop_front();
        let waits_for_room = core::mem::take(&mut state.waits_for_room);
        drop(state);
        if waits_for_room {
            self.0.space.notify_one();
        }
        frame
    }

    /// Frames that wait.
    pub fn len(&self) -> usize {
        self.state().frames.len()
    }

    /// True if no frame waits.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Count what went wrong.
    pub fn count(&self, fault: impl FnOnce(&mut Faults)) {
        fault(&mut self.state().faults);
    }

    /// What has gone wrong so far.
    pub fn faults(&self) -> Faults {
        self.state().faults
    }

    /// A thread that died left whole frames and counts.
    fn state(&self) -> MutexGuard<'_, State> {
        self.0.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_oldest_is_dropped_and_counted() {
        let queue = Queue::new(3, Faults::default());
        (0..5).for_each(|i| queue.push(vec![i]));
        let taken: Vec<_> = core::iter::from_fn(|| Some(queue.pop(Duration::ZERO)?.bytes)).collect();
        assert_eq!(taken, [[2], [3], [4]]);
        assert_eq!((queue.faults().dropped, queue.is_empty()), (2, true));
    }

    #[test]
    fn whoever_is_patient_waits_and_nothing_is_dropped() {
        let (queue, stop) = (Queue::new(2, Faults::default()), Stop::default());
        let filled = queue.clone();
        let filler = std::thread::spawn(move || {
            (0..100).for_each(|i| filled.push_patiently(vec![i], &stop));
            filled.close();
        });
        let mut taken = Vec::new();
        while !queue.is_over() {
            taken.extend(queue.pop(Duration::from_secs(5)).map(|frame| frame.bytes));
        }
        filler.join().unwrap();
        assert_eq!(taken, (0..100).map(|i| vec![i]).collect::<Vec<_>>());
        assert_eq!(queue.faults(), Faults::default());
    }

    #[test]
    fn faults_are_said_with_their_numbers() {
        let faults = Faults { dropped: 2, unsaved: 1, ..Faults::default() };
        assert_eq!(faults.to_string(), "2 frames dropped from a full buffer, 1 checkpoints not saved");
        assert_eq!(Faults::default().to_string(), "");
    }
}
