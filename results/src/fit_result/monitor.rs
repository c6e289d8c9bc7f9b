//! The state of monitors in a result.

use estimator::{Health, MonitorState};
use serde::Serialize;
use twin::Ring;

use crate::record::EstimateRecord;

/// State of one monitor.
#[derive(Debug, Clone, Serialize)]
#[allow(missing_docs)] // named after what they are
pub struct Monitor {
    pub name: String,
    pub state: &'static str,
    pub sigma_mm: f64,
    pub rejected: u32,
}

/// State of the monitors of a ring.
pub fn monitors(ring: &Ring, health: &[Health]) -> Vec<Monitor> {
    let monitor = |(name, health): (String, &Health)| Monitor {
        name,
        state: state_word(health.state),
        sigma_mm: f64::from(health.noise) * 1e3,
        rejected: health.rejected,
    };
    ring.monitor_names().into_iter().zip(health).map(monitor).collect()
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
        };
        (0..self.reading.len()).map(monitor).collect()
    }
}
