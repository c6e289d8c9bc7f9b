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
use inference::furthest_stray;
use inference::recording::BelievedRf;
use inference::{BatchError, Campaign, Recording, RecordingError, stream, with_priors};
use serde::Serialize;
use training::Tables;
use twin::{LatticeError, Ring};

use crate::cli::{Common, CoreModel, Priors, Publishing};
use crate::model_file::{self, ModelFileError};
use crate::output::{self, OutputError};
use crate::record::{EstimateRecord, Names};
use crate::serve::serve;
use crate::sink::Sinks;
use crate::sink::shared_memory::{PublishError, Publisher};
use crate::sink::trace::Trace;
use crate::source::Source;
use crate::stop::Stop;

/// Why a command ended: bad arguments or input (exit 2), or anything else (exit 1), in one line.
#[derive(Debug)]
pub enum CommandError {
    /// Arguments or input.
    Input(String),
    /// Anything else.
    Other(String),
}

impl CommandError {
    /// Nothing that the arguments or the input could help.
    pub(crate) fn other(error: impl Display) -> Self {
        Self::Other(error.to_string())
    }

    /// Somebody has asked for the end.
    fn interrupted() -> Self {
        Self::Other("interrupted; nothing was written".into())
    }
}

impl From<LatticeError> for CommandError {
    fn from(error: LatticeError) -> Self {
        Self::Input(error.to_string())
    }
}

impl From<RecordingError> for CommandError {
    fn from(error: RecordingError) -> Self {
        Self::Input(error.to_string())
    }
}

impl From<stream::StreamError> for CommandError {
    fn from(error: stream::StreamError) -> Self {
        Self::Input(error.to_string())
    }
}

impl From<ModelFileError> for CommandError {
    fn from(error: ModelFileError) -> Self {
        Self::Input(error.to_string())
    }
}

impl From<OutputError> for CommandError {
    fn from(error: OutputError) -> Self {
        Self::Other(error.to_string())
    }
}

impl From<BatchError> for CommandError {
    fn from(error: BatchError) -> Self {
        Self::Other(error.to_string())
    }
}

impl core::error::Error for CommandError {}

impl core::fmt::Display for CommandError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let (Self::Input(message) | Self::Other(message)) = self;
        f.write_str(message)
    }
}

impl From<twin::OrbitError> for CommandError {
    fn from(error: twin::OrbitError) -> Self {
        Self::Other(format!("no stable ring: {error}"))
    }
}

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

/// A recording of a ring, screened.
///
/// # Errors
/// [`CommandError::Input`] if its currents leave no stable ring, with the supply that is furthest from its nominal one.
pub fn campaign(ring: &Ring, recording: &Recording) -> Result<Campaign, CommandError> {
    Campaign::of(ring, recording).map_err(|error| {
        let header = &recording.header;
        let mean = |f: usize| recording.rows.iter().map(|row| row.supply[f]).sum::<f64>() / recording.rows.len() as f64;
        let away = |f: &usize| (mean(*f) / header.nominal[*f]).ln().abs();
        // along a ramp no supply stays at its nominal current
        let steady = if header.ramp.is_given() { 0 } else { header.nominal.len() };
        let furthest = (0..steady).max_by(|one, other| away(one).total_cmp(&away(other)));
        let supply = furthest.map_or_else(String::new, |f| {
            let name = &recording.powered(ring).supplies[f].name;
            format!("; supply {name} is at {:.1} A, its nominal current is {:.1} A", mean(f), header.nominal[f])
        });
        CommandError::Input(format!(
            "{}: no stable ring {} at its currents: {error}{supply}",
            recording.name, ring.name
        ))
    })
}

/// What the header believes to be held that is not the momentum, so that only the exact twin models it.
fn not_modelled(recording: &Recording) -> Option<String> {
    let (key, what) = match recording.header.believed_rf {
        BelievedRf::FixedMomentum => return None,
        BelievedRf::FixedFrequency => ("fixed_frequency", "a fixed RF frequency"),
        BelievedRf::RadialLoop => ("radial_loop", "a radial loop"),
    };
    let known_by = "orbitcal fit --method map and orbitcal diagnose do";
    Some(format!("{}: header.toml, believed_rf = {key:?}: this does not model {what}; {known_by}", recording.name))
}

/// The same as an error, where results would be wrong without a word.
///
/// # Errors
/// [`CommandError::Input`].
pub fn expect_modelled(recording: &Recording) -> Result<(), CommandError> {
    not_modelled(recording).map_or(Ok(()), |why| Err(CommandError::Input(why)))
}

/// The same as a line on stderr, of a core that goes on; a model file holds what it was made for.
fn warn_if_not_modelled(ring: &Ring, recording: &Recording, has_model_file: bool) {
    let held = not_modelled(recording).filter(|_| !has_model_file);
    held.into_iter().chain(strays(ring, recording)).for_each(output::warn);
}

/// Distance of a supply at one time in the cycle from its mean over all frames up to which first order in it is enough: at three times
/// as much the vars of simulated machines are off by 1.5 to 2 standard deviations.
const STRAYS: f64 = 5e-4;

/// That supplies follow the ramp too loosely for the core, which takes to first order what they are off their mean.
fn strays(ring: &Ring, recording: &Recording) -> Option<String> {
    let stray = furthest_stray(recording).filter(|stray| stray.off.abs() > STRAYS)?;
    let supply = &recording.powered(ring).supplies[stray.supply].name;
    Some(format!(
        "{}: at {} ms supply {supply} is {:+.2} % off its mean over all times in the cycle; this is right up to {:.2} %, orbitcal fit \
         beyond it",
        recording.name,
        stray.milliseconds,
        100.0 * stray.off,
        100.0 * STRAYS
    ))
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
