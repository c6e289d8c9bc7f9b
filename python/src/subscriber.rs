//! The shared memory of a daemon.

use core::time::Duration;
use std::time::Instant;

use pyo3::prelude::*;

use crate::error::other;
use crate::estimate::Estimate;

/// How often the shared memory is looked at: it belongs to this thread, which sleeps in between, so that others have Python.
const OFTEN: Duration = Duration::from_millis(1);

/// A reader of published estimates; see `orbitcal.Subscriber`.
#[pyclass(unsendable, module = "orbitcal._orbitcal")]
pub struct Subscriber {
    subscriber: shared_memory::Subscriber,
}

#[pymethods]
impl Subscriber {
    #[new]
    fn new(service: &str) -> PyResult<Self> {
        Ok(Self { subscriber: shared_memory::Subscriber::try_new(service).map_err(other)? })
    }

    /// Everything that has arrived, in order; waits for something until the time [s] is over, while other threads of Python run.
    fn wait(&mut self, py: Python<'_>, timeout: f64) -> PyResult<Vec<Estimate>> {
        let end = Instant::now() + Duration::from_secs_f64(timeout.clamp(0.0, 1e9));
        loop {
            let published = self.subscriber.wait(Duration::ZERO).map_err(other)?;
            let left = end.saturating_duration_since(Instant::now());
            if !published.is_empty() || left.is_zero() {
                let each =
                    published.into_iter().map(|one| Estimate::of(one.record, Some(one.stamp.publisher.to_string())));
                return Ok(each.collect());
            }
            py.detach(|| std::thread::sleep(left.min(OFTEN)));
            py.check_signals()?;
        }
    }
}
