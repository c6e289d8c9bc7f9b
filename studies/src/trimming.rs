//! Outliers, after Appendix A of the published analysis: all pairs of a corrector's frames, less the model; a reading whose pairs stand out
//! again and again is at fault.

use inference::quantile;
use inference::recording::Row;
use inference::{Reduced, ResponseModel};
use report::{Section, Table};
use schemars::JsonSchema;
use serde::Serialize;
use twin::OrbitError;

use super::StudyError;
use super::sampling::Sampling;

/// Deviation of a pair that stands out, in standard deviations of a difference. Of 1e5 pairs of normal noise one in 1e5
/// is expected beyond 4.4; 5 leaves room for the model.
const STANDS_OUT: f64 = 5.0;

/// A reading at fault.
#[derive(Debug, Clone, PartialEq, Serialize, JsonSchema)]
pub struct Fault {
    /// Frame.
    pub sequence: u32,
    /// Corrector that was set.
    pub corrector: String,
    /// Setting [A].
    pub setting: f64,
    /// Monitor.
    pub monitor: String,
    /// Deviation from the other repeats [m].
    pub deviation: f64,
}

/// List the readings at fault.
pub fn study(sampling: &Sampling) -> Result<(Section, Vec<Fault>), StudyError> {
    let faults = faults(&sampling.reduced, &sampling.twin)?;
    let row = |f: &Fault| {
        vec![
            f.sequence.to_string(),
            f.corrector.clone(),
            format!("{:+}", f.setting),
            f.monitor.clone(),
            format!("{:+.2}", 1e3 * f.deviation),
        ]
    };
    let mut frames: Vec<u32> = faults.iter().map(|f| f.sequence).collect();
    frames.dedup();
    let header = ["frame", "corrector", "setting [A]", "monitor", "deviation [mm]"];
    let section = Section {
        heading: "Outliers".into(),
        text: vec![format!(
            "For every corrector and monitor, all differences of two frames less what the twin predicts at the MAP; a reading is at fault \
             if most of its differences stand out by {STANDS_OUT:.0} standard deviations. {} readings in {} frames are at fault; the \
             core's own gate decides cycle by cycle, independently of them.",
            faults.len(),
            frames.len()
        )],
        tables: vec![Table {
            caption: "Readings at fault.".into(),
            header: header.map(str::to_owned).to_vec(),
            rows: faults.iter().map(row).collect(),
        }],
        ..Section::default()
    };
    Ok((section, faults))
}

/// Readings whose differences to the corrector's other frames stand out.
///
/// # Errors
/// [`OrbitError`] if the ring at the MAP is not stable.
pub fn faults(reduced: &Reduced, model: &ResponseModel) -> Result<Vec<Fault>, OrbitError> {
    let campaign = &reduced.campaign;
    let response = model.predict(&reduced.strength(&reduced.fit.map_params))?.response;
    let (rows, monitors) = (&campaign.recording.rows, campaign.ring.monitor_names());
    let mut faults = Vec::new();
    for (c, corrector) in campaign.ring.corrector_names().into_iter().enumerate() {
        let own = |row: &Row| row.correctors.iter().any(|(set, _)| *set == c);
        let frames: Vec<usize> = rows.iter().enumerate().filter(|(_, row)| own(row)).map(|(i, _)| i).collect();
        for (b, monitor) in monitors.iter().enumerate() {
            let deviation =
                |&frame: &usize| Some((frame, reduced.raw(frame, b)? - (response.row(b) * reduced.drive(frame))[0]));
            let deviations: Vec<(usize, f64)> = frames.iter().filter_map(deviation).collect();
            let limit = STANDS_OUT * 2f64.sqrt() * reduced.noise(b);
            for &(frame, here) in &deviations {
                let mut others: Vec<f64> =
                    deviations.iter().filter(|(f, _)| *f != frame).map(|(_, d)| here - d).collect();
                let out = others.iter().filter(|d| d.abs() > limit).count();
                // one difference could be the other reading's fault
                if others.len() > 1 && 2 * out > others.len() {
                    others.sort_by(f64::total_cmp);
                    faults.push(Fault {
                        sequence: rows[frame].sequence,
                        corrector: corrector.clone(),
                        setting: rows[frame].setting(c).unwrap_or(0.0),
                        monitor: monitor.clone(),
                        deviation: quantile(&others, 0.5),
                    });
                }
            }
        }
    }
    faults.sort_by_key(|f| f.sequence);
    Ok(faults)
}
