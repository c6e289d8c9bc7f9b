//! Raw frames in shared memory: a service whose samples are frames as they are on the wire, one each, with the zero byte at the end.

use core::fmt::Display;
use core::time::Duration;

use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::{publisher, subscriber};
use iceoryx2::prelude::{AllocationStrategy, ipc};
use iceoryx2::service::port_factory::{PortFactory as _, event, publish_subscribe};

use super::services::{NODES, join, joined, news};
use super::{BUFFER, PUBLISHERS, PublishError, SUBSCRIBERS};

/// Frames, the event that announces them, and the process that has joined both.
struct Frames {
    name: String,
    frames: publish_subscribe::PortFactory<ipc::Service, [u8], ()>,
    news: event::PortFactory<ipc::Service>,
    /// Belongs to them: they end with it.
    _node: iceoryx2::prelude::Node<ipc::Service>,
}

impl Frames {
    fn try_join(name: &str, who: &str) -> Result<Self, PublishError> {
        let (node, service) = joined(name, who)?;
        let frames = node.service_builder(&service).publish_subscribe::<[u8]>();
        let frames = frames.subscriber_max_buffer_size(BUFFER).enable_safe_overflow(true).max_nodes(NODES);
        let frames = frames.max_subscribers(SUBSCRIBERS).max_publishers(PUBLISHERS).open_or_create();
        let frames = frames.map_err(|e| join(name, "frames", &e))?;
        let news = news(&node, &service).map_err(|e| join(name, "event", &e))?;
        Ok(Self { name: name.to_owned(), frames, news, _node: node })
    }
}

/// A front end's end.
pub struct FrameWriter {
    publisher: publisher::Publisher<ipc::Service, [u8], ()>,
    notifier: Notifier<ipc::Service>,
    service: Frames,
}

impl FrameWriter {
    /// Join a service, or create it, as the process `who`.
    ///
    /// # Errors
    /// [`PublishError::Name`] or [`PublishError::Join`].
    pub fn try_new(name: &str, who: &str) -> Result<Self, PublishError> {
        let service = Frames::try_join(name, who)?;
        // a frame that is longer than those before it takes new memory
        let publisher = service.frames.publisher_builder().allocation_strategy(AllocationStrategy::PowerOfTwo);
        let publisher = publisher.initial_max_slice_len(1024).create().map_err(|e| join(name, "publisher", &e))?;
        let notifier = service.news.notifier_builder().create().map_err(|e| join(name, "notifier", &e))?;
        Ok(Self { publisher, notifier, service })
    }

    /// The same where nobody else may send: frames of two machines would be one stream.
    ///
    /// # Errors
    /// [`PublishError::Name`], [`PublishError::Join`] or [`PublishError::Taken`].
    pub fn try_alone(name: &str, who: &str) -> Result<Self, PublishError> {
        let service = Frames::try_join(name, who)?;
        match service.frames.dynamic_config().number_of_publishers() {
            0 => Self::try_new(name, who),
            _ => Err(PublishError::Taken { service: name.to_owned() }),
        }
    }

    /// Send one frame to everybody who reads; waits for nobody.
    ///
    /// # Errors
    /// [`PublishError::SendFrame`].
    pub fn send(&mut self, frame: &[u8]) -> Result<(), PublishError> {
        let service = &self.service.name;
        let wrong =
            |reason: &dyn Display| PublishError::SendFrame { service: service.clone(), reason: reason.to_string() };
        let sample = self.publisher.loan_slice_uninit(frame.len()).map_err(|e| wrong(&e))?;
        sample.write_from_slice(frame).send().map_err(|e| wrong(&e))?;
        // one who cannot be woken looks for itself when its wait ends
        let _ = self.notifier.notify();
        Ok(())
    }
}

/// The end of whoever takes frames.
pub struct FrameReader {
    subscriber: subscriber::Subscriber<ipc::Service, [u8], ()>,
    listener: Listener<ipc::Service>,
    service: Frames,
}

impl FrameReader {
    /// Join a service, or create it: the front end may start later, stop, and start again.
    ///
    /// # Errors
    /// [`PublishError::Name`] or [`PublishError::Join`].
    pub fn try_new(name: &str, who: &str) -> Result<Self, PublishError> {
        let service = Frames::try_join(name, who)?;
        let listener = service.news.listener_builder().create().map_err(|e| join(name, "listener", &e))?;
        let subscriber = service.frames.subscriber_builder().create().map_err(|e| join(name, "subscriber", &e))?;
        Ok(Self { subscriber, listener, service })
    }

    /// Wait so long at most, and hand out each frame that has come.
    ///
    /// # Errors
    /// [`PublishError::Receive`].
    pub fn wait(&mut self, timeout: Duration, mut each: impl FnMut(&[u8])) -> Result<(), PublishError> {
        match self.listener.timed_wait(|_| {}, timeout) {
            Ok(_) | Err(ListenerWaitError::InterruptSignal) => {}
            Err(error) => return Err(self.wrong(&error)),
        }
        while let Some(sample) = self.subscriber.receive().map_err(|e| self.wrong(&e))? {
            each(sample.payload());
        }
        Ok(())
    }

    fn wrong(&self, reason: &dyn Display) -> PublishError {
        PublishError::Receive { service: self.service.name.clone(), reason: reason.to_string() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_of_any_length_arrive_in_order() {
        let name = format!("orbitcal/test/{}/frames", std::process::id());
        let mut reader = FrameReader::try_new(&name, "reader").unwrap();
        let mut writer = FrameWriter::try_new(&name, "writer").unwrap();
        let sent: Vec<Vec<u8>> = [3, 500, 5000, 7].map(|length| vec![length as u8; length]).to_vec();
        sent.iter().for_each(|frame| writer.send(frame).unwrap());
        let mut heard = Vec::new();
        reader.wait(Duration::from_secs(60), |frame| heard.push(frame.to_vec())).unwrap();
        assert_eq!(heard, sent);
        let second = FrameWriter::try_alone(&name, "a daemon").err().unwrap().to_string();
        assert!(second.contains("another daemon publishes there"), "{second}");
        drop(writer);
        FrameWriter::try_alone(&name, "a daemon").unwrap();
    }
}
