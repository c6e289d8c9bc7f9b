//! `orbitcal measure`: a campaign through the control system, and the machine put back.

use core::fmt;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use control::{Control, Epics, Journal, Plan, Step, measure, preflight, recording, restore};
use host_bridge::stop::Stop;
use inference::Recording;
use results::output::{self, fill};
use schemars::JsonSchema;
use serde::Serialize;
use twin::Ring;

use super::{CommandError, check_outputs, deliver, machine, progress};
use crate::cli::Measure;

/// Field names are those of the command's JSON.
#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct MeasureResult {
    recording: String,
    frames: usize,
    settings: usize,
    /// Frames that the machine counted while they were taken, and that are not among them.
    passed_over: u64,
    seconds: f64,
    /// Monitors without any reading.
    silent_monitors: Vec<String>,
    /// Monitors whose reading never changed.
    constant_monitors: Vec<String>,
}

/// What would be done.
#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct DryRun {
    settings: Vec<String>,
    frames: usize,
    channels: usize,
    set_points: Vec<String>,
}

/// How long a restoration goes on trying, without a plan that says so [s].
const PATIENCE: f64 = 60.0;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Measure) -> Result<(), CommandError> {
    // Ctrl-C and a closed terminal end a measurement, never the restoration after it
    let stop = Stop::until_done().map_err(CommandError::other)?;
    if let Some(path) = &options.restore {
        return put_back(options, path);
    }
    check_outputs([options.common.json.as_deref()])?;
    let plan_file =
        options.plan.as_deref().ok_or_else(|| CommandError::Input("expected a PLAN.toml or --restore".into()))?;
    let ring = machine(options.common.machine.as_deref())?;
    let plan = Plan::read(plan_file, &ring).map_err(|error| CommandError::Input(error.to_string()))?;
    let mut epics = Epics::start(&options.epics, plan.timeout).map_err(CommandError::other)?;
    preflight(&mut epics, &plan).map_err(CommandError::other)?;
    match &options.out {
        Some(out) if !options.dry_run => campaign(options, &ring, &plan, out, &mut epics, &stop),
        _ => deliver(&options.common, &DryRun::of(&plan)),
    }
}

/// What a journal says, put back.
fn put_back(options: &Measure, path: &Path) -> Result<(), CommandError> {
    let mut journal = Journal::existing(path).map_err(|error| CommandError::Input(error.to_string()))?;
    if journal.pending().is_none() {
        return said(options, format_args!("{}: the machine is back already", path.display()));
    }
    let mut epics = Epics::start(&options.epics, PATIENCE).map_err(CommandError::other)?;
    let written = restore(&mut epics, &mut journal, PATIENCE).map_err(CommandError::other)?;
    said(options, format_args!("{}: the machine is back at its settings, {written} written", path.display()))
}

fn said(options: &Measure, what: fmt::Arguments) -> Result<(), CommandError> {
    if options.common.speaks() { Ok(output::say(what)?) } else { Ok(()) }
}

/// The journal of a campaign: beside its folder.
fn journal_of(out: &Path) -> PathBuf {
    let mut name = out.file_name().unwrap_or_default().to_owned();
    name.push(".journal");
    out.with_file_name(name)
}

fn campaign(
    options: &Measure,
    ring: &Ring,
    plan: &Plan,
    out: &Path,
    control: &mut impl Control,
    stop: &Stop,
) -> Result<(), CommandError> {
    if out.exists() {
        return Err(CommandError::Input(format!("{} exists, and is not overwritten", out.display())));
    }
    output::check_folder(out)?;
    let path = journal_of(out);
    let mut journal = Journal::open(&path, plan).map_err(|error| CommandError::Input(error.to_string()))?;
    let bar = progress(plan.steps.len(), "settings", options.common.quiet);
    let ended = measure(control, plan, &mut journal, &|| stop.is_requested(), |progress| {
        bar.set_position(progress.done as u64);
        bar.set_message(progress.step.to_string());
    });
    bar.finish_and_clear();
    ended.map_err(|error| {
        let again = if journal.pending().is_some() && !second_try(options, plan, &mut journal) {
            format!("put it back with `orbitcal measure --restore {}`", path.display())
        } else {
            let done = plan.steps.iter().filter(|step| journal.has(step)).count();
            format!("{done} of {} settings are taken, and the same command goes on from there", plan.steps.len())
        };
        CommandError::Other(format!("{error}; {again}"))
    })?;
    let name = out.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let measured = recording(plan, &journal, &name);
    write(&measured, ring, out)?;
    journal.remove().map_err(CommandError::other)?;
    deliver(&options.common, &MeasureResult::of(&measured, ring, plan, out))
}

/// Put the machine back through another process, in case the first one is gone.
fn second_try(options: &Measure, plan: &Plan, journal: &mut Journal) -> bool {
    let epics = Epics::start(&options.epics, plan.timeout);
    let back = epics.is_ok_and(|mut epics| restore(&mut epics, journal, plan.timeout).is_ok());
    if back {
        output::warn("the machine is back at its settings at the second try");
    }
    back
}

/// The folder appears whole or not at all.
fn write(measured: &Recording, ring: &Ring, out: &Path) -> Result<(), CommandError> {
    let beside = out.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let folder = tempfile::Builder::new().prefix(".measured").tempdir_in(beside).map_err(CommandError::other)?;
    let whole = folder.path().join("whole");
    measured.write(&whole, ring).map_err(CommandError::other)?;
    std::fs::rename(&whole, out).map_err(|error| CommandError::Other(format!("{}: {error}", out.display())))
}

impl MeasureResult {
    fn of(measured: &Recording, ring: &Ring, plan: &Plan, out: &Path) -> Self {
        let rows = &measured.rows;
        let (first, last) = (rows.first(), rows.last());
        let span = first.zip(last).map_or(0, |(first, last)| u64::from(last.sequence - first.sequence) + 1);
        let readings = |b: usize| rows.iter().filter_map(move |row| row.reading[b]);
        let which = |is: &dyn Fn(usize) -> bool| -> Vec<String> {
            ring.monitor_names().into_iter().enumerate().filter(|(b, _)| is(*b)).map(|(_, name)| name).collect()
        };
        let constant = |b: usize| {
            let distinct: BTreeSet<u64> = readings(b).map(f64::to_bits).collect();
            distinct.len() == 1 && rows.len() > 1
        };
        Self {
            recording: out.display().to_string(),
            frames: rows.len(),
            settings: plan.steps.len(),
            passed_over: span.saturating_sub(rows.len() as u64),
            seconds: last.map_or(0.0, |row| row.time),
            silent_monitors: which(&|b| readings(b).next().is_none()),
            constant_monitors: which(&constant),
        }
    }
}

impl fmt::Display for MeasureResult {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Self { recording, frames, settings, seconds, passed_over, .. } = self;
        write!(
            f,
            "{recording}: {frames} frames at {settings} settings in {seconds:.0} s, {passed_over} cycles passed over while they were made"
        )?;
        for (which, what) in
            [(&self.silent_monitors, "never reported"), (&self.constant_monitors, "always read the same")]
        {
            if !which.is_empty() {
                write!(f, "\n{}", fill(&format!("{what}: {}", which.join(", "))))?;
            }
        }
        write!(f, "\nthe machine is back at its settings")
    }
}

impl DryRun {
    fn of(plan: &Plan) -> Self {
        let set = plan.set_points();
        Self {
            settings: plan.steps.iter().map(Step::to_string).collect(),
            frames: plan.steps.len() * plan.repeats,
            channels: plan.channels.of_a_frame().len() + 2 * set.len(),
            set_points: set.iter().map(|set| set.write.to_owned()).collect(),
        }
    }
}

impl fmt::Display for DryRun {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        writeln!(f, "{}", fill(&self.settings.join("; ")))?;
        let (settings, set) = (self.settings.len(), self.set_points.len());
        write!(
            f,
            "{settings} settings of {set} set points, {} frames; all channels are there; nothing was written",
            self.frames
        )
    }
}
