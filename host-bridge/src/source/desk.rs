//! What operators may ask of the running daemon, by its configuration.

use std::path::Path;

use results::model_file;
use results::output::warn;
use shared_memory::{Asked, Reply, Request, RequestServer};
use training::Tables;
use twin::Ring;

use crate::config::Requests;

/// What is to be done, once it is allowed.
pub enum Wish {
    /// A checkpoint of now.
    Snapshot,
    /// The core back to its prior.
    Reset,
    /// These tables.
    Model(Box<Tables>),
    /// The orbit feedback on or off.
    Feedback(bool),
}

/// What may be asked, of which machine.
pub struct Allowed {
    /// By the configuration.
    pub requests: Requests,
    /// As its supplies are recorded.
    pub ring: Ring,
}

/// Takes requests.
pub struct Desk {
    server: RequestServer,
    allowed: Allowed,
}

impl Desk {
    /// For a daemon.
    pub fn new(server: RequestServer, allowed: Allowed) -> Self {
        Self { server, allowed }
    }

    /// The next wish that is allowed, and who has it; others are refused here.
    pub fn receive(&mut self) -> Option<(Wish, Asked)> {
        let asked = self.server.receive().unwrap_or_else(|error| {
            warn(error);
            None
        })?;
        match self.judge(asked.request.as_ref()) {
            Ok(wish) => Some((wish, asked)),
            Err(why) => {
                warn(format_args!("request refused: {why}"));
                reply(asked, &Reply::Refused(why));
                None
            }
        }
    }

    fn judge(&self, request: Option<&Request>) -> Result<Wish, String> {
        let Requests { snapshot, reset, model, feedback } = self.allowed.requests;
        let not_allowed = |key: &str| Err(format!("requests.{key} is false in the configuration"));
        match request {
            Some(Request::Snapshot) if snapshot => Ok(Wish::Snapshot),
            Some(Request::Snapshot) => not_allowed("snapshot"),
            Some(Request::Reset) if reset => Ok(Wish::Reset),
            Some(Request::Reset) => not_allowed("reset"),
            Some(Request::Model(path)) if model => {
                let tables = model_file::read(Path::new(path), &self.allowed.ring);
                Ok(Wish::Model(Box::new(tables.map_err(|error| error.to_string())?)))
            }
            Some(Request::Model(_)) => not_allowed("model"),
            Some(Request::Feedback(on)) if feedback => Ok(Wish::Feedback(*on)),
            Some(Request::Feedback(_)) => not_allowed("feedback"),
            None => Err("the bytes are no request".to_owned()),
        }
    }
}

/// Reply; whoever asked may be gone, which changes nothing here.
pub fn reply(asked: Asked, reply: &Reply) {
    if let Err(error) = asked.reply(reply) {
        warn(format_args!("a reply was not sent: {error}"));
    }
}
