//! The state of monitors in a result.

use std::collections::BTreeMap;

use estimator::{Health, MonitorState};
use inference::Excluded;
use schemars::JsonSchema;
use serde::Serialize;
use twin::Ring;

use crate::record::EstimateRecord;

/// State of one monitor.
#[derive(Debug, Clone, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct Monitor {
    pub name: String,
    pub state: &'static str,
    pub sigma_mm: f64,
    pub rejected: u32,
    /// Readings that do not count, by reason; without those of a stream, whose readings are judged one by one.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub excluded: BTreeMap<&'static str, usize>,
}

/// State of the monitors of a ring, with the number of readings that each leaves out for each reason.
pub fn monitors(ring: &Ring, health: &[Health], excluded: &[BTreeMap<Excluded, usize>]) -> Vec<Monitor> {
    let monitor = |((name, health), excluded): ((String, &Health), &BTreeMap<Excluded, usize>)| Monitor {
        name,
        state: state_word(health.state),
        sigma_mm: f64::from(health.noise) * 1e3,
        rejected: health.rejected,
        excluded: excluded.iter().map(|(reason, count)| (reason.word(), *count)).collect(),
    };
    ring.monitor_names().into_iter().zip(health).zip(excluded).map(monitor).collect()
}

/// The word for a state in tables and JSON.
pub fn state_word(state: MonitorState) -> &'static str {
    match state {
        MonitorState::Ok => "ok",
        MonitorState::Noisy => "noisy",
        MonitorState::Jumps => "jumps",
        MonitorState::Dead => "dead",
    }
}

/// The monitors that are not ok, in words.
pub fn faults(monitors: &[Monitor]) -> String {
    let fault =
        |m: &Monitor| format!("{} {} ({:.2} mm, {} readings rejected)", m.name, m.state, m.sigma_mm, m.rejected);
    let faults: Vec<String> = monitors.iter().filter(|m| m.state != state_word(MonitorState::Ok)).map(fault).collect();
    if faults.is_empty() { "all ok".into() } else { faults.join("; ") }
}

impl EstimateRecord {
    /// State of its monitors.
    pub(super) fn monitors(&self) -> Vec<Monitor> {
        let monitor = |b: usize| Monitor {
            name: self.names.monitors[b].clone(),
            state: state_word(self.monitor_state[b]),
            sigma_mm: f64::from(self.monitor_sigma[b]) * 1e3,
            rejected: self.monitor_rejected[b],
            excluded: BTreeMap::new(),
        };
        (0..self.reading.len()).map(monitor).collect()
    }
}
