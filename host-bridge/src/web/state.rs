//! The numbers of the page as JSON.

use results::ReadingUse;
use serde_json::{Value, json};
use shared_memory::now_ns;

use super::board::Board;
use crate::health::{Condition, State};

/// What does not change while the daemon runs.
pub(super) fn ring(board: &Board) -> String {
    json!({"place": board.place, "publisher": board.publisher}).to_string()
}

/// What changes with each estimate.
pub(super) fn now(board: &Board) -> String {
    let faults = board.queue.faults();
    let base = json!({
        "age_s": board.metrics.age(),
        "queue": board.queue.len(),
        "frames_taken": board.metrics.frames(),
        "latency_us": board.latency_us(),
        "faults": faults,
        "history_rows_lost": board.metrics.history_lost(),
    });
    let Some(picture) = board.picture() else { return base.to_string() };
    let (record, health) = (&picture.record, &picture.health);
    let vars = record.mean.iter().zip(&record.sigma).map(|(mean, sigma)| json!([finite(*mean), finite(*sigma)]));
    let monitors = (0..record.reading.len()).map(|b| {
        let condition = health.monitors.get(b);
        json!({
            "state": condition.map_or(State::Ok, |condition| condition.state).word(),
            "residual_mm": picture.residuals.get(b).copied().flatten().map(|metres| finite(1e3 * metres)),
            "noise_mm": finite(1e3 * record.monitor_sigma[b]),
            "use": match record.reading[b] {
                ReadingUse::Absent => "not reported",
                ReadingUse::Used => "used",
                ReadingUse::Rejected => "outside the gate",
            },
            "rejected": record.monitor_rejected[b],
            "ratios": condition.map(ratios),
        })
    });
    let correctors =
        health.correctors.iter().map(|condition| json!({"state": condition.state.word(), "ratios": ratios(condition)}));
    let estimate = json!({
        "sequence": record.sequence,
        "frames": record.frames,
        "refused": record.rejected_frames,
        "put_aside": record.remarked.put_aside_frames,
        "shown_s_ago": picture.at.elapsed().as_secs_f64(),
        "rate_hz": picture.rate,
        "usable": record.is_usable(),
        "mismatch": record.mismatch,
        "chi_square": finite(health.fit.chi_square),
        "degrees_of_freedom": finite(health.fit.degrees_of_freedom),
        "excess": finite(health.fit.excess()),
        "nis_per_reading": record.nis_per_reading().map(finite),
        "remarks": record.words().collect::<Vec<_>>(),
        "tables": record.tables.map(|tables| format!("{tables:08x}")),
        "vars": vars.collect::<Vec<_>>(),
        "monitors": monitors.collect::<Vec<_>>(),
        "correctors": correctors.collect::<Vec<_>>(),
    });
    let (Value::Object(mut all), Value::Object(estimate)) = (base, estimate) else { return String::new() };
    all.extend(estimate);
    Value::Object(all).to_string()
}

/// A var over a span, as `span=hour&var=D8` asks; none if there is no such span or var.
pub(super) fn trail(board: &Board, query: &str) -> Option<String> {
    let asked = |key: &str| query.split('&').find_map(|pair| pair.strip_prefix(key)?.strip_prefix('='));
    let (span, var) = (asked("span")?, board.place.var(&plain(asked("var")?))?);
    let trails = board.trails();
    let points = trails.of(span, now_ns() / 1_000_000)?;
    let point = |point: &super::trail::Point| {
        let [mean, sigma] = point.vars.get(var).copied().unwrap_or([f32::NAN; 2]);
        json!([point.time_ms, finite(mean), finite(sigma), finite(point.chi_square), point.mismatch])
    };
    Some(json!({"points": points.map(point).collect::<Vec<_>>()}).to_string())
}

fn ratios(condition: &Condition) -> [Value; 3] {
    condition.ratios.map(finite)
}

/// To six decimals, a nanometre or a millionth of a var; JSON has no infinite numbers.
fn finite(number: f32) -> Value {
    if number.is_finite() { json!((1e6 * f64::from(number)).round() / 1e6) } else { Value::Null }
}

/// A value of a query without its percent signs.
fn plain(text: &str) -> String {
    let mut bytes = Vec::with_capacity(text.len());
    let mut rest = text.as_bytes();
    while let Some((first, after)) = rest.split_first() {
        let code = after.get(..2).and_then(|hex| u8::from_str_radix(core::str::from_utf8(hex).ok()?, 16).ok());
        match (first, code) {
            (b'%', Some(code)) => (bytes, rest) = ([bytes, vec![code]].concat(), &after[2..]),
            _ => {
                bytes.push(*first);
                rest = after;
            }
        }
    }
    String::from_utf8_lossy(&bytes).into_owned()
}
