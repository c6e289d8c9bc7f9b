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

use heapless::Vec;

/// As many values as a list has room for. The library's own `collect` can panic at one more.
pub fn listed<T, const L: usize>(values: impl IntoIterator<Item = T>) -> Vec<T, L> {
    let mut list = Vec::new();
    for value in values.into_iter().take(L) {
        let _ = list.push(value); // there is room
    }
    list
}
