//! `orbitcal serve CONFIG.toml`: the core in this process beside a machine, for months.

use std::path::Path;

use control::{Gathering, Plan};
use estimator::wire::packet;
use inference::Recording;
use inference::recording::Header;
use inference::stream::{self, Core, Feedback};
use training::rooms::large;
use twin::Ring;

use super::{CommandError, machine, recording, tables};
use crate::checkpoint::Keeper;
use crate::cli::CoreModel;
use crate::config::{Config, ConfigError, Source};
use crate::output::{self, warn};
use crate::record::Names;
use crate::serve::serve;
use crate::sink::Sinks;
use crate::sink::shared_memory::{FrameWriter, HealthWriter, Publisher, RequestServer, SetpointWriter};
use crate::source::desk::Allowed;
use crate::source::desk::Desk;
use crate::source::origin::Origin;
use crate::source::program::Program;
use crate::source::queue::{Faults, Queue};
use crate::source::raw::{self, Raw, Steering};
use crate::source::{feed, rehearsal, shared};
use crate::stop::Stop;

impl From<ConfigError> for CommandError {
    fn from(error: ConfigError) -> Self {
        Self::Input(error.to_string())
    }
}

/// Say everything that is wrong with a configuration, the machine's files included; nothing is started.
///
/// # Errors
/// [`CommandError::Input`].
pub fn check(file: &Path) -> Result<(), CommandError> {
    let config = Config::read(file)?;
    let (ring, core) = build(&config)?;
    match &config.source.address {
        Origin::Recording(path) => _ = recording(path, &ring)?,
        Origin::Epics(path) => _ = plan(path, &ring)?,
        Origin::Line(_) | Origin::SharedMemory(_) => {}
    }
    feedback_wanted(&config, &ring)?;
    let sizes = core.tables.sizes();
    output::say(format_args!(
        "{}: good; {}, {} monitors, {} vars, frames from {}",
        file.display(),
        ring.name,
        sizes.monitors.iter().sum::<u16>(),
        sizes.params,
        config.source.address
    ))?;
    Ok(())
}

/// Run it until a signal comes.
///
/// # Errors
/// [`CommandError`].
pub fn run(file: &Path) -> Result<(), CommandError> {
    let config = Config::read(file)?;
    let (ring, mut core) = build(&config)?;
    let stop = Stop::on_signals().map_err(CommandError::other)?;
    let names = Names::of(&ring);
    let publisher = Publisher::try_new(&config.publish.service, &config.publish.name, &names);
    let health = HealthWriter::try_new(&config.publish.service, &config.publish.name, &names, &ring.corrector_names());
    let health = health.map_err(CommandError::other)?;
    let frames = config.publish.frames.as_deref().map(|service| FrameWriter::try_new(service, &config.publish.name));
    let frames = frames.transpose().map_err(CommandError::other)?;
    let server = RequestServer::try_new(&config.publish.service, &config.publish.name).map_err(CommandError::other)?;
    let steering = steering(&config, &ring)?;
    let calibrated = calibration(&config.machine.recording, &ring)?;
    let allowed = Allowed { requests: config.requests, ring: calibrated.powered(&ring).into_owned() };
    let desk = Desk::new(server, allowed);
    let mut sinks = Sinks::default().with(Some(publisher.map_err(CommandError::other)?));
    let model = raw::model_of(&mut core).map_err(CommandError::other)?;
    let checkpoint = &config.checkpoint;
    let resumed = checkpoint.file.as_deref().and_then(|path| raw::resume(&mut core, path, &model));
    if let Some(head) = &resumed {
        warn(format_args!("resumed after frame {}: {} frames, {} s ago", head.sequence, head.frames, head.age()));
    }
    let queue = Queue::new(config.source.buffer_frames, resumed.as_ref().map_or(Faults::default(), |head| head.faults));
    let keeper = checkpoint.file.as_deref().map(|path| Keeper::start(path, &queue));
    let keeper = keeper.transpose().map_err(CommandError::other)?;
    start(&config.source, &ring, &queue, &stop)?;
    warn(format_args!("publishes on {}, takes frames from {}", config.publish.service, config.source.address));
    let mut source = Raw::new(core, &names, queue, model, resumed.as_ref())
        .with_health(health)
        .with_requests(desk)
        .with_frames(frames)
        .with_feedback(steering)
        .with_checkpoints(keeper, checkpoint.checkpoint_every_frames);
    let ended = serve(&mut source, &mut sinks, &stop, || {}).map(drop).map_err(CommandError::other);
    let saved = source.finish().map_err(CommandError::other);
    let finished = sinks.finish().map_err(CommandError::other);
    ended.and(saved).and(finished)
}

/// What is wanted of the orbit, if the feedback is on or can be switched on.
fn feedback_wanted(config: &Config, ring: &Ring) -> Result<Option<Feedback>, CommandError> {
    let is_possible = config.feedback.on || config.requests.feedback;
    is_possible.then(|| config.feedback.of(ring).map_err(CommandError::Input)).transpose()
}

/// The orbit feedback, and where its set points go.
fn steering(config: &Config, ring: &Ring) -> Result<Option<Steering>, CommandError> {
    let Some(wanted) = feedback_wanted(config, ring)? else { return Ok(None) };
    let (service, name) = (&config.publish.service, &config.publish.name);
    let writer = SetpointWriter::try_new(service, name, &ring.name, &ring.corrector_names());
    let writer = Some(writer.map_err(CommandError::other)?);
    Ok(Some(Steering { wanted, is_on: config.feedback.on, writer }))
}

/// Begin to put frames into the queue.
fn start(source: &Source, ring: &Ring, queue: &Queue, stop: &Stop) -> Result<(), CommandError> {
    let most = packet::wire_bytes(large::Frame::MAX_BYTES);
    match &source.address {
        Origin::Line(address) => feed::start(source, address, most, queue, stop),
        Origin::Recording(path) => rehearsal::start(recording(path, ring)?, source.rate(), queue, stop),
        Origin::SharedMemory(service) => shared::start(service, most, queue, stop),
        Origin::Epics(path) => {
            let request = Gathering::of(&plan(path, ring)?, source.late()).line();
            let program = Program { path: source.program.clone(), request };
            feed::start_program(program, source, most, queue, stop)
        }
    }
    .map_err(|error| CommandError::Other(format!("{}: {error}", source.address)))
}

/// A recording whose header has calibration, noise and ramp; of a header alone, one without frames.
fn calibration(path: &Path, ring: &Ring) -> Result<Recording, CommandError> {
    if !path.is_file() {
        return recording(path, ring);
    }
    let header = Header::read(path, ring)?;
    Ok(Recording { name: path.display().to_string(), header, other: Vec::new(), rows: Vec::new() })
}

/// A measurement plan, whose channels are gathered.
fn plan(path: &Path, ring: &Ring) -> Result<Plan, CommandError> {
    Plan::read(path, ring).map_err(|error| CommandError::Input(error.to_string()))
}

/// The ring, and a core for it at its prior.
fn build(config: &Config) -> Result<(Ring, Core), CommandError> {
    let machine_file = &config.machine;
    let ring = machine(machine_file.file.as_deref())?;
    let recording = calibration(&machine_file.recording, &ring)?;
    let powered = recording.powered(&ring);
    let tables = tables(CoreModel::Green, &powered, machine_file.model_file.as_deref())?;
    let setup = stream::setup(&powered, &recording, config.walk.into())?;
    let core = Core::with_tables(tables, setup)?;
    Ok((ring, core))
}
