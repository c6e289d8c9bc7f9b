//! The settings of a campaign: frames that drive the beam alike.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector};
use twin::Drives;

/// Which frames are of one setting.
pub struct Settings {
    /// Setting of each frame.
    pub of_frame: Vec<usize>,
    /// Corrector that is powered (the strongest kick), and how much, in fifths of the nominal setting.
    powered: Vec<Option<(usize, i64)>>,
}

impl Settings {
    /// Group the frames.
    pub fn of(drives: &Drives) -> Self {
        let (mut known, mut of_frame, mut powered) = (BTreeMap::new(), Vec::new(), Vec::new());
        for frame in 0..drives.kick.nrows() {
            let kick = drives.kick.row(frame).transpose();
            let c = kick.iamax();
            let fifths = (5.0 * kick[c] / drives.nominal_kick).round() as i64;
            let key = ((fifths != 0).then_some((c, fifths)), drives.rf_offset[frame].to_bits());
            let setting = *known.entry(key).or_insert_with(|| {
                powered.push(key.0);
                powered.len() - 1
            });
            of_frame.push(setting);
        }
        Self { of_frame, powered }
    }

    /// The corrector that is powered in a frame, and the sign of its kick.
    pub fn kick(&self, frame: usize) -> Option<(usize, f64)> {
        self.powered[self.of_frame[frame]].map(|(corrector, fifths)| (corrector, fifths.signum() as f64))
    }

    /// Rows frames, columns settings.
    pub fn indicator(&self) -> DMatrix<f64> {
        let mut indicator = DMatrix::zeros(self.of_frame.len(), self.powered.len());
        self.of_frame.iter().enumerate().for_each(|(frame, &setting)| indicator[(frame, setting)] = 1.0);
        indicator
    }

    /// Settings in which a corrector is powered.
    pub fn of_corrector(&self, c: usize) -> Vec<usize> {
        let powered = |&i: &usize| self.powered[i].is_some_and(|(of, _)| of == c);
        (0..self.powered.len()).filter(powered).collect()
    }

    /// What a corrector is set to in each setting, in units of the nominal.
    pub fn strength(&self, c: usize) -> DVector<f64> {
        let set = |powered: &Option<(usize, i64)>| {
            powered.filter(|(of, _)| *of == c).map_or(0.0, |(_, fifths)| 0.2 * fifths as f64)
        };
        DVector::from_iterator(self.powered.len(), self.powered.iter().map(set))
    }

    /// Mean drive of each setting, on the reference orbit, in mid-campaign.
    pub fn means(&self, drives: &Drives) -> Drives {
        let indicator = self.indicator();
        let count = indicator.row_sum();
        let mut kick = indicator.transpose() * &drives.kick;
        kick.row_iter_mut().zip(count.iter()).for_each(|(mut row, count)| row /= *count);
        let rf_offset = (indicator.transpose() * &drives.rf_offset).component_div(&count.transpose());
        let orbit = vec![[0.0; 2]; drives.orbit.len()];
        Drives { kick, rf_offset, time: DVector::zeros(self.powered.len()), nominal_kick: drives.nominal_kick, orbit }
    }
}
