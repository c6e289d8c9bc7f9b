//! Requests to a running daemon and its replies, over shared memory: a byte that says which or what became of it, then the rest.

use core::fmt::Display;
use core::time::Duration;
use std::time::Instant;

use iceoryx2::active_request::ActiveRequest;
use iceoryx2::port::client::Client;
use iceoryx2::port::server::Server;
use iceoryx2::prelude::{AllocationStrategy, BackpressureStrategy, Node, ipc};
use iceoryx2::service::port_factory::{PortFactory as _, request_response};

use super::services::{NODES, join, joined};
use super::{PUBLISHERS, PublishError, SUBSCRIBERS};

/// What the requests to the publisher of a service of estimates are called: its name, and this.
const SUFFIX: &str = "/request";
/// A client looks for its reply as often as this.
const GLANCE: Duration = Duration::from_millis(1);

/// What is asked of a daemon.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Request {
    /// A checkpoint of now, as bytes.
    Snapshot,
    /// The core back to its prior.
    Reset,
    /// Other tables, from this file.
    Model(String),
    /// The orbit feedback on or off.
    Feedback(bool),
}

/// What became of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Reply {
    /// It was done; a snapshot's bytes, else words.
    Done(Vec<u8>),
    /// The configuration does not allow it, or it could not be done; why.
    Refused(String),
}

impl Request {
    fn encode(&self) -> Vec<u8> {
        match self {
            Self::Snapshot => vec![1],
            Self::Reset => vec![2],
            Self::Model(path) => [&[3], path.as_bytes()].concat(),
            Self::Feedback(on) => vec![4, u8::from(*on)],
        }
    }

    fn decode(bytes: &[u8]) -> Option<Self> {
        match bytes {
            [1] => Some(Self::Snapshot),
            [2] => Some(Self::Reset),
            [4, on @ (0 | 1)] => Some(Self::Feedback(*on == 1)),
            [3, path @ ..] => Some(Self::Model(String::from_utf8(path.to_vec()).ok()?)),
            _ => None,
        }
    }
}

impl Reply {
    fn encode(&self) -> Vec<u8> {
        match self {
            Self::Done(bytes) => [&[0], bytes.as_slice()].concat(),
            Self::Refused(why) => [&[1], why.as_bytes()].concat(),
        }
    }

    fn decode(bytes: &[u8]) -> Option<Self> {
        match bytes {
            [0, rest @ ..] => Some(Self::Done(rest.to_vec())),
            [1, why @ ..] => Some(Self::Refused(String::from_utf8_lossy(why).into_owned())),
            _ => None,
        }
    }
}

struct Service {
    name: String,
    requests: request_response::PortFactory<ipc::Service, [u8], (), [u8], ()>,
    /// Belongs to it: it ends with it.
    _node: Node<ipc::Service>,
}

impl Service {
    fn try_join(estimates: &str, who: &str) -> Result<Self, PublishError> {
        let name = format!("{estimates}{SUFFIX}");
        let (node, service) = joined(&name, who)?;
        let requests = node.service_builder(&service).request_response::<[u8], [u8]>();
        let requests = requests.enable_safe_overflow_for_requests(true).enable_safe_overflow_for_responses(true);
        let requests = requests.max_servers(PUBLISHERS).max_clients(SUBSCRIBERS).max_nodes(NODES);
        let requests = requests.open_or_create().map_err(|e| join(&name, "requests", &e))?;
        Ok(Self { name, requests, _node: node })
    }

    fn wrong(&self, reason: &dyn Display) -> PublishError {
        PublishError::Receive { service: self.name.clone(), reason: reason.to_string() }
    }
}

/// A request that waits for its reply.
pub struct Asked {
    /// What is asked; none if the bytes are no request.
    pub request: Option<Request>,
    active: ActiveRequest<ipc::Service, [u8], (), [u8], ()>,
}

impl Asked {
    /// Reply, without waiting for whoever asked, who may be gone.
    ///
    /// # Errors
    /// What the shared memory says.
    pub fn reply(self, reply: &Reply) -> Result<(), Box<dyn core::error::Error + Send + Sync>> {
        let bytes = reply.encode();
        let response = self.active.loan_slice_uninit(bytes.len()).map_err(|error| error.to_string())?;
        response.write_from_slice(&bytes).send().map_err(|error| error.to_string())?;
        Ok(())
    }
}

/// The daemon's end.
pub struct RequestServer {
    server: Server<ipc::Service, [u8], (), [u8], ()>,
    service: Service,
}

impl RequestServer {
    /// Join the service beside that of the estimates, or create it; a process that was killed has left it.
    ///
    /// # Errors
    /// [`PublishError::Name`] or [`PublishError::Join`]; [`PublishError::Taken`] where another daemon has it.
    pub fn try_new(estimates: &str, who: &str) -> Result<Self, PublishError> {
        let service = Service::try_join(estimates, who)?;
        if service.requests.dynamic_config().number_of_servers() > 0 {
            return Err(PublishError::Taken { service: estimates.to_owned() });
        }
        let server = service.requests.server_builder().allocation_strategy(AllocationStrategy::PowerOfTwo);
        // a client that takes no replies is not waited for
        let server = server.initial_max_slice_len(1024).backpressure_strategy(BackpressureStrategy::DiscardData);
        let server = server.create().map_err(|e| join(&service.name, "server", &e))?;
        Ok(Self { server, service })
    }

    /// The next request, if there is one.
    ///
    /// # Errors
    /// [`PublishError::Receive`].
    pub fn receive(&mut self) -> Result<Option<Asked>, PublishError> {
        let active = self.server.receive().map_err(|e| self.service.wrong(&e))?;
        Ok(active.map(|active| Asked { request: Request::decode(active.payload()), active }))
    }
}

/// An operator's end.
pub struct RequestClient {
    client: Client<ipc::Service, [u8], (), [u8], ()>,
    service: Service,
}

impl RequestClient {
    /// Join the service beside that of the estimates, or create it.
    ///
    /// # Errors
    /// [`PublishError::Name`] or [`PublishError::Join`].
    pub fn try_new(estimates: &str) -> Result<Self, PublishError> {
        let service = Service::try_join(estimates, "orbitcal-request")?;
        let client = service.requests.client_builder().allocation_strategy(AllocationStrategy::PowerOfTwo);
        let client = client.initial_max_slice_len(1024).create().map_err(|e| join(&service.name, "client", &e))?;
        Ok(Self { client, service })
    }

    /// Ask, and wait for the reply for so long.
    ///
    /// # Errors
    /// [`PublishError::Receive`], also where nobody replies.
    pub fn ask(&mut self, request: &Request, patience: Duration) -> Result<Reply, PublishError> {
        let (start, bytes) = (Instant::now(), request.encode());
        let wrong = |reason: &dyn Display| self.service.wrong(reason);
        let message = self.client.loan_slice_uninit(bytes.len()).map_err(|e| wrong(&e))?;
        let pending = message.write_from_slice(&bytes).send().map_err(|e| wrong(&e))?;
        while start.elapsed() < patience {
            if let Some(response) = pending.receive().map_err(|e| wrong(&e))? {
                return Reply::decode(response.payload()).ok_or_else(|| wrong(&"no reply of a daemon"));
            }
            std::thread::sleep(GLANCE);
        }
        Err(wrong(&format_args!("no reply in {} s: is the daemon running?", patience.as_secs_f32())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn requests_and_replies_survive_shared_memory() {
        for request in [Request::Snapshot, Request::Reset, Request::Model("a/b ü".into()), Request::Feedback(true)] {
            assert_eq!(Request::decode(&request.encode()), Some(request));
        }
        for reply in [Reply::Done(vec![0, 255]), Reply::Done(vec![]), Reply::Refused("no".into())] {
            assert_eq!(Reply::decode(&reply.encode()), Some(reply));
        }
        for wrong in [&[][..], &[1, 0], &[9], &[3, 0xff], &[4, 2]] {
            assert_eq!(Request::decode(wrong), None, "{wrong:?}");
        }
    }

    #[test]
    fn a_client_without_a_daemon_gives_up_and_one_with_it_gets_all_bytes() {
        let name = format!("orbitcal/test/{}/ask", std::process::id());
        let mut client = RequestClient::try_new(&name).unwrap();
        let error = client.ask(&Request::Reset, Duration::from_millis(20)).unwrap_err();
        assert!(error.to_string().contains("is the daemon running?"), "{error}");
        let mut server = RequestServer::try_new(&name, "a test").unwrap();
        let second = RequestServer::try_new(&name, "another").err().unwrap().to_string();
        assert!(second.contains("another daemon publishes there"), "{second}");
        let large: Vec<u8> = (0..200_000_u32).map(|i| i as u8).collect();
        drop(client);
        std::thread::scope(|scope| {
            let ask =
                || RequestClient::try_new(&name).unwrap().ask(&Request::Snapshot, Duration::from_secs(60)).unwrap();
            let asked = scope.spawn(ask);
            let request = loop {
                if let Some(request) = server.receive().unwrap() {
                    break request;
                }
            };
            assert_eq!(request.request, Some(Request::Snapshot));
            request.reply(&Reply::Done(large.clone())).unwrap();
            assert_eq!(asked.join().unwrap(), Reply::Done(large.clone()));
        });
    }
}
