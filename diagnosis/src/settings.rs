//! The settings of a campaign: groups of frames with the same kicks and RF offset.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector};
use twin::Drives;

/// Frames grouped by setting.
pub struct Settings {
    /// Setting of each frame.
    pub of_frame: Vec<usize>,
    /// Correctors that are powered in each setting, and how much, in fifths of the nominal setting.
    powered: Vec<Vec<(usize, i64)>>,
}

/// RF offsets this close belong to the same setting.
const SAME_OFFSET: f64 = 1e-8;

impl Settings {
    /// Group the frames.
    pub fn from_drives(drives: &Drives) -> Self {
        let (mut known, mut powered) = (BTreeMap::new(), Vec::new());
        let mut setting = |frame: usize| {
            let fifths = drives.kick.row(frame).map(|kick| (5.0 * kick / drives.nominal_kick).round() as i64);
            let kicks: Vec<(usize, i64)> =
                fifths.iter().copied().enumerate().filter(|(_, fifths)| *fifths != 0).collect();
            let rf = (drives.rf_offset[frame] / SAME_OFFSET).round() as i64;
            *known.entry((kicks.clone(), rf)).or_insert_with(|| {
                powered.push(kicks);
                powered.len() - 1
            })
        };
        let of_frame = (0..drives.kick.nrows()).map(&mut setting).collect();
        Self { of_frame, powered }
    }

    /// Number of settings.
    pub fn count(&self) -> usize {
        self.powered.len()
    }

    /// The corrector that is powered most in a frame, and the sign of its kick.
    pub fn kick(&self, frame: usize) -> Option<(usize, f64)> {
        let strongest = self.powered[self.of_frame[frame]].iter().max_by_key(|(_, fifths)| fifths.abs());
        strongest.map(|(corrector, fifths)| (*corrector, fifths.signum() as f64))
    }

    /// Rows frames, columns settings.
    pub(crate) fn indicator(&self) -> DMatrix<f64> {
        let mut indicator = DMatrix::zeros(self.of_frame.len(), self.powered.len());
        self.of_frame.iter().enumerate().for_each(|(frame, &setting)| indicator[(frame, setting)] = 1.0);
        indicator
    }

    /// Settings in which a corrector is powered.
    pub fn of_corrector(&self, c: usize) -> Vec<usize> {
        (0..self.powered.len()).filter(|&i| self.powered[i].iter().any(|(of, _)| *of == c)).collect()
    }

    /// Kick of a corrector in each setting, in units of the nominal.
    pub fn strength(&self, c: usize) -> DVector<f64> {
        let set = |powered: &Vec<(usize, i64)>| {
            powered.iter().find(|(of, _)| *of == c).map_or(0.0, |(_, fifths)| 0.2 * *fifths as f64)
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
