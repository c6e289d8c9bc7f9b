//! Offline science of orbitcal: recordings on disk, their frames, the exact batch answer, the NUTS reference, and the
//! published studies as reports.

mod cmdstan;
pub mod diagnose;
pub mod diagnostics;
pub mod draws;
pub mod map;
pub mod model;
pub mod nuts;
pub mod posterior;
pub mod prove;
pub mod readings;
pub mod recording;
pub mod report;
pub mod score;
pub mod simulate;
pub mod stream;
pub mod study;

pub use draws::{Chain, DrawStats, Draws, DrawsError, Summary};
pub use map::{BatchError, BatchFit};
pub use model::ResponseModel;
pub use posterior::{Posterior, Width};
pub use readings::{Campaign, Readings};
pub use recording::{Layout, Recording, RecordingError};
pub use stream::{Booster, BoosterEstimate, BoosterFrame, StreamError};
