//! Exact orbits and tunes of every setting of a campaign.
//!
//! A horizontal orbit of some mm in the dipoles focuses, as one in a sextupole does, and moves the tunes in proportion to the kick. The tune meter sees
//! that in the mean of many frames, so that tunes of a campaign in which correctors and signs take turns seem to drift.

use inference::Settings;
use nalgebra::{DMatrix, MatrixXx2};
use twin::{Cycle, Drives, EffectError, Machine, Tracked, Tunes};

/// Exact orbits and tunes of every setting.
pub struct Exact {
    /// The settings.
    pub settings: Settings,
    /// Their mean drives.
    pub means: Drives,
    /// Readings less those of the orbit without kicks, rows settings, columns read monitors [m].
    pub readings: DMatrix<f64>,
    /// Tunes, rows settings; with an RF offset, and where kicks leave no stable motion, those without kicks.
    pub tunes: MatrixXx2<f64>,
    /// Tunes on the orbit without kicks, in mid-campaign.
    pub without_kicks: Tunes,
    /// The same at the start and at the end, where the machine drifts.
    pub ends: Option<[Tunes; 2]>,
}

impl Exact {
    /// Of a machine that remembers no setting.
    ///
    /// # Errors
    /// [`EffectError`] if the machine keeps no beam in one of the settings.
    pub fn from_machine(machine: &Machine, drives: &Drives) -> Result<Self, EffectError> {
        let settings = Settings::from_drives(drives);
        let means = settings.means(drives);
        let tracked = Tracked::of(machine.clone(), drives.nominal_kick)?;
        let strength = vec![0.0; machine.ring().quadrupoles.len()];
        let cycle = |kick: Vec<f64>, rf_offset: f64| Cycle { kick, strength: strength.clone(), rf_offset, time: 0.0 };
        let still = cycle(vec![0.0; drives.kick.ncols()], 0.0);
        let (without, plain) = tracked.cycle(&still)?;
        let tunes_at = |time: f64| Ok::<_, EffectError>(tracked.cycle(&Cycle { time, ..still.clone() })?.1);
        let ends = if machine.drift() == 0.0 { None } else { Some([tunes_at(-1.0)?, tunes_at(1.0)?]) };
        let mut readings = DMatrix::zeros(settings.count(), without.len());
        let mut tunes = MatrixXx2::from_fn(settings.count(), |_, plane| [plain.x, plain.y][plane]);
        for (i, kick) in means.kick.row_iter().enumerate() {
            let cycle = cycle(kick.iter().copied().collect(), means.rf_offset[i]);
            let read = match tracked.cycle(&cycle) {
                Ok((read, kicked)) => {
                    if cycle.rf_offset == 0.0 {
                        tunes.row_mut(i).copy_from_slice(&[kicked.x, kicked.y]);
                    }
                    read
                }
                Err(_) => tracked.readings(&cycle)?,
            };
            readings.row_mut(i).iter_mut().zip(read.iter().zip(&without)).for_each(|(to, (read, none))| {
                *to = read - none;
            });
        }
        Ok(Self { settings, means, readings, tunes, without_kicks: plain, ends })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{template, whitened};
    use inference::recording::Row;
    use inference::simulate::{self, Hardware};
    use twin::{Kind, Plane, Rf};

    #[test]
    fn tunes_move_in_proportion_to_the_kicks() {
        let (ring, recording) = template();
        let data = whitened(&ring, &recording);
        let machine = Machine::new(ring, Rf::FixedMomentum, &[]).unwrap();
        let by = |scale: f64| {
            let drives = Drives { kick: &data.drives.kick * scale, ..data.drives.clone() };
            let Exact { settings, tunes, without_kicks: Tunes { x, y }, .. } =
                Exact::from_machine(&machine, &drives).unwrap();
            tunes.map_with_location(|_, plane, tune| tune - [x, y][plane]).select_rows(&settings.of_frame)
        };
        let (full, turned) = (by(1.0), by(-1.0));
        // a tenth of the tune meter's noise of one frame at most, 5e-4
        assert!(full.amax() > 1e-6 && full.amax() < 5e-5, "{:e}", full.amax());
        assert!((&full + turned).amax() < 0.1 * full.amax(), "second order");
        assert!((&full - by(0.5) * 2.0).amax() < 0.1 * full.amax(), "second order");
    }

    /// K2L = 2 /m^2 beside a monitor in a misaligned ring: what the orbit there does to the tunes, up to 0.005, is known as well as that orbit is.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn the_orbit_in_a_sextupole_moves_the_tunes() {
        let (mut ring, recording) = template();
        let at = ring.element("SXH_E6").unwrap();
        ring.elements[at].kind = Kind::Sextupole { k2: 2.0 / ring.elements[at].length };
        let noise = vec![0.0; ring.read_monitors.len()];
        let ideal = Hardware { misalignment: [1.8e-4; 2], offset: 0.0, noise, jumps: Vec::new(), tune_noise: 0.0 };
        for seed in 0..4 {
            let truth = simulate::Truth { vars: &[1.0; 48], ..Default::default() };
            let made = simulate::campaign(&recording, &ring, &truth, &ideal, seed).unwrap();
            let data = whitened(&ring, &made);
            let at_supplies = ring.with_strengths(&ring.strengths(&[], &data.supplies));
            let design = Machine::new(at_supplies, Rf::FixedMomentum, &[]).unwrap();
            let optics = design.optics().unwrap();
            let tunes = optics.tunes().unwrap();
            for (plane, tune) in [tunes.x, tunes.y].into_iter().enumerate() {
                let is_still = |row: &&Row| row.correctors.iter().all(|(_, current)| current.abs() < 1.0);
                let still = made.rows.iter().filter(is_still);
                let off: Vec<f64> = still.filter_map(|row| Some(row.tune[plane]? - tune.rem_euclid(1.0))).collect();
                let off = off.iter().sum::<f64>() / off.len() as f64;
                let beta = optics.beta(at, [Plane::X, Plane::Y][plane]);
                let sigma = 2.0 * data.baseline.sigma[at][0] * beta / (4.0 * core::f64::consts::PI);
                let found = data.tune_shift_of_orbit[plane];
                // and the ripple of the supplies
                assert!((off - found).abs() < 3.0 * sigma + 3e-4, "{off} {found} ± {sigma}");
                assert!(seed != 1 || found.abs() > 3.0 * sigma, "{found} ± {sigma}");
            }
        }
    }
}
