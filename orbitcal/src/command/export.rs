//! `orbitcal export`: the calibrated ring as a lattice file of another code.

use core::fmt;
use std::path::{Path, PathBuf};

use lattices::export::{self, Calibration, ExportError, Format, Lattice};
use results::{Tunes, output};
use schemars::JsonSchema;
use serde::Serialize;

use super::{CommandError, check_outputs, deliver, machine_named};
use crate::cli::Export;

/// What was written. Field names are those of the command's JSON.
#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct ExportResult<'l> {
    file: PathBuf,
    format: Format,
    machine: &'l str,
    elements: usize,
    /// At the supplies' nominal currents; none without a stable ring.
    tunes: Option<Tunes>,
    remarks: &'l [String],
}

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Export) -> Result<(), CommandError> {
    let (out, json) = (options.out.as_path(), options.common.json.as_deref());
    let to_stdout = out == Path::new("-");
    if to_stdout && json == Some(out) {
        return Err(CommandError::Input("--json - needs --out FILE: both would go to stdout".into()));
    }
    check_outputs([Some(out), json])?;
    let input = |error: ExportError| CommandError::Input(error.to_string());
    let calibration = Calibration::read(&options.result).map_err(|error| input(error.into()))?;
    let ring = machine_named(calibration.lattice.as_deref(), options.common.machine.as_deref())?;
    let lattice = Lattice::of(&ring, &calibration, &options.result).map_err(input)?;
    let (text, result) = (export::text(&lattice, options.format.into()), ExportResult::of(&lattice, options));
    if to_stdout {
        output::say(text.trim_end())?;
        return Ok(json.map_or(Ok(()), |path| output::json(path, &result))?);
    }
    output::bytes(out, text.as_bytes())?;
    deliver(&options.common, &result)
}

impl<'l> ExportResult<'l> {
    fn of(lattice: &'l Lattice, options: &Export) -> Self {
        Self {
            file: options.out.clone(),
            format: options.format.into(),
            machine: &lattice.machine,
            elements: lattice.elements.len(),
            tunes: lattice.tunes.map(|[x, y]| Tunes { x, y, sigma: None }),
            remarks: &lattice.remarks,
        }
    }
}

impl fmt::Display for ExportResult<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.remarks.iter().try_for_each(|remark| writeln!(f, "{}", output::fill(remark)))?;
        write!(f, "{}: {} elements", self.file.display(), self.elements)
    }
}
