//! What the core's thread hands to the one that publishes.

use estimator::FitQuality;
use inference::stream::{Correction, Estimate, Spread};

use crate::checkpoint::Model;
use crate::source::queue::Arrived;

/// What is to be handed on.
pub enum Work {
    /// What the core has made of a frame.
    Taken(Box<Taken>),
    /// A checkpoint is due.
    Checkpoint(Saved),
    /// The last one: the disk is waited for.
    LastCheckpoint(Saved),
    /// What became of a wish.
    Done(Result<Done, String>),
}

/// A frame, and what the core has made of it.
pub struct Taken {
    /// As it came.
    pub frame: Arrived,
    /// Vars and monitors after it.
    pub estimate: Estimate,
    /// What the orbit feedback makes of it; none without one.
    pub correction: Option<Correction>,
    /// Of which the covariance is made.
    pub spread: Spread,
    /// Readings against the model, all frames so far.
    pub fit: FitQuality,
    /// Digest of the tables that predict.
    pub tables: u32,
    /// What the posterior expects of its readings [B] [m]; now and then, for the page.
    pub fitted: Option<Vec<f32>>,
}

/// The core's part of a checkpoint.
pub struct Saved {
    /// Of which model.
    pub model: Model,
    /// Number of the last frame in it, and of all frames.
    pub last: [u32; 2],
    /// The core's state.
    pub state: Vec<u8>,
}

/// A wish that was done.
pub enum Done {
    /// A checkpoint of now.
    Snapshot(Saved),
    /// The core is at its prior, or has other tables: health is learnt anew. In words.
    Anew(String),
    /// The feedback is on or off. In words.
    Switched(String),
}
