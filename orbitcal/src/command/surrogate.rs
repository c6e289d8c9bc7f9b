//! `orbitcal surrogate check`: tables from the twin, and how wrong they are.

use core::fmt;
use std::path::Path;

use results::output::{fill, table};
use schemars::JsonSchema;
use serde::Serialize;
use training::SurrogateError;
use training::network::checkpoint;
use training::network::fit::{Plan, Trainee};
use training::network::layers::Network;
use training::network::samples::Source;
use twin::Ring;

use super::{CommandError, check_outputs, deliver, machine, progress};
use crate::cli::{Surrogate, SurrogateAction};

#[derive(Serialize, JsonSchema)]
pub(super) struct Check {
    surrogates: Vec<Entry>,
}

#[derive(Serialize, JsonSchema)]
struct Entry {
    name: &'static str,
    plane: char,
    parameters: usize,
    bytes: usize,
    samples: usize,
    rms_mm: f64,
    max_mm: f64,
    stated_rms_mm: f64,
}

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Surrogate) -> Result<(), CommandError> {
    let SurrogateAction::Check { common, samples, seed, checkpoint } = &options.action;
    check_outputs([common.json.as_deref()])?;
    let ring = machine(common.machine.as_deref())?;
    check_ring(&ring)?;
    let green = training::green::tables(&ring).map_err(|error| CommandError::Input(error.to_string()))?;
    let bar = progress(*samples, "vars", common.quiet);
    let planes = training::check(&ring, &green, *samples, *seed, || bar.inc(1));
    bar.finish_and_clear();
    let networks = networks(&ring, checkpoint.as_deref(), (*samples, *seed), common.quiet)?;
    deliver(common, &Check { surrogates: planes.iter().chain(&networks).map(Entry::of).collect() })
}

/// Errors of the trained network, if it is of this ring.
fn networks(
    ring: &Ring,
    file: Option<&Path>,
    (samples, seed): (usize, u32),
    quiet: bool,
) -> Result<Vec<SurrogateError>, CommandError> {
    let free = file.map(free).transpose()?;
    if file.is_none() && training::network::expect_known(ring).is_err() {
        return Ok(Vec::new());
    }
    let bar = progress(samples, "vars", quiet);
    let errors = training::check_networks(ring, free.as_ref(), samples, seed, || bar.inc(1));
    bar.finish_and_clear();
    errors.map_err(|error| CommandError::Input(error.to_string()))
}

/// The networks in f32 of a checkpoint.
fn free(path: &Path) -> Result<[Network; 2], CommandError> {
    let source = Source::of(&Ring::booster());
    let mut planes = [0, 1].map(|plane| Trainee::new(&source, plane, &Plan::FULL));
    let is_there = checkpoint::load(path, &mut planes).map_err(|error| CommandError::Input(error.to_string()))?;
    let missing = || CommandError::Input(format!("{}: file not found", path.display()));
    is_there.then(|| planes.map(|plane| plane.free)).ok_or_else(missing)
}

/// A core predicts what monitors read, given vars.
fn check_ring(ring: &Ring) -> Result<(), CommandError> {
    let counts = [("no monitor to predict", ring.read_monitors.len()), ("nothing to fit", ring.parameters.len())];
    match counts.into_iter().find(|(_, count)| *count == 0) {
        Some((what, _)) => Err(CommandError::Input(format!("{}: {what}", ring.name))),
        None => Ok(()),
    }
}

impl Entry {
    fn of(error: &SurrogateError) -> Self {
        Self {
            name: error.name,
            plane: error.plane,
            parameters: error.parameters,
            bytes: error.bytes,
            samples: error.samples,
            rms_mm: error.rms * 1e3,
            max_mm: error.max * 1e3,
            stated_rms_mm: error.stated_rms * 1e3,
        }
    }
}

impl fmt::Display for Check {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let what = "error of the orbit of a kick of 0.4 mrad (the Booster's from -22 A to +22 A) against the twin, vars \
                    within 2 widths of their prior, tunes within 0.05 of the design";
        writeln!(f, "{}\n", fill(what))?;
        let mut table =
            table(["surrogate", "plane", "numbers", "bytes", "vars", "rms/um", "largest/um", "stated rms/um"]);
        for e in &self.surrogates {
            let um = |mm: f64| format!("{:.2}", mm * 1e3);
            table.add_row([
                e.name.to_owned(),
                e.plane.to_string(),
                e.parameters.to_string(),
                e.bytes.to_string(),
                e.samples.to_string(),
                um(e.rms_mm),
                um(e.max_mm),
                um(e.stated_rms_mm),
            ]);
        }
        write!(f, "{table}")
    }
}
