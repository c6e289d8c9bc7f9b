//! Exact orbits and tunes of every setting of a campaign.
//!
//! A horizontal orbit of some mm in the dipoles focuses, as one in a sextupole does, and moves the tunes in proportion to the kick. The tune meter sees
//! that in the mean of many frames, so that tunes of a campaign in which correctors and signs take turns seem to drift.

use nalgebra::{DMatrix, MatrixXx2};
use twin::{Cycle, Drives, EffectError, Machine, Tracked};

use super::settings::Settings;

/// Exact orbits and tunes of every setting.
pub struct Exact {
    /// The settings.
    pub settings: Settings,
    /// Their mean drives.
    pub means: Drives,
    /// Readings less those of the orbit without kicks, rows settings, columns read monitors [m].
    pub readings: DMatrix<f64>,
    /// Tunes less those on the orbit without kicks, rows settings; 0 where kicks leave no stable motion, and of an RF offset.
    shift: MatrixXx2<f64>,
}

impl Exact {
    /// Of a machine that remembers no setting.
    ///
    /// # Errors
    /// [`EffectError`] if the machine keeps no beam in one of the settings.
    pub fn of(machine: &Machine, drives: &Drives) -> Result<Self, EffectError> {
        let settings = Settings::of(drives);
        let means = settings.means(drives);
        let tracked = Tracked::of(machine.clone(), drives.nominal_kick)?;
        let strength = vec![0.0; machine.ring().quadrupoles.len()];
        let cycle = |kick: Vec<f64>, rf_offset: f64| Cycle { kick, strength: strength.clone(), rf_offset, time: 0.0 };
        let (without, plain) = tracked.cycle(&cycle(vec![0.0; drives.kick.ncols()], 0.0))?;
        let mut readings = DMatrix::zeros(settings.count(), without.len());
        let mut shift = MatrixXx2::zeros(settings.count());
        for (i, kick) in means.kick.row_iter().enumerate() {
            let cycle = cycle(kick.iter().copied().collect(), means.rf_offset[i]);
            let read = match tracked.cycle(&cycle) {
                Ok((read, kicked)) => {
                    if cycle.rf_offset == 0.0 {
                        shift.row_mut(i).copy_from_slice(&[kicked.x - plain.x, kicked.y - plain.y]);
                    }
                    read
                }
                Err(_) => tracked.readings(&cycle)?,
            };
            readings.row_mut(i).iter_mut().zip(read.iter().zip(&without)).for_each(|(to, (read, none))| {
                *to = read - none;
            });
        }
        Ok(Self { settings, means, readings, shift })
    }

    /// What kicks do to the tunes, rows frames.
    pub fn tune_shift(&self) -> MatrixXx2<f64> {
        self.shift.select_rows(&self.settings.of_frame)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::Data;
    use crate::testing::template;
    use inference::Campaign;
    use twin::Rf;

    #[test]
    fn tunes_move_in_proportion_to_the_kicks() {
        let (ring, recording) = template();
        let data = Data::of(&Campaign::of(&ring, &recording).unwrap()).unwrap();
        let machine = Machine::new(ring, Rf::FixedMomentum, &[]).unwrap();
        let by = |scale: f64| {
            let drives = Drives { kick: &data.drives.kick * scale, ..data.drives.clone() };
            Exact::of(&machine, &drives).unwrap().tune_shift()
        };
        let (full, turned) = (by(1.0), by(-1.0));
        // a tenth of the tune meter's noise of one frame at most, 5e-4
        assert!(full.amax() > 1e-6 && full.amax() < 5e-5, "{:e}", full.amax());
        assert!((&full + turned).amax() < 0.1 * full.amax(), "second order");
        assert!((&full - by(0.5) * 2.0).amax() < 0.1 * full.amax(), "second order");
    }
}
