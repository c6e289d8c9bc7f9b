//! One estimate as it lies in shared memory, for readers in any language.
//!
//! Little endian, `repr(C)`, no implicit padding; the type's name is `orbitcal.Estimate.v1`, and a change of layout
//! changes the name. Offsets in bytes:
//!
//! | at | field | type | meaning |
//! |---|---|---|---|
//! | 0 | `time_us` | u64 | time of the frame since the start of the stream [us] |
//! | 8 | `started_ns` | u64 | start of the publishing process, since the Unix epoch [ns]: another value is another run |
//! | 16 | `published_ns` | u64 | when the record was written, since the Unix epoch [ns] |
//! | 24 | `clipped` | u64 | bit i: var i sits at a bound of 0.94..1.06 |
//! | 32 | `accepted` | u64 | bit b: the reading of monitor b was used |
//! | 40 | `rejected` | u64 | bit b: monitor b reported and was not used |
//! | 48 | `sequence` | u32 | number of the cycle |
//! | 52 | `frames` | u32 | frames used since the start |
//! | 56 | `rejected_frames` | u32 | frames refused since the start |
//! | 60 | `linearised` | u32 | 1 if the model was linearised anew after this frame |
//! | 64 | `nis` | f32 | joint normalised innovation squared of the readings used |
//! | 68 | `log_evidence` | f32 | ln of the evidence of all readings |
//! | 72 | `mean` | f32 x 48 | mean of each var [1], A2..F8 then A1..F7 |
//! | 264 | `sigma` | f32 x 48 | its standard deviation [1] |
//! | 456 | `covariance` | f32 x 1176 | lower triangle of the vars' covariance, row by row |
//! | 5160 | `monitor_noise` | f32 x 33 | noise of each monitor [m], x then y |
//! | 5292 | `monitor_rejected` | u32 x 33 | its readings not used |
//! | 5424 | `monitor_state` | u8 x 33 | 0 ok, 1 noisy, 2 jumps, 3 dead |
//! | 5457 | `reserved` | u8 x 7 | 0 |

use std::time::{SystemTime, UNIX_EPOCH};

use iceoryx2::prelude::ZeroCopySend;
use inference::stream::{Booster, BoosterEstimate};

/// Entries of a lower triangle of 48 rows.
const TRIANGLE: usize = 48 * 49 / 2;

/// One estimate; the fields are described at the head of this file.
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("orbitcal.Estimate.v1")]
#[repr(C)]
#[allow(missing_docs)] // the table above
pub struct EstimateRecord {
    pub time_us: u64,
    pub started_ns: u64,
    pub published_ns: u64,
    pub clipped: u64,
    pub accepted: u64,
    pub rejected: u64,
    pub sequence: u32,
    pub frames: u32,
    pub rejected_frames: u32,
    pub linearised: u32,
    pub nis: f32,
    pub log_evidence: f32,
    pub mean: [f32; 48],
    pub sigma: [f32; 48],
    pub covariance: [f32; TRIANGLE],
    pub monitor_noise: [f32; 33],
    pub monitor_rejected: [u32; 33],
    pub monitor_state: [u8; 33],
    pub reserved: [u8; 7],
}

impl EstimateRecord {
    /// The record of an estimate and of the covariance behind it; `started_ns` tells runs apart.
    pub fn of(estimate: &BoosterEstimate, core: &Booster, started_ns: u64) -> Self {
        Self {
            time_us: estimate.time_us,
            started_ns,
            published_ns: now_ns(),
            clipped: estimate.clipped,
            accepted: estimate.accepted,
            rejected: estimate.rejected,
            sequence: estimate.sequence,
            frames: estimate.frames,
            rejected_frames: estimate.rejected_frames,
            linearised: u32::from(estimate.linearised),
            nis: estimate.nis,
            log_evidence: estimate.log_evidence,
            mean: estimate.mean,
            sigma: estimate.sigma,
            covariance: covariance(estimate, core),
            monitor_noise: estimate.health.map(|h| h.noise),
            monitor_rejected: estimate.health.map(|h| h.rejected),
            monitor_state: estimate.health.map(|h| h.state as u8),
            reserved: [0; 7],
        }
    }
}

/// Covariance of the vars, `mean_i mean_j` times that of their logarithms.
fn covariance(estimate: &BoosterEstimate, core: &Booster) -> [f32; TRIANGLE] {
    let mut packed = [0.0; TRIANGLE];
    let pairs = (0..48).flat_map(|i| (0..=i).map(move |j| (i, j)));
    for (to, (i, j)) in packed.iter_mut().zip(pairs) {
        *to = estimate.mean[i] * estimate.mean[j] * core.covariance(i, j);
    }
    packed
}

/// Time since the Unix epoch [ns].
pub fn now_ns() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos() as u64)
}

#[cfg(test)]
mod tests {
    use core::mem::{offset_of, size_of};

    use super::*;

    #[test]
    fn the_layout_is_the_documented_one() {
        assert_eq!(size_of::<EstimateRecord>(), 5464);
        let offsets = [
            (offset_of!(EstimateRecord, sequence), 48),
            (offset_of!(EstimateRecord, nis), 64),
            (offset_of!(EstimateRecord, mean), 72),
            (offset_of!(EstimateRecord, sigma), 264),
            (offset_of!(EstimateRecord, covariance), 456),
            (offset_of!(EstimateRecord, monitor_noise), 5160),
            (offset_of!(EstimateRecord, monitor_rejected), 5292),
            (offset_of!(EstimateRecord, monitor_state), 5424),
            (offset_of!(EstimateRecord, reserved), 5457),
        ];
        for (found, documented) in offsets {
            assert_eq!(found, documented);
        }
    }
}
