//! `orbitcal replay`: recording to wire bytes to core to shared memory, frame by frame.

use host_bridge::source::{self, Clock};
use host_bridge::stop::Stop;
use inference::stream::{self, Core};
use results::{FitResult, Names};

use super::{
    CommandError, check_outputs, deliver, machine_with, progress, recording, sinks, stream_all, tables,
    warn_if_not_modelled,
};
use crate::cli::{CoreModel, Replay};

/// Metres a micrometre.
const MICRO: f32 = 1e-6;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Replay) -> Result<(), CommandError> {
    check_outputs([options.common.json.as_deref(), options.trace.as_deref()])?;
    let ring = machine_with(&options.recording, options.common.machine.as_deref(), &options.priors)?;
    let recording = recording(&options.recording, &ring)?;
    warn_if_not_modelled(&ring, &recording, options.model_file.is_some());
    let powered = recording.powered(&ring);
    let tables = tables(options.model, &powered, options.model_file.as_deref())?;
    let walk = if options.follow {
        stream::FOLLOW
    } else {
        stream::walk_per_cycle(&recording, options.process_noise, options.baseline_walk * MICRO)
    };
    let setup = stream::setup(&powered, &recording, walk)?;
    let core = match options.model {
        CoreModel::Green => Core::with_tables(tables, setup)?,
        CoreModel::Resnet => Core::with_network(&powered, tables, setup)?,
    };
    let stop = Stop::on_signals().map_err(CommandError::other)?;
    let names = Names::of(&ring);
    let sinks = sinks(&options.publishing, options.trace.as_deref(), &names)?;
    let mut source = source::replay::Replay::new(&recording, &names, core, Clock::new(options.rate, &stop));
    let bar = progress(recording.rows.len(), "frames", options.common.quiet);
    let last = stream_all(&mut source, sinks, &stop, &bar)?;
    let (quality, timing) = (source.quality(), source.times.quantiles());
    let result = FitResult::of_core(options.model.word(), &ring, (&recording, walk), &last, quality, timing)?;
    let extrapolated = (options.model == CoreModel::Resnet).then(|| source.extrapolated());
    deliver(&options.common, &FitResult { extrapolated, ..result })
}
