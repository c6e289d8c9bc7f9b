//! `orbitcal serve`: the daemon of a configuration, or a device's estimates into shared memory, as `replay` publishes those of the
//! core in process.

use estimator::Tables as _;
use host_bridge::serve::serve;
use host_bridge::service;
use host_bridge::source::Clock;
use host_bridge::source::address::Address;
use host_bridge::source::device::{Fed, Overheard};
use host_bridge::source::link::{Line, Link};
use host_bridge::stop::Stop;
use inference::{Recording, stream};
use results::{FitResult, Names};
use training::{LINE, Tables};
use twin::Ring;

use super::{
    CommandError, check_outputs, deliver, machine, machine_for, progress, recording, sinks, stream_all, tables,
    warn_if_not_modelled,
};
use crate::cli::Serve;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Serve) -> Result<(), CommandError> {
    match (&options.config, &options.source) {
        (Some(config), _) if options.check => service::check(config),
        (Some(config), _) => service::run(config),
        (None, Some(source)) => relay(options, source),
        (None, None) => Err(CommandError::Input("a configuration or --source is needed".into())),
    }
}

fn relay(options: &Serve, source: &Address) -> Result<(), CommandError> {
    if options.common.json.is_some() && options.feed.is_none() {
        return Err(CommandError::Input(
            "--json needs --feed: the result is that of a recording; --trace takes each estimate".into(),
        ));
    }
    if options.feed.is_none() && options.publishing.no_publish && options.trace.is_none() {
        return Err(CommandError::Input("--no-publish needs --trace or --feed: estimates would go nowhere".into()));
    }
    check_outputs([options.common.json.as_deref(), options.trace.as_deref()])?;
    let asked = options.common.machine.as_deref();
    let ring = options.feed.as_ref().map_or_else(|| machine(asked), |feed| machine_for(feed, asked))?;
    let recording = options.feed.as_ref().map(|path| recording(path, &ring)).transpose()?;
    let link = Link::open(source).map_err(CommandError::other)?;
    match recording {
        Some(recording) => feed(options, &ring, &recording, link),
        None => listen(options, &ring, link),
    }
}

/// Publish what the device says to frames that somebody else sends it, until it or a signal ends that. The trace keeps what
/// came until then, whatever the end.
fn listen(options: &Serve, ring: &Ring, link: Link<Box<dyn Line>>) -> Result<(), CommandError> {
    let (names, stop) = (Names::of(ring), Stop::on_signals().map_err(CommandError::other)?);
    let mut sinks = sinks(&options.publishing, options.trace.as_deref(), &names)?;
    if sinks.is_empty() {
        return Err(CommandError::Other(
            "estimates go nowhere: they are not published, and there is no --trace".into(),
        ));
    }
    let mut source = Overheard::new(link, &names, options.count.unwrap_or(u64::MAX));
    let ended = serve(&mut source, &mut sinks, &stop, || {}).map_err(CommandError::other);
    let finished = sinks.finish().map_err(CommandError::other);
    ended.and(finished)
}

/// Send a recording through the device, one frame after the other.
fn feed(
    options: &Serve,
    ring: &Ring,
    recording: &Recording,
    mut link: Link<Box<dyn Line>>,
) -> Result<(), CommandError> {
    warn_if_not_modelled(ring, recording, false);
    let powered = recording.powered(ring);
    let given = options.process_noise.map(|sigma| stream::walk_per_cycle(recording, sigma, 0.0));
    let setup = stream::setup(&powered, recording, given.unwrap_or(stream::FOLLOW))?;
    let tables = tables(options.model, &powered, options.model_file.as_deref())?;
    link.restart(&setup).map_err(CommandError::other)?;
    if options.load {
        // restarted already: there are no frames of somebody before us that they would have to describe
        let bar = progress(tables.parcels::<LINE>().count(), "tables", options.common.quiet);
        link.load(&tables, || bar.inc(1)).map_err(CommandError::other)?;
        bar.finish_and_clear();
        link.restart(&setup).map_err(CommandError::other)?;
    }
    expect_tables(&mut link, &tables)?;
    let (names, stop) = (Names::of(ring), Stop::on_signals().map_err(CommandError::other)?);
    let sinks = sinks(&options.publishing, options.trace.as_deref(), &names)?;
    let mut source = Fed::new(recording, &names, &mut link, Clock::new(options.rate, &stop));
    let bar = progress(recording.rows.len(), "frames", options.common.quiet);
    let last = stream_all(&mut source, sinks, &stop, &bar)?;
    let (quality, timing) = (source.quality().map_err(CommandError::other)?, source.times.quantiles());
    deliver(
        &options.common,
        &FitResult::of_core(options.model.word(), ring, (recording, setup.walk), &last, quality, timing)?,
    )
}

/// A device uses the tables that it has, whatever their ring.
fn expect_tables<L: Line>(link: &mut Link<L>, tables: &Tables) -> Result<(), CommandError> {
    let status = link.status().map_err(CommandError::other)?;
    if status.ring != tables.sizes() {
        let (has, needs) = (status.ring.all(), tables.sizes().all());
        let counts = "monitors x, y, correctors x, y, quadrupoles, params, supplies";
        return Err(CommandError::Other(format!(
            "the device is for a ring of {has:?} {counts}, this one has {needs:?}"
        )));
    }
    let (got, expected) = (status.tables, tables.digest::<LINE>());
    let wrong = || format!("the device uses tables {got:08x}, this model has {expected:08x}; --load sends them");
    if got == expected { Ok(()) } else { Err(CommandError::Other(wrong())) }
}
