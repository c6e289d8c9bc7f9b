//! Recordings on disk and what follows from them: their frames, the batch fit with the exact twin, the posterior, the NUTS
//! reference, and simulated campaigns.

mod cmdstan;
pub mod diagnostics;
pub mod draws;
pub mod map;
pub mod model;
pub mod nuts;
pub mod posterior;
pub mod readings;
pub mod recording;
pub mod simulate;
pub mod stream;

pub use draws::{Chain, DrawStats, Draws, DrawsError, Summary};
pub use map::{BatchError, BatchFit};
pub use model::ResponseModel;
pub use posterior::{Posterior, Width};
pub use readings::{Campaign, Readings};
pub use recording::{Layout, Recording, RecordingError};
pub use stream::{Booster, BoosterEstimate, BoosterFrame, StreamError};
