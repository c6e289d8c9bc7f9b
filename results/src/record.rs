//! An estimate on its way out: what every sink gets, for a ring of any size, with the names of what it holds.

use core::fmt;
use std::sync::Arc;

use estimator::{MonitorState, Remarks};
use inference::stream::Estimate;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use twin::Ring;

/// Whose numbers a record holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Names {
    /// The machine.
    pub machine: String,
    /// Strength factors (vars) [N].
    pub vars: Vec<String>,
    /// Read monitors [B].
    pub monitors: Vec<String>,
}

impl Names {
    /// Those of a ring.
    pub fn of(ring: &Ring) -> Arc<Self> {
        Arc::new(Self { machine: ring.name.clone(), vars: ring.var_names(), monitors: ring.monitor_names() })
    }
}

/// What became of a monitor's reading in a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum ReadingUse {
    /// The monitor did not report.
    Absent = 0,
    /// It was used.
    Used = 1,
    /// It was outside the gate, and not used.
    Rejected = 2,
}

/// How many frames each remark was made of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Remarked {
    /// No beam, or one that the model does not know: nothing in the frame was used.
    pub put_aside_frames: u32,
    /// The baselines were found to have moved.
    pub baselines_moved: u32,
    /// The information was not positive.
    pub unsolved_frames: u32,
}

impl Remarked {
    /// Count a frame.
    pub fn add(&mut self, remarks: &Remarks) {
        self.put_aside_frames += u32::from(remarks.put_aside);
        self.baselines_moved += u32::from(remarks.baselines_moved);
        self.unsolved_frames += u32::from(remarks.unsolved);
    }
}

/// What there is of it, each behind a comma.
impl fmt::Display for Remarked {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { put_aside_frames, baselines_moved, unsolved_frames } = *self;
        let said = [
            (put_aside_frames, "frames put aside, without beam or with one that the model does not know"),
            (baselines_moved, "times moved baselines"),
            (unsolved_frames, "frames without a solution"),
        ];
        said.iter().filter(|(count, _)| *count > 0).try_for_each(|(count, what)| write!(f, ", {count} {what}"))
    }
}

/// One estimate: vars with error bars and covariance, and the state of every monitor after one frame.
#[derive(Debug, Clone, PartialEq)]
pub struct EstimateRecord {
    /// Whose numbers these are.
    pub names: Arc<Names>,
    /// Sequence number of the frame.
    pub sequence: u32,
    /// Time of the frame [us].
    pub time_us: u64,
    /// Frames taken so far, those put aside included: one more with each estimate.
    pub frames: u32,
    /// Frames refused so far.
    pub rejected_frames: u32,
    /// What is to be said of this frame as a whole.
    pub remarks: Remarks,
    /// How often each of that was said, this frame included: since whoever serves it began to count, or since the first start of what was resumed.
    pub remarked: Remarked,
    /// Digest of the tables that predict; none where that is not known.
    pub tables: Option<u32>,
    /// The model was relinearised since the last estimate.
    pub linearised: bool,
    /// The readings are further off than noise explains; none where that was not asked.
    pub mismatch: Option<bool>,
    /// Joint normalised innovation squared of the readings used, tunes included [1].
    pub nis: f32,
    /// Measured less predicted tunes x and y; none where the meter did not report, or does not count [1].
    pub tune_innovation: [Option<f32>; 2],
    /// `ln` of the evidence of all readings under the model [nat].
    pub log_evidence: f32,
    /// Mean of each var [N] [1].
    pub mean: Vec<f32>,
    /// Standard deviation of each var [N] [1].
    pub sigma: Vec<f32>,
    /// Maximum a posteriori of each `theta = ln var` [N] [1].
    pub map_params: Vec<f32>,
    /// Centre of the normal of each theta before it is truncated to the prior's range [N] [1].
    pub centre: Vec<f32>,
    /// Its standard deviation [N] [1].
    pub params_sigma: Vec<f32>,
    /// Whether each var sits at a bound of the prior's range [N].
    pub clipped: Vec<bool>,
    /// Lower triangle of `Cov(var_i, var_j) = mean_i mean_j Cov(theta_i, theta_j)`, first order in theta, row by row:
    /// `(0,0) (1,0) (1,1) (2,0) ..` [N(N+1)/2] [1]. Zero where a device did not send it.
    pub covariance: Vec<f32>,
    /// What became of each monitor's reading [B].
    pub reading: Vec<ReadingUse>,
    /// State of each monitor [B].
    pub monitor_state: Vec<MonitorState>,
    /// Noise of one reading of each monitor [B] [m].
    pub monitor_sigma: Vec<f32>,
    /// Readings of each monitor that were not used so far [B].
    pub monitor_rejected: Vec<u32>,
}

impl EstimateRecord {
    /// One of a ring with this many vars `V0 ..` and monitors `M0 ..`, for examples and tests: all vars 1.000 ± 0.010, all readings used.
    pub fn example(vars: usize, monitors: usize) -> Self {
        let names = |letter: &str, count| (0..count).map(|i| format!("{letter}{i}")).collect();
        let names = Names { machine: "test ring".into(), vars: names("V", vars), monitors: names("M", monitors) };
        Self {
            names: Arc::new(names),
            sequence: 0,
            time_us: 0,
            frames: 1,
            rejected_frames: 0,
            remarks: Remarks::default(),
            remarked: Remarked::default(),
            tables: None,
            linearised: false,
            mismatch: Some(false),
            nis: 0.0,
            tune_innovation: [None; 2],
            log_evidence: 0.0,
            mean: vec![1.0; vars],
            sigma: vec![0.01; vars],
            map_params: vec![0.0; vars],
            centre: vec![0.0; vars],
            params_sigma: vec![0.01; vars],
            clipped: vec![false; vars],
            covariance: (0..vars).flat_map(|i| (0..=i).map(move |j| if i == j { 0.01 * 0.01 } else { 0.0 })).collect(),
            reading: vec![ReadingUse::Used; monitors],
            monitor_state: vec![MonitorState::Ok; monitors],
            monitor_sigma: vec![0.15e-3; monitors],
            monitor_rejected: vec![0; monitors],
        }
    }

    /// What a core says after a frame, with the covariance of all `ln var`, the lower triangle row by row, or more, and its mismatch alarm.
    pub fn of(names: &Arc<Names>, estimate: Estimate, of_params: &[f32], mismatch: Option<bool>) -> Self {
        let reading = |(accepted, rejected): (&bool, &bool)| match (accepted, rejected) {
            (true, _) => ReadingUse::Used,
            (false, true) => ReadingUse::Rejected,
            (false, false) => ReadingUse::Absent,
        };
        let health = &estimate.health;
        Self {
            names: names.clone(),
            sequence: estimate.sequence,
            time_us: estimate.time_us,
            frames: estimate.frames,
            rejected_frames: estimate.rejected_frames,
            remarks: estimate.remarks,
            remarked: Remarked::default(),
            tables: None,
            linearised: estimate.linearised,
            mismatch,
            nis: estimate.nis,
            tune_innovation: estimate.tune_innovation,
            log_evidence: estimate.log_evidence,
            covariance: of_vars(&estimate.mean, of_params),
            reading: estimate.accepted.iter().zip(&estimate.rejected).map(reading).collect(),
            monitor_state: health.iter().map(|health| health.state).collect(),
            monitor_sigma: health.iter().map(|health| health.noise).collect(),
            monitor_rejected: health.iter().map(|health| health.rejected).collect(),
            mean: estimate.mean,
            sigma: estimate.sigma,
            map_params: estimate.map_params,
            centre: estimate.centre,
            params_sigma: estimate.params_sigma,
            clipped: estimate.clipped,
        }
    }

    /// Covariance of vars `i` and `j` [1].
    ///
    /// # Panics
    /// If there is no such var.
    pub fn covariance_of(&self, i: usize, j: usize) -> f32 {
        let (row, column) = (i.max(j), i.min(j));
        self.covariance[row * (row + 1) / 2 + column]
    }

    /// NIS per reading used, tunes included [1]: about 1 if the model and the noise are right; none if no reading was used.
    pub fn nis_per_reading(&self) -> Option<f32> {
        let readings = self.readings(ReadingUse::Used) + self.tune_innovation.iter().flatten().count();
        (readings > 0).then(|| self.nis / readings as f32)
    }

    /// Whether somebody may act on it: means and error bars are numbers, this frame had a solution and was not put aside, and
    /// readings and model are not known to disagree.
    pub fn is_usable(&self) -> bool {
        let is_number = |(mean, sigma): (&f32, &f32)| mean.is_finite() && sigma.is_finite() && *sigma > 0.0;
        let has_solution = !self.remarks.unsolved && !self.remarks.put_aside;
        has_solution && self.mismatch != Some(true) && self.mean.iter().zip(&self.sigma).all(is_number)
    }

    /// The remarks of this frame in words.
    pub fn words(&self) -> impl Iterator<Item = &'static str> {
        let Remarks { put_aside, baselines_moved, unsolved, let_loose, slices: _ } = self.remarks;
        let all = [
            (put_aside, "put aside"),
            (baselines_moved, "baselines moved"),
            (unsolved, "unsolved"),
            (let_loose.is_some(), "a var has stepped"),
        ];
        all.into_iter().filter_map(|(is_said, word)| is_said.then_some(word))
    }

    /// Number of readings of this frame that met this end.
    pub fn readings(&self, wanted: ReadingUse) -> usize {
        self.reading.iter().filter(|end| **end == wanted).count()
    }

    /// How far var `i` is from 1 [sigmas]; 0 without an error bar.
    ///
    /// # Panics
    /// If there is no such var.
    pub fn deviation(&self, i: usize) -> f32 {
        if self.sigma[i] > 0.0 { (self.mean[i] - 1.0) / self.sigma[i] } else { 0.0 }
    }

    /// The var that is farthest from 1, in sigmas; none in a ring without any.
    pub fn farthest(&self) -> Option<usize> {
        (0..self.mean.len()).max_by(|&i, &j| self.deviation(i).abs().total_cmp(&self.deviation(j).abs()))
    }
}

/// The covariance of vars from that of their logarithms: its lower triangle, row by row.
fn of_vars(mean: &[f32], of_params: &[f32]) -> Vec<f32> {
    let (mut entries, mut rest) = (Vec::with_capacity(mean.len() * (mean.len() + 1) / 2), of_params);
    for (i, own) in mean.iter().enumerate() {
        let (row, below) = rest.split_at(i + 1);
        entries.extend(row.iter().zip(mean).map(|(entry, other)| own * other * entry));
        rest = below;
    }
    entries
}

#[cfg(test)]
mod tests {
    use estimator::Walk;

    use super::*;

    #[test]
    fn the_covariance_is_symmetric_and_its_diagonal_is_sigma_squared() {
        let mut record = EstimateRecord::example(4, 2);
        record.covariance[4] = 0.5; // after (0,0) (1,0) (1,1) (2,0)
        assert_eq!([record.covariance_of(2, 1), record.covariance_of(1, 2)], [0.5, 0.5]);
        assert_eq!(record.covariance_of(3, 3), record.sigma[3] * record.sigma[3]);
    }

    #[test]
    fn what_is_no_number_or_does_not_fit_is_not_usable() {
        let is_usable = |change: fn(&mut EstimateRecord)| {
            let mut record = EstimateRecord::example(2, 1);
            change(&mut record);
            record.is_usable()
        };
        assert!(is_usable(|_| ()) && is_usable(|record| record.mismatch = None));
        assert!(!is_usable(|record| record.mismatch = Some(true)));
        assert!(!is_usable(|record| record.mean[1] = f32::NAN));
        assert!(!is_usable(|record| record.sigma[0] = 0.0));
        assert!(!is_usable(|record| record.remarks.unsolved = true));
        assert!(!is_usable(|record| record.remarks.put_aside = true));
    }

    #[test]
    fn a_record_says_what_the_core_says() {
        let ring = Ring::booster();
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/paper-vars");
        let recording = inference::Recording::read(&folder, &ring).unwrap();
        let mut core = inference::stream::estimator(&ring, &recording, Walk::NONE).unwrap();
        let mut wire = inference::stream::wire(&recording, &recording.rows[0]).unwrap();
        let estimate = core.ingest(&mut wire).unwrap();
        let record = EstimateRecord::of(&Names::of(&ring), estimate.clone(), &core.spread().covariance(), None);
        assert_eq!(record.mean, estimate.mean);
        assert_eq!((record.sequence, record.frames), (estimate.sequence, 1));
        for (i, j) in [(0, 0), (30, 7), (7, 30), (47, 47)] {
            let (of_vars, of_params) = (record.covariance_of(i, j), core.covariance(i, j));
            assert_eq!(of_vars, record.mean[i.max(j)] * record.mean[i.min(j)] * of_params, "({i}, {j})");
        }
        assert_eq!(record.monitor_sigma[32], estimate.health[32].noise);
        assert_eq!(record.readings(ReadingUse::Used), estimate.accepted.iter().filter(|used| **used).count());
        assert_eq!(record.tune_innovation, estimate.tune_innovation);
    }
}
