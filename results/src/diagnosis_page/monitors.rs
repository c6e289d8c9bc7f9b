//! Faulty monitors.

use diagnosis::Diagnosis;
use estimator::MonitorState;
use report::Section;

use super::table;

/// State, noise and rejected readings.
pub fn section(diagnosis: &Diagnosis) -> Section {
    let data = &diagnosis.found.data;
    let frames = data.pools.of_frame.len();
    let faulty = data.health().iter().zip(data.ring.monitor_names()).filter(|(one, _)| one.state != MonitorState::Ok);
    let rows: Vec<[String; 5]> = faulty
        .map(|(one, name)| {
            let share = 100.0 * f64::from(one.rejected) / frames.max(1) as f64;
            [
                name,
                word(one.state).into(),
                format!("{:.0}", f64::from(one.noise) * 1e6),
                format!("{:.0}", f64::from(one.weighted_as) * 1e6),
                format!("{} ({share:.1} %)", one.rejected),
            ]
        })
        .collect();
    let expected = data.mean_noise * 1e6;
    let text = match rows.len() {
        0 => format!("All monitors that are read are in state ok; expected noise of a reading {expected:.0} µm."),
        _ => format!(
            "Noise, jumps and silence are faults of a monitor and not of the model. Its readings have less weight, or none. Expected noise of a reading {expected:.0} µm."
        ),
    };
    let header = ["monitor", "state", "noise [µm]", "weighted as [µm]", "readings rejected"];
    let caption = "Monitors that are not in state ok.";
    let tables = if rows.is_empty() { Vec::new() } else { vec![table(caption, header, rows)] };
    Section { heading: "Faulty monitors".into(), text: vec![text], tables, ..Section::default() }
}

/// In one word.
pub fn word(state: MonitorState) -> &'static str {
    match state {
        MonitorState::Ok => "ok",
        MonitorState::Noisy => "noisy",
        MonitorState::Jumps => "jumps",
        MonitorState::Dead => "dead",
    }
}
