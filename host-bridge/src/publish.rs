//! Estimates over iceoryx2 shared memory: zero-copy samples, an event for each, history for late joiners.

use core::time::Duration;

use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher as Port;
use iceoryx2::port::subscriber::Subscriber as SubscriberPort;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::{event, publish_subscribe};

use crate::record::EstimateRecord;

/// Name of the service, unless another one is asked for.
pub const SERVICE: &str = "orbitcal/estimate";

/// Samples that a late joiner gets at once.
const HISTORY: usize = 16;
/// Samples that wait for a slow subscriber, a quarter of a second at 1 kHz; the oldest give way.
const BUFFER: usize = 256;
/// A restarted publisher joins before the dead one is cleared away.
const PUBLISHERS: usize = 4;
const SUBSCRIBERS: usize = 16;

/// Why shared memory cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("shared memory service {service}: {what}: {reason}")]
pub struct PublishError {
    service: String,
    what: &'static str,
    reason: String,
}

/// Sends estimates.
pub struct Publisher {
    service: String,
    // ports before the node: they are dropped in this order
    port: Port<ipc::Service, EstimateRecord, ()>,
    notifier: Notifier<ipc::Service>,
    _node: Node<ipc::Service>,
}

/// Receives estimates.
pub struct Subscriber {
    service: String,
    port: SubscriberPort<ipc::Service, EstimateRecord, ()>,
    listener: Listener<ipc::Service>,
    _node: Node<ipc::Service>,
}

impl Publisher {
    /// Open or create the service of this name.
    ///
    /// # Errors
    /// [`PublishError`], for instance if another version of the record is published under the name.
    pub fn try_new(service: &str) -> Result<Self, PublishError> {
        let node = node(service)?;
        let port = samples(&node, service)?.publisher_builder().create().map_err(wrong(service, "publish"))?;
        let notifier = events(&node, service)?.notifier_builder().create().map_err(wrong(service, "notify"))?;
        Ok(Self { service: service.into(), port, notifier, _node: node })
    }

    /// Send one estimate: loan, write in place, send, wake the listeners.
    ///
    /// # Errors
    /// [`PublishError`].
    pub fn publish(&mut self, record: &EstimateRecord) -> Result<(), PublishError> {
        let sample = self.port.loan_uninit().map_err(wrong(&self.service, "loan"))?;
        sample.write_payload(*record).send().map_err(wrong(&self.service, "send"))?;
        self.notifier.notify().map_err(wrong(&self.service, "notify"))?;
        Ok(())
    }
}

impl Subscriber {
    /// Open or create the service of this name.
    ///
    /// # Errors
    /// [`PublishError`].
    pub fn try_new(service: &str) -> Result<Self, PublishError> {
        let node = node(service)?;
        let port = samples(&node, service)?.subscriber_builder().buffer_size(BUFFER).create();
        let listener = events(&node, service)?.listener_builder().create().map_err(wrong(service, "listen"))?;
        Ok(Self { service: service.into(), port: port.map_err(wrong(service, "subscribe"))?, listener, _node: node })
    }

    /// Wait for estimates, at most `timeout`, and hand each one that is there to `hear`; returns their number.
    ///
    /// # Errors
    /// [`PublishError`].
    pub fn wait(&mut self, timeout: Duration, mut hear: impl FnMut(&EstimateRecord)) -> Result<usize, PublishError> {
        // Wake-ups coalesce, so whatever is there is taken, however many events there were.
        self.listener.timed_wait(|_| (), timeout).map_err(wrong(&self.service, "wait"))?;
        let mut heard = 0;
        while let Some(sample) = self.port.receive().map_err(wrong(&self.service, "receive"))? {
            hear(sample.payload());
            heard += 1;
        }
        Ok(heard)
    }
}

fn node(service: &str) -> Result<Node<ipc::Service>, PublishError> {
    // Without a configuration file the library would say so on every start; its own variable turns it up again.
    set_log_level_from_env_or(LogLevel::Error);
    NodeBuilder::new().create::<ipc::Service>().map_err(wrong(service, "create node"))
}

type Samples = publish_subscribe::PortFactory<ipc::Service, EstimateRecord, ()>;

fn samples(node: &Node<ipc::Service>, service: &str) -> Result<Samples, PublishError> {
    node.service_builder(&name(service)?)
        .publish_subscribe::<EstimateRecord>()
        .history_size(HISTORY)
        .subscriber_max_buffer_size(BUFFER)
        .enable_safe_overflow(true)
        .max_publishers(PUBLISHERS)
        .max_subscribers(SUBSCRIBERS)
        .open_or_create()
        .map_err(wrong(service, "open"))
}

fn events(node: &Node<ipc::Service>, service: &str) -> Result<event::PortFactory<ipc::Service>, PublishError> {
    node.service_builder(&name(service)?)
        .event()
        .max_notifiers(PUBLISHERS)
        .max_listeners(SUBSCRIBERS)
        .open_or_create()
        .map_err(wrong(service, "open events"))
}

fn name(service: &str) -> Result<ServiceName, PublishError> {
    service.try_into().map_err(wrong(service, "name"))
}

fn wrong<E: core::fmt::Debug>(service: &str, what: &'static str) -> impl FnOnce(E) -> PublishError {
    let service = service.to_owned();
    move |error| PublishError { service, what, reason: format!("{error:?}") }
}
