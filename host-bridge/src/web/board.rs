//! Where the loop leaves its numbers, and the server finds them.

use core::time::Duration;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use results::EstimateRecord;
use shared_memory::now_ns;

use super::metrics::Metrics;
use super::place::Place;
use super::trail::Trails;
use crate::health::HealthRecord;
use crate::history::History;
use crate::source::queue::Queue;

/// Latencies of which the median is shown.
const LATENCIES: usize = 1024;
/// Time over which the rate is taken.
const RATE_OVER: Duration = Duration::from_secs(2);

/// The last estimate that is shown.
#[derive(Debug, Clone)]
pub(super) struct Picture {
    pub record: EstimateRecord,
    pub health: HealthRecord,
    /// Reading less what the posterior expects of it [B] [m]; none where a monitor did not report.
    pub residuals: Vec<Option<f32>>,
    pub at: Instant,
    /// Frames a second.
    pub rate: Option<f64>,
}

/// The last latencies, in a ring [us].
#[derive(Debug)]
struct Latencies {
    us: Vec<u32>,
    next: usize,
}

/// Shared by loop and server.
#[derive(Debug)]
pub struct Board {
    /// Whose faults and length are shown.
    pub queue: Queue,
    /// Counted by the loop.
    pub metrics: Arc<Metrics>,
    /// Publisher's name.
    pub(super) publisher: String,
    /// Where the vars and instruments are in the ring.
    pub(super) place: Place,
    latencies: Mutex<Latencies>,
    picture: Mutex<Option<Arc<Picture>>>,
    trails: Mutex<Trails>,
    /// Frames at a time, for the rate.
    counted: Mutex<(u64, Instant, Option<f64>)>,
}

impl Board {
    /// Nothing has come yet.
    pub fn new(queue: Queue, publisher: &str, place: Place, metrics: Arc<Metrics>) -> Arc<Self> {
        Arc::new(Self {
            queue,
            metrics,
            publisher: publisher.to_owned(),
            place,
            latencies: Mutex::new(Latencies { us: Vec::with_capacity(LATENCIES), next: 0 }),
            picture: Mutex::default(),
            trails: Mutex::default(),
            counted: Mutex::new((0, Instant::now(), None)),
        })
    }

    /// Begin with rows of a history.
    pub fn remember(&self, history: &History) {
        let place = |name: &String| history.columns.vars.iter().position(|there| there == name);
        let places: Vec<Option<usize>> = self.place.vars().map(place).collect();
        let mut trails = self.trails();
        history.rows.iter().for_each(|row| trails.remember(row, &places));
    }

    /// An estimate was published so long after its frame came.
    pub fn count(&self, record: &EstimateRecord, latency: Duration) {
        self.metrics.count(record, latency);
        let mut latencies = lock(&self.latencies);
        let (us, at) = (latency.as_micros().min(u32::MAX.into()) as u32, latencies.next);
        if latencies.us.len() < LATENCIES {
            latencies.us.push(us);
        } else {
            latencies.us[at] = us;
        }
        latencies.next = (at + 1) % LATENCIES;
    }

    /// Show an estimate, and how the readings [B] [m] of its frame lie about what was expected of them.
    pub fn show(&self, record: &EstimateRecord, health: &HealthRecord, readings: &[Option<f32>], fitted: &[f32]) {
        self.metrics.show(record, health);
        let residuals = readings.iter().zip(fitted).map(|(reading, fitted)| reading.map(|reading| reading - fitted));
        let (record, health) = (record.clone(), health.clone());
        self.trails().add(now_ns() / 1_000_000, &record, &health);
        let picture = Picture { residuals: residuals.collect(), at: Instant::now(), rate: self.rate(), record, health };
        *lock(&self.picture) = Some(Arc::new(picture));
    }

    /// Frames a second, over a while.
    fn rate(&self) -> Option<f64> {
        let frames = self.metrics.frames();
        let mut counted = lock(&self.counted);
        let (before, since, rate) = *counted;
        let seconds = since.elapsed();
        if seconds < RATE_OVER {
            return rate;
        }
        let rate = Some(frames.saturating_sub(before) as f64 / seconds.as_secs_f64());
        *counted = (frames, Instant::now(), rate);
        rate
    }

    pub(super) fn picture(&self) -> Option<Arc<Picture>> {
        lock(&self.picture).clone()
    }

    pub(super) fn trails(&self) -> MutexGuard<'_, Trails> {
        lock(&self.trails)
    }

    /// Median and 99th percentile of the last latencies [us]; none without any.
    pub(super) fn latency_us(&self) -> Option<[u32; 2]> {
        let mut us = lock(&self.latencies).us.clone();
        us.sort_unstable();
        let at = |share: f64| us.get((share * us.len() as f64) as usize).copied();
        Some([at(0.5)?, at(0.99)?])
    }
}

/// A thread that died left whole numbers.
fn lock<T>(of: &Mutex<T>) -> MutexGuard<'_, T> {
    of.lock().unwrap_or_else(PoisonError::into_inner)
}
