//! Recordings on disk and what follows from them: their frames, the batch fit with the exact twin, the posterior, the NUTS
//! reference, and simulated campaigns.
//!
//! ```
//! use inference::{BaseModel, BatchFit, Campaign, Recording, TuneUse};
//! use twin::Ring;
//!
//! let ring = Ring::booster();
//! let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../recordings/paper-vars");
//! let recording = Recording::read(folder.as_ref(), &ring)?;
//! let campaign = Campaign::of(&ring, &recording)?; // settings, and which readings count
//! let fit = BatchFit::best(&campaign, TuneUse::LeftOut, BaseModel::SCALES, |_| ())?;
//! assert!((0.9..1.1).contains(&fit.chi2_per_dof));
//! let left_out: usize = (0..campaign.monitors()).map(|b| campaign.screened.excluded.tally(b).values().sum::<usize>()).sum();
//! assert!(left_out > 0 && 10 * left_out < campaign.frames() * campaign.monitors());
//! # Ok::<(), Box<dyn core::error::Error>>(())
//! ```
//!
//! Four modules are public by name, since their functions read as `stream::replay` or `simulate::vars`.

mod base_model;
mod bounds;
mod campaign;
mod diagnostics;
mod draws;
mod imitation;
mod imperfection;
mod map_fit;
mod model;
pub mod nuts;
mod optimise;
mod posterior;
mod prior;
mod readings;
pub mod recording;
pub mod simulate;
pub mod stream;
#[cfg(test)]
mod testing;

pub use base_model::{BaseModel, BaseTerm, FittedTerm};
pub use bounds::{Bounded, Coordinate, Coordinates, softplus};
pub use campaign::{
    Campaign, Excluded, Exclusions, Meter, Screened, Setting, Settings, Stray, TUNE_CALIBRATION, Times, chi_square,
    furthest_stray,
};
pub use diagnostics::quantile;
pub use draws::{Chain, DrawStats, Draws, Summary};
pub use imitation::Imitation;
pub use imperfection::{Imperfection, Measure, POSITION, THROUGHOUT};
pub use map_fit::{BatchError, BatchFit, FittedTune, Lack, OpticsFunctions, TuneUse};
pub use model::{GreenModel, ResnetModel, ResponseModel};
pub use optimise::{End, Limits, Objective, OptimiseError, Quadratic, minimise};
pub use posterior::{Laplace, LaplaceError, Posterior};
pub use prior::{Prior, Width, draw, with_priors};
pub use readings::{Pair, Readings, Reduced};
pub use recording::{Drive, Recording, RecordingError};
pub use stream::{Core, Estimate, StreamError};
