//! Offline science of orbitcal: recordings on disk, their frames, and the exact batch answer.

pub mod map;
pub mod recording;
pub mod stream;

pub use map::{BatchError, BatchFit};
pub use recording::{Layout, Recording, RecordingError};
pub use stream::{Booster, BoosterEstimate, BoosterFrame, StreamError};
