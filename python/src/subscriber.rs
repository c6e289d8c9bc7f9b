//! The shared memory of a daemon.

use core::time::Duration;
use std::time::Instant;

use host_bridge::sink::shared_memory;
use pyo3::prelude::*;

use crate::error::other;
use crate::estimate::Estimate;

/// How often signals are looked at.
const OFTEN: Duration = Duration::from_millis(50);

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

    /// Everything that has arrived, in order; waits for something until the time [s] is over. Other threads of Python wait with it for up to
    /// 0.05 s: the shared memory belongs to this thread.
    fn wait(&mut self, py: Python<'_>, timeout: f64) -> PyResult<Vec<Estimate>> {
        let end = Instant::now() + Duration::from_secs_f64(timeout.clamp(0.0, 1e9));
        loop {
            let left = end.saturating_duration_since(Instant::now());
            let published = self.subscriber.wait(left.min(OFTEN)).map_err(other)?;
            py.check_signals()?;
            if !published.is_empty() || left.is_zero() {
                let each =
                    published.into_iter().map(|one| Estimate::of(one.record, Some(one.stamp.publisher.to_string())));
                return Ok(each.collect());
            }
            // let another thread have its turn
            py.detach(|| ());
        }
    }
}
