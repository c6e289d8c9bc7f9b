//! What commands read, and what is said of a recording before anything is made of it.

use std::path::Path;

use inference::furthest_stray;
use inference::recording::BelievedRf;
use inference::stream::StreamError;
use inference::{Campaign, Recording};
use training::Tables;
use twin::Ring;

use crate::error::CommandError;
use crate::model_file;

/// A recording of a ring, screened.
///
/// # Errors
/// [`CommandError::Input`] if its currents leave no stable ring, with the supply that is furthest from its nominal one.
pub fn campaign(ring: &Ring, recording: &Recording) -> Result<Campaign, CommandError> {
    Campaign::of(ring, recording).map_err(|error| {
        let header = &recording.header;
        let mean = |f: usize| recording.rows.iter().map(|row| row.supply[f]).sum::<f64>() / recording.rows.len() as f64;
        let away = |f: &usize| (mean(*f) / header.nominal[*f]).ln().abs();
        // along a ramp no supply stays at its nominal current
        let steady = if header.ramp.is_given() { 0 } else { header.nominal.len() };
        let furthest = (0..steady).max_by(|one, other| away(one).total_cmp(&away(other)));
        let supply = furthest.map_or_else(String::new, |f| {
            let name = &recording.powered(ring).supplies[f].name;
            format!("; supply {name} is at {:.1} A, its nominal current is {:.1} A", mean(f), header.nominal[f])
        });
        CommandError::Input(format!(
            "{}: no stable ring {} at its currents: {error}{supply}",
            recording.name, ring.name
        ))
    })
}

/// What the header believes to be held that is not the momentum, so that only the exact twin models it.
pub fn not_modelled(recording: &Recording) -> Option<String> {
    let (key, what) = match recording.header.believed_rf {
        BelievedRf::FixedMomentum => return None,
        BelievedRf::FixedFrequency => ("fixed_frequency", "a fixed RF frequency"),
        BelievedRf::RadialLoop => ("radial_loop", "a radial loop"),
    };
    let known_by = "orbitcal fit --method map and orbitcal diagnose do";
    Some(format!("{}: header.toml, believed_rf = {key:?}: this does not model {what}; {known_by}", recording.name))
}

/// The same as an error, where results would be wrong without a word.
///
/// # Errors
/// [`CommandError::Input`].
pub fn expect_modelled(recording: &Recording) -> Result<(), CommandError> {
    not_modelled(recording).map_or(Ok(()), |why| Err(CommandError::Input(why)))
}

/// Distance of a supply at one time in the cycle from its mean over all frames up to which first order in it is enough: at three times
/// as much the vars of simulated machines are off by 1.5 to 2 standard deviations.
const STRAYS: f64 = 5e-4;

/// That supplies follow the ramp too loosely for the core, which takes to first order what they are off their mean.
pub fn strays(ring: &Ring, recording: &Recording) -> Option<String> {
    let stray = furthest_stray(recording).filter(|stray| stray.off.abs() > STRAYS)?;
    let supply = &recording.powered(ring).supplies[stray.supply].name;
    Some(format!(
        "{}: at {} ms supply {supply} is {:+.2} % off its mean over all times in the cycle; this is right up to {:.2} %, orbitcal fit \
         beyond it",
        recording.name,
        stray.milliseconds,
        100.0 * stray.off,
        100.0 * STRAYS
    ))
}

/// Read a recording of a ring.
///
/// # Errors
/// [`CommandError::Input`], also for a measured response matrix.
pub fn recording(path: &Path, ring: &Ring) -> Result<Recording, CommandError> {
    if measured::Folder::is_one(path) {
        let path = path.display();
        let problem = format!("{path} holds a measured response matrix; `fit`, `diagnose` and `compare` read one");
        return Err(CommandError::Input(problem));
    }
    Ok(Recording::read(path, ring)?)
}

/// The core's tables: those of a model file if there is one, or of the ring as designed.
///
/// # Errors
/// [`CommandError::Input`].
pub fn tables(path: Option<&Path>, ring: &Ring) -> Result<Tables, CommandError> {
    match path {
        Some(path) => Ok(model_file::read(path, ring)?),
        None => Ok(training::green::tables(ring).map_err(StreamError::from)?),
    }
}
