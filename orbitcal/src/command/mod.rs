//! The commands, one file each.

mod challenge;
mod check;
mod compare;
mod conceal;
mod diagnose;
mod export;
mod fit;
mod frames;
mod history;
mod import;
mod matrix;
mod measure;
mod replay;
mod request;
mod response;
mod schemas;
mod serve;
mod simulate;
mod study;
mod surrogate;
mod train;
mod validate;
mod watch;

use core::fmt::Display;
use std::borrow::Cow;
use std::path::Path;
use std::sync::Arc;

use host_bridge::serve::serve;
use host_bridge::sink::Sinks;
use host_bridge::sink::trace::Trace;
use host_bridge::source::Source;
use host_bridge::stop::Stop;
use indicatif::{ProgressBar, ProgressStyle};
use inference::{Recording, with_priors};
use results::{
    CommandError, EstimateRecord, Names, campaign, expect_modelled, not_modelled, output, recording, strays,
};
use serde::Serialize;
use shared_memory::{PublishError, Publisher};
use training::Tables;
use twin::{LatticeError, Ring};

pub use schemas::schemas;

use crate::cli::{Cli, Command, Common, CoreModel, Priors, Publishing};

/// Run the command of a command line.
///
/// # Errors
/// [`CommandError`].
pub fn run(cli: &Cli) -> Result<(), CommandError> {
    match &cli.command {
        Command::Check(options) => check::run(options),
        Command::Replay(options) => replay::run(options),
        Command::Watch(options) => watch::run(options),
        Command::Response(options) => response::run(options),
        Command::Fit(options) => fit::run(options),
        Command::Study(options) => study::run(options),
        Command::Diagnose(options) => diagnose::run(options),
        Command::Compare(options) => compare::run(options),
        Command::Frames(options) => frames::run(options),
        Command::Conceal(options) => conceal::run(options),
        Command::Challenge(options) => challenge::run(options),
        Command::Import(options) => import::run(options),
        Command::Export(options) => export::run(options),
        Command::Validate(options) => validate::run(options),
        Command::Request(options) => request::run(options),
        Command::History(options) => history::run(options),
        Command::Serve(options) => serve::run(options),
        Command::Measure(options) => measure::run(options),
        Command::Simulate(options) => simulate::run(options),
        Command::Surrogate(options) => surrogate::run(options),
        Command::Train(options) => train::run(options),
    }
}

/// The machine that was asked for, or the built-in one.
fn machine(path: Option<&Path>) -> Result<Ring, LatticeError> {
    path.map_or_else(|| Ok(Ring::booster()), Ring::read)
}

/// The machine of a recording: the one that was asked for, or the built-in one that its header names.
fn machine_for(recording: &Path, path: Option<&Path>) -> Result<Ring, LatticeError> {
    machine_named(Recording::lattice(recording).as_deref(), path)
}

/// The machine that was asked for, or the built-in one of a file name.
fn machine_named(lattice: Option<&str>, path: Option<&Path>) -> Result<Ring, LatticeError> {
    match (path, lattice.and_then(Ring::built_in)) {
        (None, Some(ring)) => Ok(ring),
        _ => machine(path),
    }
}

/// The same with the priors that were asked for.
fn machine_with(recording: &Path, path: Option<&Path>, priors: &Priors) -> Result<Ring, LatticeError> {
    Ok(with_priors(&machine_for(recording, path)?, priors.prior_width, priors.range))
}

/// The core's tables: those of a model file, or of the ring as designed.
fn tables(model: CoreModel, ring: &Ring, file: Option<&Path>) -> Result<Tables, CommandError> {
    match (model, file) {
        (CoreModel::Resnet, Some(path)) => Err(CommandError::Input(format!(
            "{}: the network has no terms of a model file; leave out --model resnet",
            path.display()
        ))),
        _ => results::tables(file, ring),
    }
}

/// See that files can be written before work is put into them.
fn check_outputs<'p>(paths: impl IntoIterator<Item = Option<&'p Path>>) -> Result<(), CommandError> {
    Ok(paths.into_iter().flatten().try_for_each(output::check)?)
}

/// Stream a recording from a source into the sinks, to its end, and show how far that is.
fn stream_all(
    source: &mut impl Source,
    mut sinks: Sinks,
    stop: &Stop,
    bar: &ProgressBar,
) -> Result<Box<EstimateRecord>, CommandError> {
    let last = serve(source, &mut sinks, stop, || bar.inc(1));
    bar.finish_and_clear();
    // without a last one, or not the last one of the recording, somebody did not want to wait for it
    let last = last.map_err(CommandError::other)?.filter(|_| !stop.is_requested());
    let last = last.ok_or_else(CommandError::interrupted)?;
    sinks.finish().map_err(CommandError::other)?;
    Ok(last)
}

/// The sinks that were asked for. Without shared memory a recording can still be replayed: that it is not published is said.
fn sinks(publishing: &Publishing, trace: Option<&Path>, names: &Arc<Names>) -> Result<Sinks, CommandError> {
    let trace = trace.map(Trace::create).transpose().map_err(CommandError::other)?;
    let publisher = (!publishing.no_publish).then(|| Publisher::try_new(&publishing.service, &publishing.name, names));
    let publisher = match publisher.transpose() {
        Err(error @ PublishError::Name { .. }) => return Err(CommandError::Input(error.to_string())),
        Err(error) => {
            output::warn(format_args!("not published: {error}; --no-publish leaves this line out"));
            None
        }
        Ok(publisher) => publisher,
    };
    Ok(Sinks::default().with_optional(publisher).with(trace))
}

/// Give a result to whoever asked for it: a program, a person, or both.
fn deliver<R: Serialize + Display>(common: &Common, result: &R) -> Result<(), CommandError> {
    if let Some(path) = &common.json {
        output::json(path, result)?;
    }
    if common.speaks() { Ok(output::say(result)?) } else { Ok(()) }
}

/// The same as a line on stderr, of a core that goes on; a model file holds what it was made for.
fn warn_if_not_modelled(ring: &Ring, recording: &Recording, has_model_file: bool) {
    let held = not_modelled(recording).filter(|_| !has_model_file);
    held.into_iter().chain(strays(ring, recording)).for_each(output::warn);
}

/// A progress bar; hidden in a pipe by indicatif itself, and when nothing but errors is wanted.
pub fn progress(length: usize, what: impl Into<Cow<'static, str>>, quiet: bool) -> ProgressBar {
    if quiet {
        return ProgressBar::hidden();
    }
    let style =
        ProgressStyle::with_template("{msg} {wide_bar} {pos}/{len} {eta}").expect("the template is tested by use");
    ProgressBar::new(length as u64).with_style(style).with_message(what)
}
