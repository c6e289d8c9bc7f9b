//! An estimate as every process on the machine sees it: plain data of one size, the same for readers in any language.

use iceoryx2::prelude::ZeroCopySend;
use inference::stream::BoosterEstimate;

/// Vars in a record.
pub const VARS: usize = 48;
/// Monitors in a record.
pub const MONITORS: usize = 33;
/// Entries of the lower triangle of a covariance, the diagonal included.
pub const TRIANGLE: usize = VARS * (VARS + 1) / 2;

/// One estimate in shared memory.
///
/// Little-endian on every machine that this runs on, 8-byte aligned, 5848 bytes, no hidden padding; the type name is
/// `orbitcal.Estimate.v1`. A change of this table is a new version of the name.
///
/// | offset | field | type | unit |
/// |---|---|---|---|
/// | 0 | `time_us` | u64 | us, of the frame |
/// | 8 | `clipped` | u64 | bit `i`: var `i` is at a bound of the prior |
/// | 16 | `accepted` | u64 | bit `b`: the reading of monitor `b` was used |
/// | 24 | `rejected` | u64 | bit `b`: monitor `b` reported and was not used |
/// | 32 | `started_ns` | u64 | ns since 1970, start of the publisher |
/// | 40 | `published_ns` | u64 | ns since 1970 |
/// | 48 | `sequence` | u32 | of the frame |
/// | 52 | `frames` | u32 | used so far; a gap tells of lost estimates |
/// | 56 | `rejected_frames` | u32 | refused so far |
/// | 60 | `linearised` | u32 | 1: the model was linearised anew |
/// | 64 | `nis` | f32 | 1, sum over the readings used |
/// | 68 | `log_evidence` | f32 | nat |
/// | 72 | `mean` | f32 x 48 | 1 |
/// | 264 | `sigma` | f32 x 48 | 1 |
/// | 456 | `map_params` | f32 x 48 | 1, `ln var` |
/// | 648 | `params_sigma` | f32 x 48 | 1, of `ln var` |
/// | 840 | `covariance` | f32 x 1176 | 1, of the vars, see below |
/// | 5544 | `monitor_sigma` | f32 x 33 | m |
/// | 5676 | `monitor_rejected` | u32 x 33 | readings not used so far |
/// | 5808 | `monitor_state` | u8 x 33 | 0 ok, 1 noisy, 2 jumps, 3 dead |
/// | 5841 | `padding` | u8 x 7 | 0 |
///
/// The covariance is its lower triangle row by row, `(0,0) (1,0) (1,1) (2,0) ..`: entry `(i, j)` with `j <= i` stands at
/// `i (i + 1) / 2 + j`. Vars are in the order A2 .. F8, A1 .. F7, monitors x_A6 .. y_F7.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[type_name("orbitcal.Estimate.v1")]
pub struct EstimateRecord {
    /// Time of the frame [us].
    pub time_us: u64,
    /// Bit `i` is 1 if var `i` is clipped to the prior's range.
    pub clipped: u64,
    /// Bit `b` is 1 if the reading of monitor `b` was used.
    pub accepted: u64,
    /// Bit `b` is 1 if monitor `b` reported and its reading was not used.
    pub rejected: u64,
    /// Start of the publisher, written by it [ns since 1970]. A new value tells of a restart.
    pub started_ns: u64,
    /// When the record was published, written by the publisher [ns since 1970].
    pub published_ns: u64,
    /// Sequence number of the frame.
    pub sequence: u32,
    /// Frames used so far: one more with each estimate.
    pub frames: u32,
    /// Frames refused so far.
    pub rejected_frames: u32,
    /// 1 if the model was linearised anew after this frame, else 0.
    pub linearised: u32,
    /// Joint normalised innovation squared of the readings used [1].
    pub nis: f32,
    /// `ln` of the evidence of all readings under the model [nat].
    pub log_evidence: f32,
    /// Mean of each var [1].
    pub mean: [f32; VARS],
    /// Standard deviation of each var [1].
    pub sigma: [f32; VARS],
    /// MAP of each `theta = ln var` [1].
    pub map_params: [f32; VARS],
    /// Standard deviation of each theta before truncation [1].
    pub params_sigma: [f32; VARS],
    /// Lower triangle of `Cov(var_i, var_j) = mean_i mean_j Cov(theta_i, theta_j)` [1], first order in theta.
    pub covariance: [f32; TRIANGLE],
    /// Noise of one reading of each monitor [m].
    pub monitor_sigma: [f32; MONITORS],
    /// Readings of each monitor that were not used so far.
    pub monitor_rejected: [u32; MONITORS],
    /// [`estimator::MonitorState`] of each monitor.
    pub monitor_state: [u8; MONITORS],
    /// Zero, up to a multiple of 8 bytes.
    pub padding: [u8; 7],
}

impl EstimateRecord {
    /// A record of nothing: all zero.
    pub const ZERO: Self = Self {
        time_us: 0,
        clipped: 0,
        accepted: 0,
        rejected: 0,
        started_ns: 0,
        published_ns: 0,
        sequence: 0,
        frames: 0,
        rejected_frames: 0,
        linearised: 0,
        nis: 0.0,
        log_evidence: 0.0,
        mean: [0.0; VARS],
        sigma: [0.0; VARS],
        map_params: [0.0; VARS],
        params_sigma: [0.0; VARS],
        covariance: [0.0; TRIANGLE],
        monitor_sigma: [0.0; MONITORS],
        monitor_rejected: [0; MONITORS],
        monitor_state: [0; MONITORS],
        padding: [0; 7],
    };

    /// What a core says after a frame, with the covariance of two `ln var`; the publisher adds its stamps.
    pub fn of(estimate: &BoosterEstimate, of_params: impl Fn(usize, usize) -> f32) -> Self {
        Self {
            time_us: estimate.time_us,
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
            map_params: estimate.map_params,
            params_sigma: estimate.params_sigma,
            covariance: triangle(|i, j| estimate.mean[i] * estimate.mean[j] * of_params(i, j)),
            monitor_sigma: estimate.health.map(|health| health.noise),
            monitor_rejected: estimate.health.map(|health| health.rejected),
            monitor_state: estimate.health.map(|health| health.state as u8),
            ..Self::ZERO
        }
    }

    /// Covariance of vars `i` and `j` [1].
    ///
    /// # Panics
    /// If there is no such var.
    ///
    /// ```
    /// # use host_bridge::record::EstimateRecord;
    /// let mut record = EstimateRecord::ZERO;
    /// record.covariance[4] = 0.5; // after (0,0) (1,0) (1,1) (2,0)
    /// assert_eq!([record.covariance_of(2, 1), record.covariance_of(1, 2)], [0.5, 0.5]);
    /// ```
    pub fn covariance_of(&self, i: usize, j: usize) -> f32 {
        let (row, column) = (i.max(j), i.min(j));
        self.covariance[row * (row + 1) / 2 + column]
    }

    /// NIS per reading used [1]: about 1 if the model and the noise are right; none if no reading was used.
    pub fn nis_per_reading(&self) -> Option<f32> {
        let readings = self.accepted.count_ones();
        (readings > 0).then(|| self.nis / readings as f32)
    }

    /// How far var `i` is from 1 [sigmas]; 0 without an error bar.
    ///
    /// # Panics
    /// If there is no such var.
    pub fn deviation(&self, i: usize) -> f32 {
        if self.sigma[i] > 0.0 { (self.mean[i] - 1.0) / self.sigma[i] } else { 0.0 }
    }
}

/// A symmetric matrix as its lower triangle, row by row.
fn triangle(entry: impl Fn(usize, usize) -> f32) -> [f32; TRIANGLE] {
    let mut packed = [0.0; TRIANGLE];
    let entries = (0..VARS).flat_map(|i| (0..=i).map(move |j| (i, j)));
    packed.iter_mut().zip(entries).for_each(|(to, (i, j))| *to = entry(i, j));
    packed
}

#[cfg(test)]
mod tests {
    use core::mem::{align_of, offset_of, size_of};

    use super::*;

    #[test]
    fn the_layout_is_the_documented_one() {
        assert_eq!((size_of::<EstimateRecord>(), align_of::<EstimateRecord>()), (5848, 8));
        macro_rules! stands_at {
            ($($field:ident $offset:literal)*) => {
                $(assert_eq!(offset_of!(EstimateRecord, $field), $offset, stringify!($field));)*
            };
        }
        stands_at! {
            time_us 0 clipped 8 accepted 16 rejected 24 started_ns 32 published_ns 40
            sequence 48 frames 52 rejected_frames 56 linearised 60 nis 64 log_evidence 68
            mean 72 sigma 264 map_params 456 params_sigma 648 covariance 840
            monitor_sigma 5544 monitor_rejected 5676 monitor_state 5808 padding 5841
        }
    }

    #[test]
    fn a_record_says_what_the_core_says() {
        let ring = twin::Ring::booster();
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/paper-vars");
        let layout = inference::stream::layout(&ring);
        let recording = inference::Recording::read(&folder, &layout).unwrap();
        let mut core = inference::stream::estimator(&ring, &recording, 0.0).unwrap();
        let mut wire = inference::stream::wire(&recording, &recording.rows[0]).unwrap();
        let estimate = core.ingest(&mut wire).unwrap();
        let record = EstimateRecord::of(&estimate, |i, j| core.covariance(i, j));
        assert_eq!((record.mean, record.sequence, record.frames), (estimate.mean, estimate.sequence, 1));
        for (i, j) in [(0, 0), (30, 7), (7, 30), (47, 47)] {
            let (of_vars, of_params) = (record.covariance_of(i, j), core.covariance(i, j));
            assert_eq!(of_vars, record.mean[i.max(j)] * record.mean[i.min(j)] * of_params, "({i}, {j})");
        }
        assert_eq!(record.monitor_sigma[32], estimate.health[32].noise);
    }
}
