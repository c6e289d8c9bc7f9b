//! `orbitcal replay`: recording to wire bytes to core to shared memory, frame by frame.

use core::time::Duration;
use std::time::Instant;

use inference::Recording;
use inference::stream::{self, BoosterEstimate, Core};
use twin::Ring;

use super::{CommandError, machine, progress, recording, tables};
use crate::answer::{Answer, Timing};
use crate::cli::{Rate, Replay};
use crate::output;
use crate::publish::Publisher;
use crate::record::EstimateRecord;
use crate::trace::Trace;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Replay) -> Result<(), CommandError> {
    let ring = machine(options.common.machine.as_deref())?;
    let recording = recording(&options.recording, &ring)?;
    let tables = tables(&ring, options.model_file.as_deref())?;
    let mut core = Core::with_tables(tables, stream::setup(&recording, options.process_noise)?)?;
    let (last, timing) = pump(options, &ring, &recording, &mut core)?;
    let quality = core.fit_quality();
    let answer = Answer::of_core(&ring, &recording, &core.setup, &last, |i, j| core.covariance(i, j), quality, timing);
    if let Some(path) = &options.common.json {
        output::json(path, &answer)?;
    }
    if !options.common.quiet && options.common.json.as_deref() != Some("-".as_ref()) {
        answer.print();
    }
    Ok(())
}

/// Pump every frame through the core into the sinks.
fn pump(
    options: &Replay,
    ring: &Ring,
    recording: &Recording,
    core: &mut Core,
) -> Result<(BoosterEstimate, Timing), CommandError> {
    let other = |error: &dyn core::fmt::Display| CommandError::Other(error.to_string());
    let mut publisher = Publisher::try_new(&options.service).map_err(|e| other(&e))?;
    let trace = options.trace.as_ref().map(|path| Trace::create(path, &ring.var_names())).transpose();
    let mut trace = trace.map_err(|e| other(&e))?;
    let bar = progress(recording.rows.len(), "frames", options.common.quiet);
    let mut clock = Clock::new(options.rate);
    let (mut last, mut times) = (None, Vec::with_capacity(recording.rows.len()));
    for row in &recording.rows {
        let mut bytes = stream::wire(recording, row)?;
        core.prepare();
        clock.wait();
        let start = Instant::now();
        let estimate = core.ingest(&mut bytes).map_err(|e| other(&format!("frame {}: {e}", row.sequence)))?;
        times.push(start.elapsed());
        let record = EstimateRecord::of(&estimate, |i, j| core.covariance(i, j));
        publisher.publish(&record).map_err(|e| other(&e))?;
        if let Some(trace) = &mut trace {
            trace.add(&record).map_err(|e| other(&e))?;
        }
        last = Some(estimate);
        bar.inc(1);
    }
    bar.finish_and_clear();
    if let Some(trace) = trace {
        trace.finish().map_err(|e| other(&e))?;
    }
    let last = last.ok_or_else(|| CommandError::Input(format!("{}: no frames", recording.name)))?;
    Ok((last, quantiles(times)))
}

/// Releases frames at a fixed rate, without drift.
pub struct Clock {
    start: Instant,
    period: Option<Duration>,
    ticks: u32,
}

impl Clock {
    /// Begin now.
    pub fn new(rate: Rate) -> Self {
        let period = match rate {
            Rate::Max => None,
            Rate::Hertz(hertz) => Some(Duration::from_secs_f64(1.0 / hertz)),
        };
        Self { start: Instant::now(), period, ticks: 0 }
    }

    /// Wait for the next release.
    pub fn wait(&mut self) {
        let Some(period) = self.period else { return };
        let due = self.start + period * self.ticks;
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        self.ticks += 1;
    }
}

/// Median, 99th percentile and largest.
pub(super) fn quantiles(mut times: Vec<Duration>) -> Timing {
    times.sort_unstable();
    let at = |p: f64| {
        let index = (p * times.len() as f64) as usize;
        times.get(index.min(times.len().saturating_sub(1))).map_or(0.0, |t| t.as_secs_f64() * 1e6)
    };
    Timing { update_us_p50: at(0.5), update_us_p99: at(0.99), update_us_max: at(1.0) }
}
