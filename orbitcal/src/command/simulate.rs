//! `orbitcal simulate`: the machine of a plan behind JSON lines, for a soft IOC to put on channels.
//!
//! The first line out is what the channels are. Then, for every line in, `{"set": {CHANNEL: NUMBER}, "seconds": S}`, the next
//! cycle comes out as `{"values": {CHANNEL: [NUMBER or null]}}`. The end of the input is the end.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Write};
use std::path::Path;

use control::Plan;
use control::simulated::{Fault, Settings, SimulatedMachine};
use inference::simulate;
use results::output;
use serde::Deserialize;
use serde_json::json;
use twin::Ring;
use twin::limits::{self, TEXT};

use super::response::vars;
use super::{CommandError, machine};
use crate::cli::Simulate;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Cycle {
    set: BTreeMap<String, f64>,
    seconds: f64,
}

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Simulate) -> Result<(), CommandError> {
    let input = |error: &dyn core::fmt::Display| CommandError::Input(error.to_string());
    let ring = machine(options.machine.as_deref())?;
    let plan = Plan::read(&options.plan, &ring).map_err(|error| input(&error))?;
    let vars = match &options.vars {
        Some(path) => vars(path, &ring)?,
        None => simulate::vars(&ring, true, options.seed).map_err(CommandError::other)?,
    };
    let effects = options.effects.iter().map(|effect| effect.resolve(&ring)).collect::<Result<_, _>>();
    let faults = options.faults.iter().map(|fault| Fault::parse(fault, &ring)).collect::<Result<_, _>>();
    let settings = Settings {
        vars,
        effects: effects.map_err(|error| input(&error))?,
        faults: faults.map_err(|error| input(&error))?,
        settling: options.settling_s,
        seed: options.seed,
    };
    let mut machine = SimulatedMachine::try_new(&plan, &ring, settings).map_err(|error| input(&error))?;
    let mut exact = options.exact.as_deref().map(|path| exact(path, &ring)).transpose()?;
    output::say(json!({"records": machine.records()}))?;
    for line in TEXT.lines(io::stdin().lock()) {
        let line = line.map_err(CommandError::other)?;
        let Cycle { set, seconds } = limits::json(&line).map_err(|error| input(&format!("stdin: {error}")))?;
        let values = machine.cycle(&set, seconds);
        if let Some(file) = &mut exact {
            let readings: Vec<String> = machine.exact_mm().iter().map(|mm| format!("{mm:.6}")).collect();
            writeln!(file, "{},{}", machine.cycles(), readings.join(",")).map_err(CommandError::other)?;
        }
        output::say(json!({"values": values}))?;
    }
    Ok(())
}

/// The file of what is true, with its head.
fn exact(path: &Path, ring: &Ring) -> Result<File, CommandError> {
    let file = File::create(path).and_then(|mut file| {
        writeln!(file, "cycle,{}", ring.monitor_names().join(","))?;
        Ok(file)
    });
    file.map_err(|error| CommandError::Other(format!("{}: {error}", path.display())))
}
