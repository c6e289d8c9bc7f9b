//! Monitors and correctors that are not ok, the worst first, and where all are ok, those closest to it.

use results::EstimateRecord;
use shared_memory::{Condition, HealthRecord, State};

/// Lines of this many columns at most.
pub(super) fn lines(
    record: &EstimateRecord,
    health: &HealthRecord,
    correctors: &[String],
    height: usize,
) -> Vec<String> {
    let of = |names: &[String], conditions: &[Condition]| -> Vec<(String, Condition)> {
        names.iter().cloned().zip(conditions.iter().copied()).collect()
    };
    let monitors = of(&record.names.monitors, &health.monitors);
    let mut all: Vec<(String, Condition)> =
        monitors.iter().cloned().chain(of(correctors, &health.correctors)).collect();
    all.retain(|(_, condition)| condition.state != State::Ok);
    all.sort_by(|(_, one), (_, other)| rank(other).total_cmp(&rank(one)));
    if all.is_empty() {
        return quiet(record, &monitors);
    }
    let count = all.len();
    let shown = if count <= height { count } else { height.saturating_sub(1) };
    let mut lines: Vec<String> = all[..shown].iter().map(|(name, condition)| tell(name, condition)).collect();
    if shown < count && height > 0 {
        lines.push(format!("and {} more not ok", count - shown));
    }
    lines
}

/// The state first, then how far it goes.
fn rank(condition: &Condition) -> f32 {
    let [scatter, jumps, missing] = condition.ratios;
    let (state, within) = match condition.state {
        State::Dead => (4.0, missing),
        State::Jumps => (3.0, jumps),
        State::Noisy => (2.0, scatter / (1.0 + scatter)),
        State::Back | State::Ok => (1.0, 0.0),
    };
    state + within.clamp(0.0, 0.99)
}

fn tell(name: &str, condition: &Condition) -> String {
    let [scatter, jumps, missing] = condition.ratios;
    let seen = match condition.state {
        State::Dead => format!("missing or without effect in {:.0} % of its frames", 100.0 * missing),
        State::Jumps => format!("{:.0} % of its frames are far off", 100.0 * jumps),
        State::Noisy => format!("scatters {scatter:.1} times as much as expected"),
        State::Back => "its fault has ended a short while ago".to_owned(),
        State::Ok => String::new(),
    };
    format!("{name:<8} {:<6} {seen}", condition.state.word())
}

/// What is said where nothing is wrong: the monitor that scatters most.
fn quiet(record: &EstimateRecord, monitors: &[(String, Condition)]) -> Vec<String> {
    let most = monitors.iter().max_by(|(_, one), (_, other)| one.ratios[0].total_cmp(&other.ratios[0]));
    let most = most.map_or(String::new(), |(name, condition)| {
        let sigma = record.names.monitors.iter().position(|there| there == name).map(|b| 1e3 * record.monitor_sigma[b]);
        let sigma = sigma.map_or(String::new(), |mm| format!(" ({mm:.2} mm)"));
        format!("; {name} scatters most, {:.2} times as much as expected{sigma}", condition.ratios[0])
    });
    vec![format!("all monitors and correctors ok{most}")]
}

#[cfg(test)]
mod tests {
    use estimator::FitQuality;

    use super::*;

    #[test]
    fn the_worst_come_first_and_what_is_cut_is_counted() {
        let condition = |state, ratios| Condition { state, ratios };
        let fit = FitQuality { chi_square: 1.0, degrees_of_freedom: 1.0 };
        let mut health = HealthRecord {
            sequence: 0,
            frames: 0,
            fit,
            monitors: vec![
                condition(State::Ok, [1.1, 0.0, 0.0]),
                condition(State::Noisy, [2.0, 0.0, 0.0]),
                condition(State::Dead, [1.0, 0.0, 0.75]),
            ],
            correctors: vec![condition(State::Jumps, [1.0, 0.2, 0.2])],
        };
        let told =
            |health: &HealthRecord, height| lines(&EstimateRecord::example(2, 3), health, &["H_A4".to_owned()], height);
        let all = [
            "M2       dead   missing or without effect in 75 % of its frames",
            "H_A4     jumps  20 % of its frames are far off",
            "M1       noisy  scatters 2.0 times as much as expected",
        ];
        assert_eq!(told(&health, 3), all);
        assert_eq!(told(&health, 2), [all[0], "and 2 more not ok"]);
        health.monitors.truncate(1);
        health.correctors.clear();
        assert_eq!(
            told(&health, 2),
            ["all monitors and correctors ok; M0 scatters most, 1.10 times as much as expected (0.15 mm)"]
        );
    }
}
