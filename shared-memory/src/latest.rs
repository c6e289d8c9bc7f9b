//! A service beside that of the estimates, of which the last record is there for whoever joins: health, set points. A record is a header and words,
//! with the names of machine and instruments behind them.

use core::fmt::{Debug, Display};

use iceoryx2::port::{publisher, subscriber};
use iceoryx2::prelude::{Node, ZeroCopySend, ipc};
use iceoryx2::service::port_factory::publish_subscribe;

use super::layout::word;
use super::services::{NODES, join, joined};
use super::{PUBLISHERS, PublishError, SUBSCRIBERS};

/// Records that wait for a slow reader.
const BUFFER: usize = 16;

/// The service, and the process that has joined it.
struct Service<H: Debug + ZeroCopySend> {
    name: String,
    records: publish_subscribe::PortFactory<ipc::Service, [u32], H>,
    /// Belongs to it: it ends with it.
    _node: Node<ipc::Service>,
}

impl<H: Debug + ZeroCopySend> Service<H> {
    fn try_join(name: String, who: &str) -> Result<Self, PublishError> {
        let (node, service) = joined(&name, who)?;
        let records = node.service_builder(&service).publish_subscribe::<[u32]>().user_header::<H>();
        let records = records.history_size(1).subscriber_max_buffer_size(BUFFER).enable_safe_overflow(true);
        let records = records.max_subscribers(SUBSCRIBERS).max_publishers(PUBLISHERS).max_nodes(NODES);
        let records = records.open_or_create().map_err(|e| join(&name, "records", &e))?;
        Ok(Self { name, records, _node: node })
    }
}

/// The daemon's end.
pub(super) struct Writer<H: Debug + ZeroCopySend + 'static> {
    publisher: publisher::Publisher<ipc::Service, [u32], H>,
    service: Service<H>,
    /// Names, each ended by a line feed.
    text: String,
}

impl<H: Debug + Default + ZeroCopySend> Writer<H> {
    /// Join the service of this name, or create it, for so many numbers and these names.
    pub fn try_new<'n>(
        name: String,
        who: &str,
        numbers: usize,
        names: impl Iterator<Item = &'n str>,
    ) -> Result<Self, PublishError> {
        let service = Service::try_join(name, who)?;
        // a name with a line feed in it would be two
        let text: String = names.map(|name| name.replace('\n', " ") + "\n").collect();
        let publisher = service.records.publisher_builder().initial_max_slice_len(numbers + text.len().div_ceil(4));
        let publisher = publisher.create().map_err(|e| join(&service.name, "publisher", &e))?;
        Ok(Self { publisher, service, text })
    }

    /// Length of the names [bytes].
    pub fn text_bytes(&self) -> u32 {
        self.text.len() as u32
    }

    /// Numbers with the names behind them.
    pub fn payload(&self, numbers: impl Iterator<Item = u32>) -> Vec<u32> {
        numbers.chain(self.text.as_bytes().chunks(4).map(word)).collect()
    }

    /// Publish the record of a frame; waits for nobody.
    pub fn send(&mut self, sequence: u32, header: H, payload: &[u32]) -> Result<(), PublishError> {
        let wrong = |reason: &dyn Display| PublishError::Send {
            service: self.service.name.clone(),
            sequence,
            reason: reason.to_string(),
        };
        let mut sample = self.publisher.loan_slice_uninit(payload.len()).map_err(|e| wrong(&e))?;
        *sample.user_header_mut() = header;
        sample.write_from_slice(payload).send().map_err(|e| wrong(&e))?;
        Ok(())
    }
}

/// A reader's end.
pub(super) struct Reader<H: Debug + ZeroCopySend + 'static> {
    subscriber: subscriber::Subscriber<ipc::Service, [u32], H>,
    service: Service<H>,
}

impl<H: Debug + ZeroCopySend> Reader<H> {
    /// Join the service of this name, or create it.
    pub fn try_new(name: String, who: &str) -> Result<Self, PublishError> {
        let service = Service::try_join(name, who)?;
        let subscriber = service.records.subscriber_builder().create();
        let subscriber = subscriber.map_err(|e| join(&service.name, "subscriber", &e))?;
        Ok(Self { subscriber, service })
    }

    /// The newest record that has come since the last call; what is none is an error.
    pub fn newest<R>(&mut self, decode: impl Fn(&H, &[u32]) -> Option<R>) -> Result<Option<R>, PublishError> {
        let wrong = |reason: &dyn Display| PublishError::Receive {
            service: self.service.name.clone(),
            reason: reason.to_string(),
        };
        let mut newest = None;
        while let Some(sample) = self.subscriber.receive().map_err(|e| wrong(&e))? {
            newest = Some(decode(sample.user_header(), sample.payload()).ok_or_else(|| wrong(&"no record"))?);
        }
        Ok(newest)
    }
}
