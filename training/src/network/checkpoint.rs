//! How far training has come, in a file that appears whole or not at all.

use std::fs;
use std::io;
use std::path::Path;

use super::fit::{Progress, Trainee};
use super::layers::Network;

/// Numbers that the file begins with: which, and how many chunks.
const MAGIC: f32 = 18_400.0;

/// Write both planes.
///
/// # Errors
/// [`io::Error`].
pub fn save(path: &Path, planes: &[Trainee; 2]) -> io::Result<()> {
    let mut bytes = Vec::new();
    let mut put = |numbers: &[f32]| numbers.iter().for_each(|number| bytes.extend(number.to_le_bytes()));
    put(&[MAGIC, planes[0].progress.len() as f32]);
    for plane in planes {
        plane.progress.iter().for_each(|progress| put(&[progress.training, progress.validation]));
        for network in [&plane.network, &plane.free].into_iter().chain(&plane.moments) {
            network.slices().for_each(&mut put);
        }
    }
    let new = path.with_extension("new");
    fs::write(&new, bytes)?;
    fs::rename(new, path)
}

/// Read them into planes of the same sizes; false if there is no such file.
///
/// # Errors
/// [`io::Error`], also of a file of other planes.
pub fn load(path: &Path, planes: &mut [Trainee; 2]) -> io::Result<bool> {
    let bytes = match fs::read(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(false),
        bytes => bytes?,
    };
    let other =
        || io::Error::new(io::ErrorKind::InvalidData, format!("{}: no checkpoint of this training", path.display()));
    let mut numbers = bytes.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes));
    if numbers.next() != Some(MAGIC) {
        return Err(other());
    }
    let chunks = numbers.next().ok_or_else(other)? as usize;
    let of = |network: &Network| network.len();
    let sizes: usize = planes.iter().map(|plane| 2 * chunks + 4 * of(&plane.network)).sum();
    if bytes.len() != 4 * (2 + sizes) {
        return Err(other());
    }
    let mut next = || numbers.next().unwrap_or(f32::NAN);
    for plane in planes {
        plane.progress = (0..chunks).map(|_| Progress { training: next(), validation: next() }).collect();
        for network in [&mut plane.network, &mut plane.free].into_iter().chain(&mut plane.moments) {
            network.slices_mut().flatten().for_each(|number| *number = next());
        }
    }
    Ok(true)
}

#[cfg(test)]
mod tests {
    use twin::Ring;

    use super::super::fit::{Plan, learn, validate, validation};
    use super::super::samples::Source;
    use super::*;

    /// Two chunks with free weights, one with rounded ones.
    const PLAN: Plan = Plan { machines: 64, batch: 256, free: 2, rounded: 1, ..Plan::FULL };

    #[test]
    fn training_that_was_stopped_goes_on_to_the_bit() {
        let source = Source::of(&Ring::booster());
        let validation = validation(&source);
        let fresh = || [0, 1].map(|plane| Trainee::new(&source, plane, &PLAN));
        let path = std::env::temp_dir().join(format!("orbitcal-checkpoint-{}", std::process::id()));
        let (mut whole, mut resumed) = (fresh(), fresh());
        let before = validate(&whole[0].network, &validation[0]);
        for chunk in 0..PLAN.chunks() {
            learn(&source, &PLAN, &mut whole, &validation);
            learn(&source, &PLAN, &mut resumed, &validation);
            save(&path, &resumed).unwrap();
            resumed = fresh();
            assert!(load(&path, &mut resumed).unwrap());
            for (one, other) in whole.iter().zip(&resumed) {
                assert!(
                    (&one.network, &one.free, &one.moments) == (&other.network, &other.free, &other.moments),
                    "{chunk}"
                );
            }
        }
        assert!(validate(&whole[0].network, &validation[0]) < 0.95 * before, "it learns");
        fs::write(&path, [0; 40]).unwrap();
        assert!(load(&path, &mut resumed).is_err(), "no checkpoint");
        fs::remove_file(&path).unwrap();
        assert!(!load(&path, &mut resumed).unwrap());
    }
}
