//! The commands, one file each.

pub mod challenge;
pub mod check;
pub mod compare;
pub mod conceal;
pub mod daemon;
pub mod diagnose;
pub mod export;
pub mod fit;
pub mod frames;
pub mod history;
pub mod import;
pub mod matrix;
pub mod measure;
pub mod replay;
pub mod request;
pub mod response;
pub mod serve;
pub mod simulate;
pub mod study;
pub mod surrogate;
pub mod train;
pub mod validate;
pub mod watch;

use core::fmt::Display;
use std::borrow::Cow;
use std::path::Path;
use std::sync::Arc;

use indicatif::{ProgressBar, ProgressStyle};
use inference::{Recording, stream, with_priors};
pub use results::CommandError;
use results::{EstimateRecord, Names, campaign, expect_modelled, model_file, not_modelled, output, strays};
use serde::Serialize;
use shared_memory::{PublishError, Publisher};
use training::Tables;
use twin::{LatticeError, Ring};

use crate::cli::{Common, CoreModel, Priors, Publishing};
use crate::serve::serve;
use crate::sink::Sinks;
use crate::sink::trace::Trace;
use crate::source::Source;
use crate::stop::Stop;

/// The machine that was asked for, or the built-in one.
fn machine(path: Option<&Path>) -> Result<Ring, LatticeError> {
    path.map_or_else(|| Ok(Ring::booster()), Ring::read)
}

/// The same with the priors that were asked for.
fn machine_with(path: Option<&Path>, priors: &Priors) -> Result<Ring, LatticeError> {
    Ok(with_priors(&machine(path)?, priors.prior_width, priors.range))
}

/// The core's tables: those of a model file, or of the ring as designed.
fn tables(model: CoreModel, ring: &Ring, file: Option<&Path>) -> Result<Tables, CommandError> {
    match (model, file) {
        (CoreModel::Green, Some(path)) => Ok(model_file::read(path, ring)?),
        (CoreModel::Resnet, Some(path)) => Err(CommandError::Input(format!(
            "{}: the network has no terms of a model file; leave out --model resnet",
            path.display()
        ))),
        (_, None) => Ok(training::green::tables(ring).map_err(stream::StreamError::from)?),
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

fn recording(path: &Path, ring: &Ring) -> Result<Recording, CommandError> {
    if measured::Folder::is_one(path) {
        let path = path.display();
        let problem = format!("{path} holds a measured response matrix; `fit`, `diagnose` and `compare` read one");
        return Err(CommandError::Input(problem));
    }
    Ok(Recording::read(path, ring)?)
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
