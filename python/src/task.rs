//! Work on a thread of its own, while this one hears of its progress and of Ctrl-C.

use core::ops::ControlFlow;
use core::time::Duration;
use std::panic::resume_unwind;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;

use pyo3::prelude::*;
use results::CommandError;

use crate::error::{other, raised};

/// How often signals are looked at.
const OFTEN: Duration = Duration::from_millis(50);

/// What a worker says.
enum News<T> {
    /// What it does now, and how much of it is done.
    Step(String, usize),
    /// That is all.
    Result(Result<T, CommandError>),
}

/// Where work says how far it is; it ends there when its result is no longer wanted.
pub struct Progress<T> {
    news: Sender<News<T>>,
    is_over: Arc<AtomicBool>,
}

/// The stack of a worker unwinds with it: no panic, so that nothing is printed.
struct Interrupted;

impl<T> Progress<T> {
    /// The next step of work that has no way to break off: its stack is unwound here.
    pub fn say(&self, what: &str) {
        self.step(what, 0);
    }

    /// The number of a step of such work.
    pub fn step(&self, what: &str, number: usize) {
        if self.tell(what, number).is_break() {
            resume_unwind(Box::new(Interrupted));
        }
    }

    /// How much is done of work that can break off.
    pub fn tell(&self, what: &str, done: usize) -> ControlFlow<()> {
        // nobody hears it where the result is not wanted any more
        let _ = self.news.send(News::Step(what.to_owned(), done));
        if self.is_over.load(Ordering::Relaxed) { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    }
}

/// Tells the worker to end, however its result is left.
struct Leaving(Arc<AtomicBool>);

impl Drop for Leaving {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// Let a thread work; `hear` is called with each step and how much of it is done. Ctrl-C raises `KeyboardInterrupt` within 0.05 s, and the
/// thread ends at its next step.
///
/// # Errors
/// What the work, `hear` or a signal raises.
pub fn run<T: Send + 'static>(
    py: Python<'_>,
    hear: Option<Bound<'_, PyAny>>,
    work: impl FnOnce(&Progress<T>) -> Result<T, CommandError> + Send + 'static,
) -> PyResult<T> {
    let (news, mut heard) = channel();
    let is_over = Arc::new(AtomicBool::new(false));
    let _leaving = Leaving(is_over.clone());
    let worker = std::thread::spawn(move || {
        let progress = Progress { news, is_over };
        let result = work(&progress);
        let _ = progress.news.send(News::Result(result));
    });
    loop {
        match wait(py, &mut heard) {
            Ok(News::Result(result)) => return result.map_err(raised),
            Ok(News::Step(what, done)) => {
                if let Some(hear) = &hear {
                    hear.call1((what, done))?;
                }
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return Err(panicked(worker)),
        }
        py.check_signals()?;
    }
}

fn wait<T: Send>(py: Python<'_>, heard: &mut Receiver<News<T>>) -> Result<News<T>, RecvTimeoutError> {
    py.detach(move || heard.recv_timeout(OFTEN))
}

/// A worker that has not said its result has panicked: a fault of the program, as an exception that `except Exception` hears.
fn panicked(worker: JoinHandle<()>) -> PyErr {
    let said = worker.join().err().and_then(|panic| {
        panic.downcast_ref::<String>().cloned().or_else(|| panic.downcast_ref::<&str>().map(|&text| text.to_owned()))
    });
    other(format!("a fault of the program: {}", said.unwrap_or_else(|| "it has no words".into())))
}
