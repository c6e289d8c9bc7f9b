//! What writers and readers join, with the same settings: whoever comes first creates it.

use core::fmt::Display;
use core::time::Duration;

use iceoryx2::prelude::{LogLevel, Node, NodeBuilder, NodeName, ServiceName, ipc, set_log_level_from_env_or};
use iceoryx2::service::builder::event::EventOpenOrCreateError;
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenOrCreateError;
use iceoryx2::service::port_factory::{event, publish_subscribe};

use super::{BUFFER, HISTORY, PUBLISHERS, PublishError, SUBSCRIBERS};
use crate::record::EstimateRecord;

/// Processes at a time: every reader and writer, and some that look on.
const NODES: usize = SUBSCRIBERS + PUBLISHERS + 4;

/// Estimates, and the event that announces each of them.
pub(super) struct Services {
    pub(super) name: String,
    node: Node<ipc::Service>,
    pub(super) estimates: publish_subscribe::PortFactory<ipc::Service, EstimateRecord, ()>,
    pub(super) news: event::PortFactory<ipc::Service>,
}

impl Services {
    pub(super) fn try_join(name: &str) -> Result<Self, PublishError> {
        set_log_level_from_env_or(LogLevel::Error); // no word on absent configuration files
        let wrong = |_| PublishError::Name { service: name.to_owned() };
        let service = ServiceName::new(name).map_err(wrong)?;
        let node = NodeBuilder::new()
            .name(&NodeName::new("orbitcal").expect("a short name is a node name"))
            .create::<ipc::Service>()
            .map_err(|e| join(name, "node", &e))?;
        let estimates = estimates(&node, &service).map_err(|e| join(name, "estimates", &e))?;
        let news = news(&node, &service).map_err(|e| join(name, "event", &e))?;
        Ok(Self { name: name.to_owned(), node, estimates, news })
    }

    /// True once after SIGINT or SIGTERM. The first question installs their handlers; each takes some 6 us.
    pub(super) fn is_stop_requested(&self) -> bool {
        self.node.wait(Duration::ZERO).is_err()
    }
}

fn estimates(
    node: &Node<ipc::Service>,
    name: &ServiceName,
) -> Result<publish_subscribe::PortFactory<ipc::Service, EstimateRecord, ()>, PublishSubscribeOpenOrCreateError> {
    node.service_builder(name)
        .publish_subscribe::<EstimateRecord>()
        .history_size(HISTORY)
        .subscriber_max_buffer_size(BUFFER)
        .enable_safe_overflow(true)
        .max_subscribers(SUBSCRIBERS)
        .max_publishers(PUBLISHERS)
        .max_nodes(NODES)
        .open_or_create()
}

fn news(
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
