//! What a process that watches channels has to know, so that it gathers their values into frames for the daemon.

use serde::Serialize;

use crate::plan::Plan;

/// The channels of a machine cycle; field names are those of the line of JSON that the process is told, see `docs/control-system.md`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Gathering {
    cycle: String,
    /// Waveforms of monitors.
    monitors: Vec<Slots>,
    /// Monitors of the machine.
    count: usize,
    /// Read-backs, in the order of the machine.
    corrector: Vec<String>,
    supply: Vec<String>,
    dipole: Option<String>,
    rf: Option<Frequency>,
    tune: Option<[String; 2]>,
    cycle_time_us: u64,
    match_window_s: f64,
    /// How long a cycle waits for what is missing.
    late_s: f64,
}

/// Which monitor of the machine each number of a waveform belongs to.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Slots {
    channel: String,
    slots: Vec<usize>,
}

/// A frequency that counts relative to its nominal value.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[allow(non_snake_case)] // the unit
struct Frequency {
    channel: String,
    nominal_Hz: f64,
}

impl Gathering {
    /// By the channels of a plan; values that come up to so much later than their cycle's counter count [s].
    pub fn of(plan: &Plan, late: f64) -> Self {
        let channels = &plan.channels;
        let slots =
            |waveform: &crate::Waveform| Slots { channel: waveform.name.clone(), slots: waveform.monitors.clone() };
        let frequency =
            |([_, read], nominal): (&[String; 2], f64)| Frequency { channel: read.clone(), nominal_Hz: nominal };
        Self {
            cycle: channels.cycle.clone(),
            monitors: channels.monitors.iter().map(slots).collect(),
            count: plan.header.noise.len(),
            corrector: channels.corrector_read.clone(),
            supply: channels.supply_read.clone(),
            dipole: channels.dipole_read.clone(),
            rf: channels.rf.as_ref().zip(plan.rf_nominal).map(frequency),
            tune: channels.tunes.clone(),
            cycle_time_us: (plan.cycle_time * 1e6).round() as u64,
            match_window_s: plan.match_window,
            late_s: late,
        }
    }

    /// As a line of JSON.
    ///
    /// # Panics
    /// Never: it has no maps.
    pub fn line(&self) -> String {
        serde_json::to_string(self).expect("structs of numbers and text") + "\n"
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use twin::Ring;

    use super::*;

    #[test]
    fn the_line_names_every_channel_of_the_plan() {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/measure-booster.toml");
        let plan = Plan::read(&file, &Ring::booster()).unwrap();
        let line: serde_json::Value = serde_json::from_str(&Gathering::of(&plan, 0.2).line()).unwrap();
        assert_eq!(line["cycle"], "BOOSTER:CYCLE");
        assert_eq!(line["monitors"][1]["channel"], "BOOSTER:BPM:Y");
        assert_eq!(line["monitors"][1]["slots"][0], 15);
        assert_eq!(
            (line["corrector"][1].as_str(), line["corrector"].as_array().unwrap().len()),
            (Some("BOOSTER:A4:READ"), 48)
        );
        assert_eq!(line["rf"], serde_json::json!({"channel": "BOOSTER:RF:READ", "nominal_Hz": 1.3768e6}));
        assert_eq!((line["count"].as_u64(), line["cycle_time_us"].as_u64()), (Some(33), Some(92_000)));
    }
}
