//! The reader's end of the shared memory.

use core::fmt::Display;
use core::time::Duration;
use std::time::Instant;

use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::subscriber;
use iceoryx2::prelude::ipc;
use iceoryx2::sample::Sample;
use results::EstimateRecord;

use super::layout::{Header, Known, Stamp, decode};
use super::services::{Services, join};
use super::{BUFFER, PublishError};

/// Name of a reader's process among the nodes of the shared memory.
const READER: &str = "orbitcal-reader";

/// A record as it was published.
#[derive(Debug, Clone, PartialEq)]
pub struct Published {
    /// The estimate.
    pub record: EstimateRecord,
    /// By whom, and when.
    pub stamp: Stamp,
}

/// A reader's end.
pub struct Subscriber {
    listener: Listener<ipc::Service>,
    subscriber: subscriber::Subscriber<ipc::Service, [u32], Header>,
    services: Services,
    /// Names of the last record.
    known: Option<Known>,
}

impl Subscriber {
    /// Join a service, or create it: the publisher may start later, stop, and start again.
    ///
    /// # Errors
    /// [`PublishError::Name`] or [`PublishError::Join`].
    pub fn try_new(service: &str) -> Result<Self, PublishError> {
        let services = Services::try_join(service, READER)?;
        let listener = services.news.listener_builder().create().map_err(|e| join(service, "listener", &e))?;
        let subscriber =
            services.estimates.subscriber_builder().create().map_err(|e| join(service, "subscriber", &e))?;
        Ok(Self { listener, subscriber, services, known: None })
    }

    /// Everything that has arrived, in order; waits for something until the time is over or a signal comes.
    ///
    /// # Errors
    /// [`PublishError::Receive`].
    pub fn wait(&mut self, timeout: Duration) -> Result<Vec<Published>, PublishError> {
        let start = Instant::now();
        loop {
            let records = self.drain()?;
            let left = timeout.saturating_sub(start.elapsed());
            if !records.is_empty() || left.is_zero() || self.is_interrupted(left)? {
                return Ok(records);
            }
        }
    }

    /// The estimates at hand: wake-ups coalesce, so one may stand for many. No more than a full buffer, or a fast writer
    /// would keep its reader here.
    fn drain(&mut self) -> Result<Vec<Published>, PublishError> {
        let mut known = self.known.take();
        let next = || self.subscriber.receive().map_err(|e| self.wrong(&e)).transpose();
        let mut published = |sample: Sample<ipc::Service, [u32], Header>| {
            let decoded = decode(sample.user_header(), sample.payload(), &mut known);
            let (record, stamp) = decoded.map_err(|e| self.wrong(&e))?;
            Ok(Published { record, stamp })
        };
        let records = core::iter::from_fn(next).take(BUFFER).map(|sample| published(sample?)).collect();
        self.known = known;
        records
    }

    /// Sleep until there is news; true if a signal came instead.
    fn is_interrupted(&self, timeout: Duration) -> Result<bool, PublishError> {
        match self.listener.timed_wait(|_| {}, timeout) {
            Ok(_) => Ok(false),
            Err(ListenerWaitError::InterruptSignal) => Ok(true),
            Err(error) => Err(self.wrong(&error)),
        }
    }

    fn wrong(&self, reason: &dyn Display) -> PublishError {
        PublishError::Receive { service: self.services.name.clone(), reason: reason.to_string() }
    }
}
