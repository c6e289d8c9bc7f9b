//! `orbitcal import`: a lattice of another code and a response matrix made into the folder that `fit`, `diagnose` and `compare` read.

use std::path::Path;

use measured::Folder;
use measured::import::{
    Conventions, Instruments, Lattice, Measurement, Missing, PerInstrument, Table, agreement, assemble, bare, write,
};
use measured::lattice::ring;
use twin::{Hold, Optics, Rf};

use super::{CommandError, check_outputs, deliver};
use crate::cli::Import;
use crate::import_result::Imported;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Import) -> Result<(), CommandError> {
    if options.common.machine.is_some() {
        return Err(CommandError::Input("--machine is for a recording; the lattice is the machine".into()));
    }
    check_outputs([options.common.json.as_deref()])?;
    let lattice = Lattice::read(&options.lattice)?;
    let instruments = Instruments::choose(&lattice, &options.monitors, &options.correctors)?;
    let tunes = Optics::of(&ring(&bare(&lattice, &instruments)?, &[])?, Hold::Momentum { delta: 0.0 })?.tunes()?;
    let mut result = Imported::of(&lattice, &instruments, [tunes.x, tunes.y]);
    if let (Some(matrix), Some(out)) = (&options.matrix, &options.out) {
        let folder = measurement(options, &lattice, &instruments, matrix, out)?;
        let agreement = agreement(&folder, options.rf.map_or(Rf::FixedFrequency, Into::into))?;
        write(&folder, out)?;
        result = result.with_folder(&out.display().to_string(), &agreement);
    }
    deliver(&options.common, &result)
}

fn measurement(
    options: &Import,
    lattice: &Lattice,
    instruments: &Instruments,
    matrix: &Path,
    out: &Path,
) -> Result<Folder, CommandError> {
    if out.exists() {
        return Err(CommandError::Input(format!("{} exists; it is not overwritten", out.display())));
    }
    let conventions = conventions(options)?;
    let dispersion = options.dispersion.as_deref().map(Table::read).transpose()?;
    let measured = Measurement {
        matrix: &Table::read(matrix)?,
        dispersion: dispersion.as_ref().zip(options.rf_step),
        order: options.order.map(Into::into),
        conventions: &conventions,
    };
    let name = out.file_name().unwrap_or(out.as_os_str()).to_string_lossy().into_owned();
    Ok(Folder { name, ..assemble(lattice, instruments, options.rf_frequency, &measured)? })
}

/// All of them, or everything that is missing.
fn conventions(options: &Import) -> Result<Conventions, CommandError> {
    let (Some(unit), Some(kick), Some(kick_is), Some(signs), Some(noise)) =
        (options.orbit_unit, &options.kick, options.kick_is, options.kick_sign, &options.noise)
    else {
        let asked = [
            (options.orbit_unit.is_none(), Missing::Unit),
            (options.kick.is_none(), Missing::Kick),
            (options.kick_is.is_none(), Missing::KickIs),
            (options.kick_sign.is_none(), Missing::Signs),
            (options.noise.is_none(), Missing::Noise),
        ];
        let missing = asked.iter().filter(|(is_missing, _)| *is_missing).map(|(_, one)| format!("\n  {}", one.words()));
        return Err(CommandError::Input(format!(
            "the matrix does not say, and nothing is guessed:{}",
            missing.collect::<String>()
        )));
    };
    Ok(Conventions {
        unit: unit.into(),
        kick: PerInstrument::parse("--kick", kick)?,
        kick_is: kick_is.into(),
        signs: signs.into(),
        noise: PerInstrument::parse("--noise", noise)?,
    })
}
