//! The published network: its training set, its training, its tables, and the core that uses them.

mod booster;
pub mod checkpoint;
pub mod fit;
pub mod layers;
pub mod samples;
pub mod settings;
pub mod tables;

pub use booster::{Booster, Estimator, OtherRing, PLANES, ResNet, Steer, expect_known};
