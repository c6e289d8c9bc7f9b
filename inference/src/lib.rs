//! Offline science of orbitcal: recordings on disk, their frames, and the exact batch answer.

pub mod recording;
pub mod stream;

pub use recording::{Layout, Recording, RecordingError};
pub use stream::{Booster, BoosterEstimate, BoosterFrame, StreamError};
