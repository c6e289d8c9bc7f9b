//! SIGINT and SIGTERM as a question, so that a stream ends between two estimates and leaves no file behind.

use core::sync::atomic::{AtomicBool, Ordering};
use core::time::Duration;
use std::io;
use std::sync::Arc;
use std::time::Instant;

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::flag;

/// Longest sleep without a look at the question.
const GLANCE: Duration = Duration::from_millis(100);

/// Whether somebody has asked the process to end.
#[derive(Debug, Clone, Default)]
pub struct Stop(Arc<AtomicBool>);

impl Stop {
    /// From now on the first signal only sets what is asked here; a second one ends the process as usual.
    ///
    /// # Errors
    /// What the system says.
    pub fn on_signals() -> io::Result<Self> {
        let stop = Self::default();
        for signal in [SIGINT, SIGTERM] {
            // in this order: the first signal finds the flag down, and puts it up
            flag::register_conditional_default(signal, stop.0.clone())?;
            flag::register(signal, stop.0.clone())?;
        }
        Ok(stop)
    }

    /// From now on signals, a closed terminal's among them, only set what is asked here: the process ends by itself when what has to be
    /// done before is done.
    ///
    /// # Errors
    /// What the system says.
    pub fn until_done() -> io::Result<Self> {
        let stop = Self::default();
        [SIGINT, SIGTERM, SIGHUP]
            .into_iter()
            .try_for_each(|signal| flag::register(signal, stop.0.clone()).map(drop))?;
        Ok(stop)
    }

    /// True once a signal has come.
    pub fn is_requested(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// Sleep until a moment, or until a signal comes.
    pub fn sleep_until(&self, due: Instant) {
        while !self.is_requested() {
            let left = due.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return;
            }
            std::thread::sleep(left.min(GLANCE));
        }
    }
}
