//! What writers and readers join, with the same settings: whoever comes first creates it.

use core::fmt::Display;

use iceoryx2::prelude::{LogLevel, Node, NodeBuilder, NodeName, ServiceName, ipc, set_log_level_from_env_or};
use iceoryx2::service::builder::event::EventOpenOrCreateError;
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenOrCreateError;
use iceoryx2::service::port_factory::{event, publish_subscribe};

use super::layout::Header;
use super::{BUFFER, HISTORY, PUBLISHERS, PublishError, SUBSCRIBERS};

/// Processes at a time: every reader and writer, and some that look on.
pub(super) const NODES: usize = SUBSCRIBERS + PUBLISHERS + 4;

/// A service of estimates: samples of words of any number.
type Estimates = publish_subscribe::PortFactory<ipc::Service, [u32], Header>;

/// Estimates, and the event that announces each of them.
pub(super) struct Services {
    pub(super) name: String,
    pub(super) estimates: Estimates,
    pub(super) news: event::PortFactory<ipc::Service>,
    /// Belongs to them: they end with it.
    _node: Node<ipc::Service>,
}

impl Services {
    /// Join the service `name` as the process `who`.
    pub(super) fn try_join(name: &str, who: &str) -> Result<Self, PublishError> {
        let (node, service) = joined(name, who)?;
        let estimates = estimates(&node, &service).map_err(|e| join(name, "estimates", &e))?;
        let news = news(&node, &service).map_err(|e| join(name, "event", &e))?;
        Ok(Self { name: name.to_owned(), estimates, news, _node: node })
    }
}

/// The process `who` among those of the shared memory, and the name of a service.
pub(super) fn joined(name: &str, who: &str) -> Result<(Node<ipc::Service>, ServiceName), PublishError> {
    set_log_level_from_env_or(LogLevel::Error); // no word on absent configuration files
    let wrong = |_| PublishError::Name { name: name.to_owned() };
    let service = ServiceName::new(name).map_err(wrong)?;
    let node = NodeName::new(who).map_err(|_| PublishError::Name { name: who.to_owned() })?;
    let node = NodeBuilder::new().name(&node).create::<ipc::Service>().map_err(|e| join(name, "node", &e))?;
    Ok((node, service))
}

fn estimates(node: &Node<ipc::Service>, name: &ServiceName) -> Result<Estimates, PublishSubscribeOpenOrCreateError> {
    node.service_builder(name)
        .publish_subscribe::<[u32]>()
        .user_header::<Header>()
        .history_size(HISTORY)
        .subscriber_max_buffer_size(BUFFER)
        .enable_safe_overflow(true)
        .max_subscribers(SUBSCRIBERS)
        .max_publishers(PUBLISHERS)
        .max_nodes(NODES)
        .open_or_create()
}

pub(super) fn news(
    node: &Node<ipc::Service>,
    name: &ServiceName,
) -> Result<event::PortFactory<ipc::Service>, EventOpenOrCreateError> {
    node.service_builder(name)
        .event()
        .max_listeners(SUBSCRIBERS)
        .max_notifiers(PUBLISHERS)
        .max_nodes(NODES)
        .open_or_create()
}

pub(super) fn join(service: &str, part: &'static str, reason: &dyn Display) -> PublishError {
    PublishError::Join { service: service.to_owned(), part, reason: reason.to_string() }
}
