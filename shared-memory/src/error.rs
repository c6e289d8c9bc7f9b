//! What can go wrong between processes.

/// Why estimates cannot be sent or heard.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PublishError {
    /// The name can be no service's or publisher's.
    #[error("{name:?}: expected a name of 1 to 127 printable ASCII characters, not beginning with iox2://")]
    Name {
        /// The name.
        name: String,
    },
    /// The shared memory cannot be joined.
    #[error(
        "service {service}: cannot create its {part}: {reason} (all processes need one user and one version, see \
         docs/shared-memory.md)"
    )]
    Join {
        /// The service.
        service: String,
        /// What could not be made.
        part: &'static str,
        /// Why.
        reason: String,
    },
    /// Two daemons would publish as one.
    #[error("service {service}: another daemon publishes there; give each a publish.service of its own")]
    Taken {
        /// The service.
        service: String,
    },
    /// An estimate was not sent.
    #[error("service {service}: estimate {sequence} was not sent: {reason}")]
    Send {
        /// The service.
        service: String,
        /// Sequence number of its frame.
        sequence: u32,
        /// Why.
        reason: String,
    },
    /// A raw frame was not sent.
    #[error("service {service}: a frame was not sent: {reason}")]
    SendFrame {
        /// The service.
        service: String,
        /// Why.
        reason: String,
    },
    /// Waiting or receiving failed.
    #[error("service {service}: cannot receive: {reason}")]
    Receive {
        /// The service.
        service: String,
        /// Why.
        reason: String,
    },
}
