//! What travels: frames to the core, requests to a device and its replies, tables in parcels. Every value is checked here,
//! and nowhere else.

mod error;
mod frame;
pub mod link;
pub mod packet;
mod parcel;

pub use error::FrameError;
pub use frame::{CurrentCode, Frame, IntensityCode, MagnetCurrents, PositionCode, RfCode, TuneCode};
pub use parcel::{Parcel, ParcelError};
