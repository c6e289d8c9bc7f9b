//! Whether the beam follows the scatter of the correctors' read-backs: a current that fluctuates moves the orbit, noise of its read-back does not.
//!
//! Repeats of a setting tell. With `D` what the scatter would make of a reading, off the mean of its setting, and `z` the reading, off its own,
//!
//! `z = share D + noise`,      `share = sum z D/sigma^2 / sum D^2/sigma^2`,
//!
//! which is `tau^2/(tau^2 + rho^2)` for fluctuations of `tau` and read-back noise of `rho`. What the beam then does beyond that, `tau rho/sqrt(tau^2 + rho^2)`
//! of each corrector, is noise that the repeats show as that of the monitors.

use nalgebra::{DMatrix, DVector};

use super::setting::Settings;
use crate::recording::Drive;

/// Standard deviations by which repeats must contradict that the beam follows.
const SURE: f64 = 4.0;
/// The least share that it does not follow: gains, and the params that a screening ends with, are off by some percent.
const LEAST: f64 = 0.1;

/// Standard deviations beyond which a reading tells nothing.
const JUMP: f64 = 5.0;

/// What repeats say of the share.
#[derive(Debug, Default)]
pub(super) struct Repeats {
    /// Sum of `z D/sigma^2`.
    moment: f64,
    /// Sum of `D^2/sigma^2`.
    information: f64,
}

impl Repeats {
    /// Of all settings; rows frames, columns monitors: what was read, not a number where nothing was, and the orbits of the kicks as read and of
    /// steady ones [m]; `noise` of the monitors [m]. Which readings count is not asked: with the wrong share hardly any may.
    pub fn learn(
        settings: &Settings,
        readings: &DMatrix<f64>,
        [as_read, steady]: [&DMatrix<f64>; 2],
        noise: &[f64],
    ) -> Self {
        let mut repeats = Self::default();
        let (z, d) = (readings - steady, as_read - steady);
        for setting in 0..settings.count() {
            let frames: Vec<usize> =
                (0..z.nrows()).filter(|&frame| settings.repeatable[frame] == Some(setting)).collect();
            for (b, noise) in noise.iter().enumerate() {
                let read: Vec<usize> = frames.iter().copied().filter(|&frame| !readings[(frame, b)].is_nan()).collect();
                let off_mean = |of: &DMatrix<f64>| {
                    let values: Vec<f64> = read.iter().map(|&frame| of[(frame, b)]).collect();
                    let mean = values.iter().sum::<f64>() / values.len() as f64;
                    values.into_iter().map(move |value| value - mean)
                };
                for (z, d) in off_mean(&z).zip(off_mean(&d)).filter(|(z, d)| z.abs() <= JUMP * noise + d.abs()) {
                    repeats.moment += z * d / noise.powi(2);
                    repeats.information += d * d / noise.powi(2);
                }
            }
        }
        repeats
    }

    /// The share that the beam follows: all, unless the repeats are sure that it does not.
    pub fn share(&self) -> f64 {
        let ignored = 1.0 - (self.moment / self.information).clamp(0.0, 1.0);
        if ignored > LEAST.max(SURE / self.information.sqrt()) { 1.0 - ignored } else { 1.0 }
    }
}

/// Drives of correctors whose current does a share of the scatter of its read-back: about the level of one that is idle, about the mean of its
/// setting of one that is moved.
pub(super) fn followed(as_read: &[Drive], settings: &Settings, share: f64) -> Vec<Drive> {
    let (mut sum, mut frames) =
        (vec![DVector::<f64>::zeros(settings.idle.level.len()); settings.count()], vec![0.0; settings.count()]);
    for (drive, &setting) in as_read.iter().zip(&settings.of_frame) {
        sum[setting] += &drive.kick;
        frames[setting] += 1.0;
    }
    let one = |(frame, drive): (usize, &Drive)| {
        let (moved, setting) = (settings.setting(frame), settings.of_frame[frame]);
        let steady = |c: usize| {
            if moved.moves(c) { sum[setting][c] / frames[setting] } else { settings.idle.level[c] }
        };
        let kick = |c: usize| steady(c) + share * (drive.kick[c] - steady(c));
        // without a level the read-back is all that is known
        let kick = |c: usize| if settings.idle.scatter[c] > 0.0 { kick(c) } else { drive.kick[c] };
        Drive { kick: DVector::from_fn(drive.kick.len(), |c, _| kick(c)), ..drive.clone() }
    };
    as_read.iter().enumerate().map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two correctors about 2e-5 and -1e-5 rad in 40 frames, the first at 2e-4 in four of them, and a monitor that sees their sum.
    fn drives() -> Vec<Drive> {
        let wave = |i: usize, k: f64| 3e-6 * (k * (i * i) as f64).sin();
        let kick = |i: usize| [2e-5 + wave(i, 1.3) + if i % 10 == 3 { 2e-4 } else { 0.0 }, -1e-5 + wave(i, 0.7)];
        let drive =
            |i| Drive { kick: DVector::from_column_slice(&kick(i)), strength: DVector::zeros(0), rf_offset: 0.0 };
        (0..40).map(drive).collect()
    }

    fn orbits(drives: &[Drive]) -> DMatrix<f64> {
        DMatrix::from_iterator(drives.len(), 1, drives.iter().map(|drive| 10.0 * drive.kick.sum()))
    }

    #[test]
    fn repeats_tell_the_share_that_the_beam_follows() {
        let as_read = drives();
        let settings = Settings::from_frames(&as_read, &[0; 40], 2e-4);
        assert_eq!(settings.count(), 2);
        let steady = orbits(&followed(&as_read, &settings, 0.0));
        for share in [0.0, 0.5, 0.95, 1.0] {
            let readings = orbits(&followed(&as_read, &settings, share)).add_scalar(1e-3);
            let learn = |noise| Repeats::learn(&settings, &readings, [&orbits(&as_read), &steady], &[noise]);
            let expected = if share < 0.9 { share } else { 1.0 };
            assert!((learn(1e-6).share() - expected).abs() < 1e-3, "{share}");
            assert_eq!(learn(1e-2).share(), 1.0);
        }
    }
}
