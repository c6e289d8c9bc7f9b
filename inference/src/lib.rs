//! Recordings on disk and what follows from them: their frames, the batch fit with the exact twin, the posterior, the NUTS
//! reference, and simulated campaigns.

pub mod bounded;
pub mod campaign;
mod cmdstan;
pub mod diagnostics;
pub mod draws;
pub mod factor;
pub mod map_fit;
pub mod model;
pub mod nuts;
pub mod optimise;
pub mod posterior;
pub mod prior;
pub mod readings;
pub mod recording;
pub mod simulate;
pub mod stream;

pub use campaign::{Campaign, Excluded, Exclusions, Meter, Screened, Settings, is_powered};
pub use draws::{Chain, DrawStats, Draws, DrawsError, Summary};
pub use factor::Factor;
pub use map_fit::{BatchError, BatchFit, FittedTune, Lack, TuneUse};
pub use model::{GreenModel, ResnetModel, ResponseModel};
pub use posterior::{Laplace, LaplaceError, Posterior};
pub use prior::{Prior, Width, draw, with_priors};
pub use readings::{Pair, Readings, Reduced};
pub use recording::{Drive, Recording, RecordingError};
pub use stream::{Core, Estimate, StreamError};
