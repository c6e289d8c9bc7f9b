//! Outliers, after the paper's Appendix A: all pairs of a corrector's frames, less the model; a reading whose pairs stand out
//! again and again is at fault.

use serde::Serialize;
use twin::OrbitError;

use super::{Bench, StudyError};
use inference::model::ResponseModel;
use inference::readings::Campaign;
use report::{Section, Table};

/// Deviation of a pair that stands out, in standard deviations of a difference. Of 1e5 pairs of normal noise one in 1e5
/// is expected beyond 4.4; 5 leaves room for the model.
const STANDS_OUT: f64 = 5.0;

/// A reading at fault.
#[derive(Debug, Clone, PartialEq, Serialize)]
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
pub fn study(bench: &Bench) -> Result<(Section, Vec<Fault>), StudyError> {
    let faults = faults(&bench.campaign, &bench.twin)?;
    let row = |f: &Fault| {
        vec![
            f.sequence.to_string(),
            f.corrector.clone(),
            format!("{:+.0}", f.setting),
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
            "For every corrector and monitor, all differences of two frames less what the twin expects at the MAP; a reading is at fault \
             if most of its differences stand out by {STANDS_OUT:.0} standard deviations. {} readings in {} frames are at fault; the \
             core's own gate decides cycle by cycle without knowing them.",
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
pub fn faults(campaign: &Campaign, model: &ResponseModel) -> Result<Vec<Fault>, OrbitError> {
    let params: Vec<f64> =
        campaign.fit.map_params.iter().zip(campaign.supplies()).map(|(theta, s)| theta + s).collect();
    let response = model.response(&params)?;
    let monitors = campaign.ring.monitor_names();
    let mut faults = Vec::new();
    for corrector in campaign.ring.labels(campaign.ring.correctors.iter().map(|c| c.element)) {
        let own = |(_, row): &(usize, &inference::recording::Row)| row.corrector.as_ref() == Some(&corrector);
        let frames: Vec<usize> = campaign.recording.rows.iter().enumerate().filter(own).map(|(i, _)| i).collect();
        for (b, monitor) in monitors.iter().enumerate() {
            let deviation =
                |&frame: &usize| Some((frame, campaign.raw(frame, b)? - (response.row(b) * campaign.drive(frame))[0]));
            let deviations: Vec<(usize, f64)> = frames.iter().filter_map(deviation).collect();
            let limit = STANDS_OUT * 2f64.sqrt() * campaign.noise(b);
            for &(frame, here) in &deviations {
                let mut others: Vec<f64> =
                    deviations.iter().filter(|(f, _)| *f != frame).map(|(_, d)| here - d).collect();
                let out = others.iter().filter(|d| d.abs() > limit).count();
                // one difference could be the other reading's fault
                if others.len() > 1 && 2 * out > others.len() {
                    others.sort_by(f64::total_cmp);
                    let row = &campaign.recording.rows[frame];
                    faults.push(Fault {
                        sequence: row.sequence,
                        corrector: corrector.clone(),
                        setting: row.setting,
                        monitor: monitor.clone(),
                        deviation: inference::diagnostics::quantile(&others, 0.5),
                    });
                }
            }
        }
    }
    faults.sort_by_key(|f| f.sequence);
    Ok(faults)
}
