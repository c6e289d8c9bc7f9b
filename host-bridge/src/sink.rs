//! Where estimates go: shared memory, a trace file, and whatever else implements [`Sink`].

pub mod trace;

use results::{EstimateRecord, output};
use shared_memory::Publisher;

/// Why a sink did not take an estimate.
pub type SinkError = Box<dyn core::error::Error + Send + Sync>;

/// A place that takes every estimate, in order. `docs/extending.md` writes one.
pub trait Sink {
    /// Take one estimate.
    ///
    /// # Errors
    /// Whatever keeps it from doing so.
    fn take(&mut self, record: &EstimateRecord) -> Result<(), SinkError>;

    /// No more will come: files are put in their place.
    ///
    /// # Errors
    /// Whatever keeps it from doing so.
    fn finish(self: Box<Self>) -> Result<(), SinkError> {
        Ok(())
    }
}

impl Sink for Publisher {
    fn take(&mut self, record: &EstimateRecord) -> Result<(), SinkError> {
        Ok(self.publish(record)?)
    }
}

/// Sinks side by side, each given every estimate.
#[derive(Default)]
pub struct Sinks(Vec<Member>);

struct Member {
    sink: Box<dyn Sink>,
    /// It fails with a warning, and the others go on without it.
    is_optional: bool,
}

impl Sinks {
    /// Add a sink whose failure ends the stream.
    #[must_use]
    pub fn with(mut self, sink: Option<impl Sink + 'static>) -> Self {
        self.0.extend(sink.map(|sink| Member { sink: Box::new(sink), is_optional: false }));
        self
    }

    /// Add a sink whose failure is a line on stderr; the stream goes on without it.
    #[must_use]
    pub fn with_optional(mut self, sink: Option<impl Sink + 'static>) -> Self {
        self.0.extend(sink.map(|sink| Member { sink: Box::new(sink), is_optional: true }));
        self
    }

    /// True if estimates go nowhere.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Hand an estimate to all of them.
    ///
    /// # Errors
    /// The first failure of a sink that is not optional.
    pub fn take(&mut self, record: &EstimateRecord) -> Result<(), SinkError> {
        let mut failed = Ok(());
        self.0.retain_mut(|member| match member.sink.take(record) {
            Err(error) if member.is_optional => {
                output::warn(format_args!("{error}; the rest is not published"));
                false
            }
            taken => {
                failed = core::mem::replace(&mut failed, Ok(())).and(taken);
                true
            }
        });
        failed
    }

    /// No more will come.
    ///
    /// # Errors
    /// The first failure; the other sinks are finished all the same.
    pub fn finish(self) -> Result<(), SinkError> {
        self.0.into_iter().map(|member| member.sink.finish()).fold(Ok(()), Result::and)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use super::*;

    /// Takes some estimates, then fails; `Some` once finished.
    #[derive(Clone, Default)]
    struct Short {
        room: usize,
        taken: Arc<Mutex<(usize, bool)>>,
    }

    impl Sink for Short {
        fn take(&mut self, _: &EstimateRecord) -> Result<(), SinkError> {
            let mut taken = self.taken.lock().unwrap();
            if taken.0 == self.room {
                return Err("full".into());
            }
            taken.0 += 1;
            Ok(())
        }

        fn finish(self: Box<Self>) -> Result<(), SinkError> {
            self.taken.lock().unwrap().1 = true;
            Ok(())
        }
    }

    fn short(room: usize) -> Short {
        Short { room, ..Short::default() }
    }

    #[test]
    fn every_sink_gets_every_estimate_and_is_finished() {
        let (one, two) = (short(9), short(9));
        let mut sinks = Sinks::default().with(Some(one.clone())).with_optional(Some(two.clone())).with(None::<Short>);
        (0..3).for_each(|_| sinks.take(&EstimateRecord::example(2, 1)).unwrap());
        sinks.finish().unwrap();
        assert_eq!([one, two].map(|sink| *sink.taken.lock().unwrap()), [(3, true); 2]);
    }

    #[test]
    fn a_sink_that_fails_ends_the_stream_unless_it_is_optional() {
        let (needed, optional) = (short(2), short(1));
        let mut sinks = Sinks::default().with_optional(Some(optional.clone())).with(Some(needed.clone()));
        assert!(sinks.take(&EstimateRecord::example(2, 1)).is_ok());
        assert!(sinks.take(&EstimateRecord::example(2, 1)).is_ok(), "the optional one has failed");
        assert_eq!(sinks.take(&EstimateRecord::example(2, 1)).unwrap_err().to_string(), "full");
        sinks.finish().unwrap();
        assert_eq!(*optional.taken.lock().unwrap(), (1, false), "it was let go");
        assert_eq!(*needed.taken.lock().unwrap(), (2, true));
    }
}
