//! Offline science of orbitcal: recordings on disk, their frames, the exact batch answer, and how far to trust drawn
//! chains.

pub mod diagnostics;
pub mod map;
pub mod recording;
pub mod stream;

pub use map::{BatchError, BatchFit};
pub use recording::{Layout, Recording, RecordingError};
pub use stream::{Booster, BoosterEstimate, BoosterFrame, StreamError};
