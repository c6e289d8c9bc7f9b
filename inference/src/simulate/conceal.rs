//! Effects put into a recording that was measured: the noise and everything that nobody knows stay as they are.

use twin::{Effect, EffectError, Ring};

use super::campaign::{Hardware, Truth, campaign};
use crate::recording::Recording;

/// The recording with what effects add to its readings and tunes, at the vars that were found: the difference of two simulated campaigns
/// without noise, with them and without, about an orbit through the middle of all magnets.
///
/// # Errors
/// [`EffectError`] if an effect has no place in the ring, or if the machine loses its beam.
pub fn conceal(recording: &Recording, ring: &Ring, vars: &[f64], effects: &[Effect]) -> Result<Recording, EffectError> {
    let noise = vec![0.0; recording.header.noise.len()];
    let perfect = Hardware { misalignment: [0.0; 2], offset: 0.0, noise, jumps: Vec::new(), tune_noise: 0.0 };
    let simulated = |effects| campaign(recording, ring, &Truth { vars, effects, beyond: &[] }, &perfect, 0);
    let (with, without) = (simulated(effects)?, simulated(&[])?);
    let mut concealed = recording.clone();
    for ((row, with), without) in concealed.rows.iter_mut().zip(&with.rows).zip(&without.rows) {
        add(&mut row.reading, &with.reading, &without.reading);
        add(&mut row.tune, &with.tune, &without.tune);
    }
    Ok(concealed)
}

fn add(to: &mut [Option<f64>], with: &[Option<f64>], without: &[Option<f64>]) {
    for (to, change) in to.iter_mut().zip(with.iter().zip(without)) {
        if let (Some(to), (Some(with), Some(without))) = (to, change) {
            *to += with - without;
        }
    }
}
