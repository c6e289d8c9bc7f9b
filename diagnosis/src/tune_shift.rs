//! What kicks do to the tunes: a horizontal orbit of some mm in the dipoles focuses, as one in a sextupole does, and moves the tunes in proportion to
//! the kick. The tune meter sees that in the mean of many frames, so that tunes of a campaign in which correctors and signs take turns seem to
//! drift.

use nalgebra::MatrixXx2;
use twin::{Cycle, Drives, EffectError, Machine, Tracked};

use super::settings::Settings;

/// Tunes on the orbit of each frame less those on the orbit without kicks, by exact orbits; rows frames. 0 where kicks leave no stable motion.
///
/// # Errors
/// [`EffectError`] if the machine keeps no beam without kicks.
pub fn by_kicks(machine: &Machine, drives: &Drives) -> Result<MatrixXx2<f64>, EffectError> {
    let settings = Settings::of(drives);
    let means = settings.means(drives);
    let strength = vec![0.0; machine.ring().quadrupoles.len()];
    let tracked = Tracked::of(machine.clone(), drives.nominal_kick)?;
    let tunes = |kick: Vec<f64>| tracked.cycle(&Cycle { kick, strength: strength.clone(), rf_offset: 0.0, time: 0.0 });
    let (_, plain) = tunes(vec![0.0; drives.kick.ncols()])?;
    let mut shift = MatrixXx2::zeros(settings.count());
    for (mut row, kick) in shift.row_iter_mut().zip(means.kick.row_iter()) {
        if let Ok((_, kicked)) = tunes(kick.iter().copied().collect()) {
            row.copy_from_slice(&[kicked.x - plain.x, kicked.y - plain.y]);
        }
    }
    Ok(shift.select_rows(&settings.of_frame))
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
            by_kicks(&machine, &Drives { kick: &data.drives.kick * scale, ..data.drives.clone() }).unwrap()
        };
        let (full, turned) = (by(1.0), by(-1.0));
        // a tenth of the tune meter's noise of one frame at most, 5e-4
        assert!(full.amax() > 1e-6 && full.amax() < 5e-5, "{:e}", full.amax());
        assert!((&full + turned).amax() < 0.1 * full.amax(), "second order");
        assert!((&full - by(0.5) * 2.0).amax() < 0.1 * full.amax(), "second order");
    }
}
