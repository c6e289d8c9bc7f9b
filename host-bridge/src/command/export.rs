//! `orbitcal export`: the calibrated ring as a lattice file of another code.

use std::path::Path;

use super::{CommandError, check_outputs, machine};
use crate::cli::Export;
use crate::export::{self, Calibration, ExportError, Lattice};
use crate::output;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Export) -> Result<(), CommandError> {
    check_outputs([Some(options.out.as_path())])?;
    let ring = machine(options.machine.as_deref())?;
    let input = |error: ExportError| CommandError::Input(error.to_string());
    let calibration = Calibration::read(&options.result).map_err(|error| input(error.into()))?;
    let lattice = Lattice::of(&ring, &calibration, &options.result).map_err(input)?;
    let text = export::text(&lattice, options.format);
    if options.out == Path::new("-") {
        return Ok(output::say(text.trim_end())?);
    }
    output::bytes(&options.out, text.as_bytes())?;
    if !options.quiet {
        let remarks: Vec<String> = lattice.remarks.iter().map(|remark| output::fill(remark)).collect();
        output::say(remarks.join("\n"))?;
        output::say(format_args!("{}: {} elements", options.out.display(), lattice.elements.len()))?;
    }
    Ok(())
}
