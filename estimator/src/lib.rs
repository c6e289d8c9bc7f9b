//! The core of orbitcal: frame bytes in, quadrupole factors with error bars out, each machine cycle.
//!
//! `no_std`, no allocator, no `unsafe`, the same bits on host and chip. Start reading at [`Estimator::ingest`]; the
//! mathematics is in `docs/model.md`, the wire format in `docs/frame.md`.
//!
//! Shapes: `B` monitors, `C` correctors, `N` params (one for each quadrupole), `S` settings that are kept apart.
#![no_std]
#![forbid(unsafe_code)]

pub mod booster;
mod campaign;
mod drive;
mod estimate;
mod estimator;
mod frame;
mod gaussian;
mod linear;
mod monitor;
pub mod packet;
mod prior;
mod sum;
pub mod surrogate;
mod triangle;

pub use campaign::{Campaign, Cell, Setting, Verdict};
pub use drive::{Beyond, Calibration, Drive};
pub use estimate::{Estimate, Health, MonitorState};
pub use estimator::{Estimator, FitQuality, IngestError, Model, Setup};
pub use frame::{CurrentCode, Frame, FrameError, MagnetCurrents, PositionCode, RfCode, TuneCode};
pub use gaussian::{Gaussian, Solution};
pub use monitor::{Gate, Monitor, Noise};
pub use prior::{Marginal, Prior};
pub use surrogate::{Prediction, Surrogate};
pub use triangle::Triangle;
