//! Estimates in shared memory: loan, write, send; up to 16 readers, none of which can hold the writer up.
//!
//! A slow reader loses its oldest estimates, and can tell by the gap in [`results::EstimateRecord::frames`]. A process that is
//! killed leaves shared memory behind, which the next process that joins any service clears away. Layout: [`layout`]. Beside the
//! estimates there are services of raw frames, of the health of monitors and correctors, of set points, and of requests to a daemon.
//!
//! ```
//! use core::time::Duration;
//! use results::EstimateRecord;
//! use shared_memory::{Publisher, Subscriber};
//!
//! let service = format!("orbitcal/example/{}", std::process::id());
//! let mut subscriber = Subscriber::try_new(&service)?;
//! let record = EstimateRecord::example(48, 33);
//! let mut publisher = Publisher::try_new(&service, "an example", &record.names)?;
//! publisher.publish(&record)?;
//! let heard = subscriber.wait(Duration::from_secs(5))?;
//! assert_eq!(heard[0].record, record);
//! # Ok::<(), shared_memory::PublishError>(())
//! ```

mod condition;
mod error;
mod frames;
mod health;
mod latest;
pub mod layout;
mod publisher;
mod requests;
mod services;
mod setpoints;
mod subscriber;

use std::time::{SystemTime, UNIX_EPOCH};

pub use condition::{Condition, HealthRecord, State};
pub use error::PublishError;
pub use frames::{FrameReader, FrameWriter};
pub use health::{HealthReader, HealthWriter};
pub use layout::Stamp;
pub use publisher::Publisher;
pub use requests::{Asked, Reply, Request, RequestClient, RequestServer};
pub use setpoints::{SetpointReader, SetpointWriter, Setpoints};
pub use subscriber::{Published, Subscriber};

/// Name of the service of estimates, and of the event that announces each of them.
pub const SERVICE: &str = "orbitcal/estimate";
/// Name of a publisher where none is given.
pub const PUBLISHER: &str = "orbitcal";
/// Estimates that a reader who joins late still gets.
pub const HISTORY: usize = 16;
/// Estimates that wait for a slow reader: a quarter of a second at 1 kHz.
pub const BUFFER: usize = 256;
/// Readers at a time.
pub const SUBSCRIBERS: usize = 16;
/// Writers at a time: a restarted one can join before the dead one is cleared away.
pub const PUBLISHERS: usize = 4;

/// Time [ns since 1970].
pub fn now_ns() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_nanos() as u64)
}
