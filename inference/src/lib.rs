//! Offline science of orbitcal: recordings on disk, their frames, the exact batch answer, and how far to trust drawn
//! chains.

mod cmdstan;
pub mod diagnostics;
pub mod draws;
pub mod map;
pub mod recording;
pub mod stream;

pub use draws::{Chain, DrawStats, Draws, DrawsError, Summary};
pub use map::{BatchError, BatchFit};
pub use recording::{Layout, Recording, RecordingError};
pub use stream::{Booster, BoosterEstimate, BoosterFrame, StreamError};
