//! `orbitcal import`: a lattice of another code and a response matrix, or a LOCO file, made into the folder that `fit`, `diagnose` and `compare` read.

use std::path::Path;

use lattices::import::{
    Conventions, Input, Instruments, Lacking, Lattice, Loco, Measurement, Missing, PerInstrument, Table, agreement,
    assemble, bare, write,
};
use measured::lattice::ring;
use measured::{Folder, Settings};
use results::Imported;
use twin::{Hold, Optics, Rf};

use super::{CommandError, check_outputs, deliver};
use crate::cli::Import;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Import) -> Result<(), CommandError> {
    if options.common.machine.is_some() {
        return Err(CommandError::Input("--machine is for a recording; the lattice is the machine".into()));
    }
    check_outputs([options.common.json.as_deref()])?;
    let lacking = Lacking { kick: kick(options)?, rf: options.rf_frequency };
    let result = match Input::read(&options.lattice, &lacking)? {
        Input::Lattice(lattice) => of_lattice(options, &lattice)?,
        Input::Loco(loco) => of_loco(options, *loco)?,
    };
    deliver(&options.common, &result)
}

/// A lattice, and a matrix if there is one.
fn of_lattice(options: &Import, lattice: &Lattice) -> Result<Imported, CommandError> {
    let instruments = Instruments::choose(lattice, &options.monitors, &options.correctors)?;
    let result = Imported::of(lattice, &instruments, tunes(&bare(lattice, &instruments)?)?);
    match (options.matrix.is_empty(), &options.out) {
        (false, Some(out)) => {
            let folder = measurement(options, lattice, &instruments, out)?;
            made(options, &folder, out, result)
        }
        (true, Some(_)) => {
            Err(CommandError::Input(format!("{} is a lattice alone; --out needs --matrix", lattice.file)))
        }
        _ => Ok(result),
    }
}

/// A file that states everything.
fn of_loco(options: &Import, loco: Loco) -> Result<Imported, CommandError> {
    let Loco { lattice, instruments, folder } = loco;
    expect_unstated(
        &format!("{} is a LOCO file, which states it", lattice.file),
        &[
            ("--matrix", !options.matrix.is_empty()),
            ("--monitors", !options.monitors.is_empty()),
            ("--correctors", !options.correctors.is_empty()),
            ("--orbit-unit", options.orbit_unit.is_some()),
            ("--kick-is", options.kick_is.is_some()),
            ("--kick-sign", options.kick_sign.is_some()),
            ("--noise", options.noise.is_some()),
            ("--order", options.order.is_some()),
        ],
    )?;
    let result = Imported::of(&lattice, &instruments, tunes(&folder)?);
    match &options.out {
        Some(out) => made(options, &Folder { name: name(out)?, ..folder }, out, result),
        None => Ok(result.with_agreement(&agreement(&folder, rf(options))?)),
    }
}

/// None of some options is given, for a reason.
fn expect_unstated(reason: &str, options: &[(&str, bool)]) -> Result<(), CommandError> {
    match options.iter().find(|(_, is_given)| *is_given) {
        Some((option, _)) => Err(CommandError::Input(format!("{reason}; leave {option} out"))),
        None => Ok(()),
    }
}

/// Write the folder, and compare the matrix with the lattice's.
fn made(options: &Import, folder: &Folder, out: &Path, result: Imported) -> Result<Imported, CommandError> {
    let agreement = agreement(folder, rf(options))?;
    write(folder, out, &Settings { rf: rf(options), ..Settings::default() })?;
    Ok(result.with_agreement(&agreement).with_folder(&out.display().to_string()))
}

fn rf(options: &Import) -> Rf {
    options.rf.map_or(Rf::FixedFrequency, Into::into)
}

fn kick(options: &Import) -> Result<Option<PerInstrument>, CommandError> {
    Ok(options.kick.as_deref().map(|kick| PerInstrument::parse("--kick", kick)).transpose()?)
}

fn tunes(folder: &Folder) -> Result<[f64; 2], CommandError> {
    let tunes = Optics::of(&ring(folder, &[], &[])?, Hold::Momentum { delta: 0.0 })?.tunes()?;
    Ok([tunes.x, tunes.y])
}

/// Name of a folder that does not exist yet.
fn name(out: &Path) -> Result<String, CommandError> {
    if out.exists() {
        return Err(CommandError::Input(format!("{} exists; it is not overwritten", out.display())));
    }
    Ok(out.file_name().unwrap_or(out.as_os_str()).to_string_lossy().into_owned())
}

fn measurement(
    options: &Import,
    lattice: &Lattice,
    instruments: &Instruments,
    out: &Path,
) -> Result<Folder, CommandError> {
    let name = name(out)?;
    let blocks = options.matrix.iter().map(|path| Table::read(path));
    let joined = blocks.reduce(|whole, block| whole?.joined(block?)).transpose()?;
    let matrix = joined.expect("a matrix was asked for");
    let conventions = conventions(options, &matrix)?;
    let dispersion = options.dispersion.as_deref().map(Table::read).transpose()?;
    let measured = Measurement {
        matrix: &matrix,
        dispersion: dispersion.as_ref().zip(options.rf_step),
        order: options.order.map(Into::into),
        conventions: &conventions,
    };
    Ok(Folder { name, ..assemble(lattice, instruments, options.rf_frequency, &measured)? })
}

/// All of them, by the file or by the options, or everything that is missing.
fn conventions(options: &Import, matrix: &Table) -> Result<Conventions, CommandError> {
    let stated = &matrix.stated;
    expect_unstated(
        &format!("{} states it", matrix.file),
        &[
            ("--orbit-unit", options.orbit_unit.is_some() && stated.unit.is_some()),
            ("--kick", options.kick.is_some() && stated.kick.is_some()),
            ("--kick-is", options.kick_is.is_some() && stated.kick_is.is_some()),
            ("--order", options.order.is_some() && stated.order.is_some()),
        ],
    )?;
    let unit = options.orbit_unit.map(Into::into).or(stated.unit);
    let kick = kick(options)?.or(stated.kick.map(PerInstrument::All));
    let kick_is = options.kick_is.map(Into::into).or(stated.kick_is);
    let asked = [
        (unit.is_none(), Missing::Unit),
        (kick.is_none(), Missing::Kick),
        (kick_is.is_none(), Missing::KickIs),
        (options.kick_sign.is_none(), Missing::Signs),
        (options.noise.is_none(), Missing::Noise),
    ];
    let (Some(unit), Some(kick), Some(kick_is), Some(signs), Some(noise)) =
        (unit, kick, kick_is, options.kick_sign, &options.noise)
    else {
        let missing = asked.iter().filter(|(is_missing, _)| *is_missing).map(|(_, one)| format!("\n  {}", one.words()));
        return Err(CommandError::Input(format!(
            "the matrix does not say, and nothing is guessed:{}",
            missing.collect::<String>()
        )));
    };
    let noise = PerInstrument::parse("--noise", noise)?;
    Ok(Conventions { unit, kick, kick_is, signs: signs.into(), noise })
}
