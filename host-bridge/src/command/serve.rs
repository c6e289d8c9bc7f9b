//! `orbitcal serve`: a device's estimates into shared memory, as `replay` publishes those of the core in process.

use core::fmt::Display;

use estimator::{FitQuality, Setup};
use firmware_sim::link::Request;
use inference::{Recording, stream};
use twin::Ring;

use super::replay::{Clock, quantiles};
use super::{CommandError, machine, progress, recording, tables};
use crate::answer::{Answer, Timing};
use crate::cli::{CoreModel, Serve};
use crate::link::{Heard, Line, Link, LinkError};
use crate::output;
use crate::publish::Publisher;
use crate::record::EstimateRecord;
use crate::trace::Trace;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Serve) -> Result<(), CommandError> {
    if options.common.json.is_some() && options.feed.is_none() {
        return Err(CommandError::Input(
            "--json needs --feed: the answer is that to a recording; --trace takes each estimate".into(),
        ));
    }
    let ring = machine(options.common.machine.as_deref())?;
    let mut link = Link::open(&options.source).map_err(|e| CommandError::Other(e.to_string()))?;
    let Some(path) = &options.feed else { return listen(options, &ring, &mut link) };
    let recording = recording(path, &ring)?;
    let answer = feed(options, &ring, &recording, &mut link)?;
    if let Some(path) = &options.common.json {
        output::json(path, &answer)?;
    }
    if !options.common.quiet && options.common.json.as_deref() != Some("-".as_ref()) {
        answer.print();
    }
    Ok(())
}

fn other(error: impl Display) -> CommandError {
    CommandError::Other(error.to_string())
}

/// Where estimates go.
struct Sinks {
    publisher: Publisher,
    trace: Option<Trace>,
}

impl Sinks {
    fn open(options: &Serve, ring: &Ring) -> Result<Self, CommandError> {
        let publisher = Publisher::try_new(&options.service).map_err(other)?;
        let trace = options.trace.as_ref().map(|path| Trace::create(path, &ring.var_names()));
        Ok(Self { publisher, trace: trace.transpose().map_err(other)? })
    }

    fn add(&mut self, heard: &Heard) -> Result<(), CommandError> {
        let record = EstimateRecord::of(&heard.estimate, |i, j| heard.covariance(i, j));
        self.publisher.publish(&record).map_err(other)?;
        self.trace.as_mut().map_or(Ok(()), |trace| trace.add(&record)).map_err(other)
    }

    fn close(self) -> Result<(), CommandError> {
        self.trace.map_or(Ok(()), Trace::finish).map_err(other)
    }
}

/// Publish what the device says to frames that somebody else sends it, until it or a signal ends that. The trace keeps what
/// came until then, whatever the end.
fn listen(options: &Serve, ring: &Ring, link: &mut Link<Box<dyn Line>>) -> Result<(), CommandError> {
    let mut sinks = Sinks::open(options, ring)?;
    let ended = pass_on(options.count.unwrap_or(u64::MAX), link, &mut sinks);
    let closed = sinks.close();
    ended.and(closed)
}

/// Pass estimates on, this many at most.
fn pass_on(wanted: u64, link: &mut Link<Box<dyn Line>>, sinks: &mut Sinks) -> Result<(), CommandError> {
    let mut count = 0;
    link.send(&Request::Covariance).map_err(other)?;
    while count < wanted && !sinks.publisher.is_stop_requested() {
        match link.listen() {
            Ok(heard) => {
                sinks.add(&heard)?;
                count += 1;
            }
            Err(LinkError::Silent { .. }) => continue,
            // a packet that is refused is its sender's concern, and was counted; a damaged reply is one lost
            Err(error @ (LinkError::Refused { .. } | LinkError::Reply(_))) => eprintln!("orbitcal: {error}"),
            Err(error) => return Err(other(error)),
        }
        // each time anew: the last request may have been damaged, or the device reset. A second one changes nothing
        link.send(&Request::Covariance).map_err(other)?;
    }
    Ok(())
}

/// Send a recording through the device, one frame after the other.
fn feed(
    options: &Serve,
    ring: &Ring,
    recording: &Recording,
    link: &mut Link<Box<dyn Line>>,
) -> Result<Answer, CommandError> {
    let setup = stream::setup(recording, options.process_noise)?;
    let CoreModel::Green = options.model;
    let tables = tables(ring, options.model_file.as_deref())?;
    link.restart(&setup).map_err(other)?;
    if options.load {
        // restarted already: there are no frames of somebody before us that they would have to describe
        let bar = progress(tables.parcels().count(), "tables", options.common.quiet);
        link.load(&tables, || bar.inc(1)).map_err(other)?;
        bar.finish_and_clear();
        link.restart(&setup).map_err(other)?;
    }
    expect_tables(link, tables.digest())?;
    let mut sinks = Sinks::open(options, ring)?;
    let bar = progress(recording.rows.len(), "frames", options.common.quiet);
    let fed = replay(link, recording, Clock::new(options.rate), |heard| {
        bar.inc(1);
        sinks.add(heard)
    })?;
    bar.finish_and_clear();
    sinks.close()?;
    Ok(fed.answer(ring, recording, &setup))
}

/// A device answers by the tables that it has, whatever ring they are of.
fn expect_tables<L: Line>(link: &mut Link<L>, expected: u32) -> Result<(), CommandError> {
    let got = link.status().map_err(other)?.tables;
    let wrong = || format!("the device goes by tables {got:08x}, this model has {expected:08x}; --load sends them");
    if got == expected { Ok(()) } else { Err(other(wrong())) }
}

/// What a device said at the end of a recording.
pub struct Fed {
    /// Its last estimate.
    pub last: Heard,
    /// How well it says that its model describes all frames.
    pub quality: FitQuality,
    /// Time from frame to estimate, over the line.
    pub timing: Timing,
}

impl Fed {
    /// The same answer as `replay` gives.
    pub fn answer(&self, ring: &Ring, recording: &Recording, setup: &Setup) -> Answer {
        let covariance = |i, j| self.last.covariance(i, j);
        Answer::of_core(ring, recording, setup, &self.last.estimate, covariance, self.quality, self.timing)
    }
}

/// Send every frame of a recording to a device that was restarted; `hear` gets each answer.
///
/// # Errors
/// [`CommandError`].
pub fn replay<L: Line>(
    link: &mut Link<L>,
    recording: &Recording,
    mut clock: Clock,
    mut hear: impl FnMut(&Heard) -> Result<(), CommandError>,
) -> Result<Fed, CommandError> {
    let (mut last, mut times) = (None, Vec::with_capacity(recording.rows.len()));
    for row in &recording.rows {
        let wire = stream::wire(recording, row)?;
        clock.wait();
        let start = std::time::Instant::now();
        let heard = link.ingest(&wire).map_err(|e| other(format!("frame {}: {e}", row.sequence)))?;
        times.push(start.elapsed());
        hear(&heard)?;
        last = Some(heard);
    }
    let last = last.ok_or_else(|| CommandError::Input(format!("{}: no frames", recording.name)))?;
    let status = link.status().map_err(other)?;
    let quality = FitQuality { chi_square: status.chi_square, degrees_of_freedom: status.degrees_of_freedom };
    Ok(Fed { last, quality, timing: quantiles(times) })
}
