//! Counts and gauges for Prometheus.

use core::sync::atomic::{AtomicU64, Ordering};
use core::time::Duration;

use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use prometheus_client::registry::{Registry, Unit};
use results::EstimateRecord;
use shared_memory::now_ns;

use crate::health::{Condition, HealthRecord, State};
use crate::history;
use crate::source::queue::Queue;

type Number = Gauge<f64, AtomicU64>;
/// Instruments by their state.
type ByState = Family<[(&'static str, &'static str); 1], Gauge>;

/// All that is counted.
#[derive(Debug)]
pub struct Metrics {
    registry: Registry,
    frames: Counter,
    mismatches: Counter,
    latency: Histogram,
    /// What the queue has counted, in the order of [`Metrics::text`].
    faults: [Counter; 5],
    history_lost: Counter,
    waiting: Gauge,
    sequence: Gauge,
    usable: Gauge,
    mismatch: Gauge,
    chi_square: Number,
    degrees_of_freedom: Number,
    age: Number,
    monitors: ByState,
    correctors: ByState,
    /// When the last estimate was published [ns since 1970].
    published_ns: AtomicU64,
}

impl Default for Metrics {
    fn default() -> Self {
        let mut registry = Registry::with_prefix("orbitcal");
        // 10 us to 0.3 s
        let latency = Histogram::new(exponential_buckets(1e-5, 2.0, 16));
        let [frames, mismatches, history_lost] = [(); 3].map(|()| Counter::default());
        let faults = [(); 5].map(|()| Counter::default());
        let [waiting, sequence, usable, mismatch] = [(); 4].map(|()| Gauge::default());
        let [chi_square, degrees_of_freedom, age] = [(); 3].map(|()| Number::default());
        let [monitors, correctors] = [(); 2].map(|()| ByState::default());
        registry.register("frames", "Frames taken by the core, each published as an estimate", frames.clone());
        registry.register("mismatches", "Estimates published while readings and model disagreed", mismatches.clone());
        registry.register_with_unit(
            "latency",
            "From a frame's arrival to its estimate's publication",
            Unit::Seconds,
            latency.clone(),
        );
        let [dropped, damaged, refused, disconnected, unsaved] = faults.clone();
        registry.register("frames_dropped", "Frames dropped from a full buffer", dropped);
        registry.register("packets_damaged", "Packets that were damaged, cut off or too long", damaged);
        registry.register("frames_refused", "Frames that the core refused", refused);
        registry.register("connections_lost", "Connections to the front end that were lost", disconnected);
        registry.register("checkpoints_failed", "Checkpoints that were not saved", unsaved);
        registry.register("history_rows_lost", "Rows of the history that were not written", history_lost.clone());
        registry.register("frames_waiting", "Frames that wait for the core", waiting.clone());
        registry.register("sequence", "Number of the last frame", sequence.clone());
        registry.register("usable", "1 if the last estimate may be acted on", usable.clone());
        registry.register("mismatch", "1 if readings and model disagree", mismatch.clone());
        registry.register("chi_square", "Chi-square of the readings of good monitors so far", chi_square.clone());
        registry.register("degrees_of_freedom", "Degrees of freedom of that chi-square", degrees_of_freedom.clone());
        registry.register_with_unit("estimate_age", "Age of the last estimate", Unit::Seconds, age.clone());
        registry.register("monitors", "Monitors by state", monitors.clone());
        registry.register("correctors", "Correctors by state", correctors.clone());
        let published_ns = AtomicU64::new(0);
        Self {
            registry,
            frames,
            mismatches,
            latency,
            faults,
            history_lost,
            waiting,
            sequence,
            usable,
            mismatch,
            chi_square,
            degrees_of_freedom,
            age,
            monitors,
            correctors,
            published_ns,
        }
    }
}

impl history::Lost for Metrics {
    fn count(&self) {
        self.history_lost.inc();
    }
}

impl Metrics {
    /// An estimate was published so long after its frame came.
    pub fn count(&self, record: &EstimateRecord, latency: Duration) {
        self.frames.inc();
        self.mismatches.inc_by(u64::from(record.mismatch == Some(true)));
        self.latency.observe(latency.as_secs_f64());
        self.published_ns.store(now_ns(), Ordering::Relaxed);
    }

    /// Gauges of an estimate.
    pub fn show(&self, record: &EstimateRecord, health: &HealthRecord) {
        self.sequence.set(record.sequence.into());
        self.usable.set(record.is_usable().into());
        self.mismatch.set((record.mismatch == Some(true)).into());
        self.chi_square.set(health.fit.chi_square.into());
        self.degrees_of_freedom.set(health.fit.degrees_of_freedom.into());
        for (family, conditions) in [(&self.monitors, &health.monitors), (&self.correctors, &health.correctors)] {
            for state in State::ALL {
                let is_so = |condition: &&Condition| condition.state == state;
                let count = conditions.iter().filter(is_so).count();
                family.get_or_create(&[("state", state.word())]).set(count as i64);
            }
        }
    }

    /// Frames so far.
    pub fn frames(&self) -> u64 {
        self.frames.get()
    }

    /// Rows of the history that were not written.
    pub fn history_lost(&self) -> u64 {
        self.history_lost.get()
    }

    /// Age of the last estimate [s]; none without any.
    pub fn age(&self) -> Option<f64> {
        let published = self.published_ns.load(Ordering::Relaxed);
        (published > 0).then(|| now_ns().saturating_sub(published) as f64 * 1e-9)
    }

    /// All of it, in the text format of OpenMetrics.
    pub fn text(&self, queue: &Queue) -> String {
        let faults = queue.faults();
        let counts = [faults.dropped, faults.damaged, faults.refused, faults.disconnected, faults.unsaved];
        self.faults.iter().zip(counts).for_each(|(counter, count)| counter.inner().store(count, Ordering::Relaxed));
        self.waiting.set(queue.len() as i64);
        self.age.set(self.age().unwrap_or(f64::NAN));
        let mut text = String::new();
        encode(&mut text, &self.registry).expect("a string takes any text");
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::source::queue::Faults;
    use estimator::FitQuality;

    #[test]
    fn what_was_counted_is_told() {
        let metrics = Metrics::default();
        let queue = Queue::new(1, Faults { dropped: 7, ..Faults::default() });
        queue.push(vec![0]);
        metrics.count(
            &EstimateRecord { mismatch: Some(true), ..EstimateRecord::example(2, 3) },
            Duration::from_micros(70),
        );
        metrics.count(&EstimateRecord::example(2, 3), Duration::from_millis(2));
        let condition = |state| Condition { state, ratios: [0.0; 3] };
        let fit = FitQuality { chi_square: 12.5, degrees_of_freedom: 10.0 };
        let monitors = [State::Ok, State::Ok, State::Dead].map(condition).to_vec();
        let health = HealthRecord { sequence: 9, frames: 2, fit, monitors, correctors: vec![] };
        metrics.show(&EstimateRecord { sequence: 9, ..EstimateRecord::example(2, 3) }, &health);
        let text = metrics.text(&queue);
        for line in [
            "orbitcal_frames_total 2",
            "orbitcal_mismatches_total 1",
            "orbitcal_frames_dropped_total 7",
            "orbitcal_frames_waiting 1",
            "orbitcal_sequence 9",
            "orbitcal_chi_square 12.5",
            "orbitcal_monitors{state=\"ok\"} 2",
            "orbitcal_monitors{state=\"dead\"} 1",
            "orbitcal_latency_seconds_count 2",
            "orbitcal_usable 1",
        ] {
            assert!(text.lines().any(|there| there == line), "{line} in\n{text}");
        }
        assert!(text.contains("orbitcal_estimate_age_seconds "), "{text}");
        let counts =
            text.lines().filter_map(|line| line.strip_prefix("orbitcal_latency_seconds_bucket")?.split(' ').nth(1));
        // 70 us are in the fourth bucket, 2 ms in the ninth
        assert_eq!(counts.collect::<String>(), "0001111122222222".to_owned() + "2");
    }
}
