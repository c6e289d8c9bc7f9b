//! `orbitcal response`: how the twin's orbit responds to every corrector.

use std::collections::BTreeMap;
use std::path::Path;

use results::{ResponseResult, factors};
use twin::limits::{self, FILE};
use twin::{EffectError, Machine, Rf, Ring};

use super::{CommandError, check_outputs, deliver, machine};
use crate::cli::Response;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Response) -> Result<(), CommandError> {
    check_outputs([options.common.json.as_deref()])?;
    let mut ring = machine(options.common.machine.as_deref())?;
    if let Some(path) = &options.vars {
        ring = ring.with_vars(&vars(path, &ring)?);
    }
    let input = |error: EffectError| CommandError::Input(error.to_string());
    let effects = options.effects.iter().map(|effect| effect.resolve(&ring)).collect::<Result<Vec<_>, _>>();
    let effects = effects.map_err(input)?;
    let machine = Machine::new(ring.clone(), Rf::from(options.rf), &effects).map_err(input)?;
    let response = machine.response().map_err(|error| CommandError::Input(format!("{}: {error}", ring.name)))?;
    let effects = effects.iter().map(|effect| effect.text(&ring).to_string()).collect();
    deliver(&options.common, &ResponseResult::of(&ring, effects, &response))
}

/// Factor of every quadrupole: those in the file, 1 for the others.
pub(super) fn vars(path: &Path, ring: &Ring) -> Result<Vec<f64>, CommandError> {
    let wrong = |what: String| CommandError::Input(format!("{}: {what}", path.display()));
    let text = FILE.text(path).map_err(|e| wrong(twin::unreadable(&e)))?;
    let file: BTreeMap<String, f64> = limits::json(&text).map_err(|e| wrong(e.to_string()))?;
    factors(&file, ring).map_err(wrong)
}
