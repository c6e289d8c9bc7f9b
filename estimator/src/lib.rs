//! The core of orbitcal: frame bytes in, quadrupole factors with error bars out, each machine cycle.
//!
//! `no_std`, no allocator, no `unsafe`, the same bits on host and chip. Start reading at [`Estimator::ingest`]; the
//! mathematics is in `docs/model.md`, the wire format in `docs/frame.md`.
//!
//! Shapes: `B` monitors, `C` correctors, `F` supplies, `M` quadrupoles, `N` params, `S` settings that are kept apart. All sizes
//! of one machine follow from a few numbers, by [`machine!`]; the Booster's stand in [`booster`].
#![no_std]
#![forbid(unsafe_code)]

mod beyond;
pub mod booster;
mod campaign;
mod drive;
mod estimate;
mod estimator;
mod following;
mod gaussian;
mod judged;
mod linear;
mod machine;
mod mask;
mod monitor;
mod prior;
mod quarantine;
mod ramp;
mod sizes;
mod state;
mod steer;
mod stream;
pub mod surrogate;
mod triangle;
mod tune;
pub mod wire;

pub use beyond::Beyond;
pub use campaign::{Beside, ByRepeats, Campaign, Cell, SAME_KICK, SAME_OFFSET, Setting, Verdict};
pub use drive::{Calibration, Drive, Each, SupplyCalibration};
pub use estimate::{Estimate, Health, MonitorState, Remarks};
pub use estimator::{Estimator, FitQuality, GROUPS, IngestError, Model, Prepared, Setup, Walk};
pub use gaussian::{Correlated, Gaussian, Reading, Solution};
pub use judged::Judged;
pub use mask::{Mask, words};
pub use monitor::{Gate, Monitor, Noise};
pub use prior::{Marginal, Prior};
pub use ramp::{RAMP_POINTS, Ramp, RampPoint, SAME_TIME};
pub use sizes::{Layout, Sizes, largest};
pub use state::{Bytes, State, StateError};
pub use steer::{Feedback, Hold, Response, Steer, Steered};
pub use stream::{Core, Steering};
pub use surrogate::{Prediction, Steerable, Surrogate, Tables};
pub use triangle::{Triangle, square};
pub use wire::packet;
pub use wire::{
    CurrentCode, Frame, FrameError, IntensityCode, MagnetCurrents, Parcel, ParcelError, PositionCode, RfCode, TuneCode,
};
