//! `orbitcal serve CONFIG.toml`: the core in this process beside a machine, for months.

use std::path::Path;
use std::sync::Arc;

use control::{Gathering, Plan};
use estimator::wire::packet;
use inference::Recording;
use inference::recording::Header;
use inference::stream::{self, Core, Feedback};
use results::output::{self, tell};
use results::{CommandError, Names, Remarked, recording};
use shared_memory::{FrameWriter, HealthWriter, Publisher, RequestServer, SetpointWriter};
use training::rooms::largest;
use twin::Ring;

use crate::checkpoint::{Head, Keeper};
use crate::config::{self, Config, Publish, Source};
use crate::daemon::{self, Engine, Outlet};
use crate::health::{Health, Reporter};
use crate::history::{self, Columns, Recorder};
use crate::logs;
use crate::source::desk::Allowed;
use crate::source::desk::Desk;
use crate::source::origin::Origin;
use crate::source::program::Program;
use crate::source::queue::{Faults, Queue};
use crate::source::{feed, rehearsal, shared};
use crate::stop::Stop;
use crate::web::{self, Board, Place};

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
    logs::change(config.logs.form);
    let (ring, mut core) = build(&config)?;
    let stop = Stop::on_signals().map_err(CommandError::other)?;
    let model = daemon::model_of(&mut core).map_err(CommandError::other)?;
    let checkpoint = config.checkpoint.file.as_deref();
    let resumed = checkpoint.and_then(|path| daemon::resume(&mut core, path, &model));
    if let Some(head) = &resumed {
        tell(format_args!("resumed after frame {}: {} frames, {} s ago", head.sequence, head.frames, head.age()));
    }
    let queue = Queue::new(config.source.buffer_frames, resumed.as_ref().map_or(Faults::default(), |head| head.faults));
    let outlet = outlet(&config, &ring, &core, &queue, resumed.as_ref())?;
    start(&config.source, &ring, &queue, &stop)?;
    tell(format_args!("publishes on {}, takes frames from {}", config.publish.service, config.source.address));
    let every = checkpoint.map(|_| config.checkpoint.checkpoint_every_frames);
    let engine = Engine::new(core, queue, model, resumed.map(|head| head.sequence), every)
        .with_feedback(feedback_wanted(&config, &ring)?, config.feedback.on);
    daemon::run(engine, outlet, &stop).map_err(CommandError::other)
}

/// Everything that takes estimates.
fn outlet(
    config: &Config,
    ring: &Ring,
    core: &Core,
    queue: &Queue,
    resumed: Option<&Head>,
) -> Result<Outlet, CommandError> {
    let (names, correctors) = (Names::of(ring), ring.corrector_names());
    let Publish { service, name, frames } = &config.publish;
    // first, as it refuses a second daemon
    let server = RequestServer::try_new(service, name).map_err(CommandError::other)?;
    let calibrated = calibration(&config.machine.recording, ring)?;
    let desk = Desk::new(server, Allowed { requests: config.requests, ring: calibrated.powered(ring).into_owned() });
    let setpoints = setpoints(config, ring)?;
    let publisher = Publisher::try_new(service, name, &names).map_err(CommandError::other)?;
    let health = HealthWriter::try_new(service, name, &names, &correctors).map_err(CommandError::other)?;
    let frames = frames.as_deref().map(|service| FrameWriter::try_alone(service, name)).transpose();
    let kept =
        resumed.map(|head| head.health.clone()).filter(|kept| kept.is_of(names.monitors.len(), correctors.len()));
    let learnt = kept.unwrap_or_else(|| Health::new(&core.setup.noise, correctors.len()));
    let reporter = Reporter::new(learnt, core.tables.sizes()).with(health);
    let board = Board::new(queue.clone(), name, Place::of(ring), Arc::default());
    let columns =
        Columns { vars: names.vars.clone(), instruments: names.monitors.iter().chain(&correctors).cloned().collect() };
    let recorder = recorder(&config.history, &columns, &board)?;
    if let Some(address) = config.page.address {
        let address = web::start(address, &board).map_err(CommandError::other)?;
        tell(format_args!("the page is at http://{address}"));
    }
    let keeper = config.checkpoint.file.as_deref().map(|path| Keeper::start(path, queue)).transpose();
    let remarked = resumed.map_or(Remarked::default(), |head| head.remarked);
    Ok(Outlet::new(&names, publisher, reporter, remarked, &board)
        .with_requests(desk)
        .with_frames(frames.map_err(CommandError::other)?)
        .with_checkpoints(keeper.map_err(CommandError::other)?)
        .with_history(recorder)
        .with_feedback(setpoints))
}

/// The history, if one is kept; the page begins with what is there.
fn recorder(config: &config::History, columns: &Columns, board: &Arc<Board>) -> Result<Option<Recorder>, CommandError> {
    let Some(folder) = &config.folder else { return Ok(None) };
    let plan = config.plan();
    let keeper = history::Keeper::start(folder, &plan, columns, board.metrics.clone()).map_err(CommandError::other)?;
    if let Ok(there) = history::read(folder, &history::Span::default()) {
        board.remember(&there);
    }
    let megabytes = plan.most_bytes(columns).div_ceil(1_000_000);
    tell(format_args!("keeps a history in {}, {megabytes} MB at most", folder.display()));
    Ok(Some(Recorder::new(&plan, columns, keeper)))
}

/// What is wanted of the orbit, if the feedback is on or can be switched on.
fn feedback_wanted(config: &Config, ring: &Ring) -> Result<Option<Feedback>, CommandError> {
    let is_possible = config.feedback.on || config.requests.feedback;
    is_possible.then(|| config.feedback.of(ring).map_err(CommandError::Input)).transpose()
}

/// Where set points go, if there can be a feedback.
fn setpoints(config: &Config, ring: &Ring) -> Result<Option<SetpointWriter>, CommandError> {
    if feedback_wanted(config, ring)?.is_none() {
        return Ok(None);
    }
    let Publish { service, name, .. } = &config.publish;
    SetpointWriter::try_new(service, name, &ring.name, &ring.corrector_names()).map(Some).map_err(CommandError::other)
}

/// Begin to put frames into the queue.
fn start(source: &Source, ring: &Ring, queue: &Queue, stop: &Stop) -> Result<(), CommandError> {
    let most = packet::wire_bytes(largest::Frame::MAX_BYTES);
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
    let ring = machine_file.file.as_deref().map_or_else(|| Ok(Ring::booster()), Ring::read)?;
    let recording = calibration(&machine_file.recording, &ring)?;
    let powered = recording.powered(&ring);
    let tables = results::tables(machine_file.model_file.as_deref(), &powered)?;
    let setup = stream::setup(&powered, &recording, config.walk.into())?;
    let core = Core::with_tables(tables, setup)?;
    Ok((ring, core))
}
