//! What supplies and correctors do to the beam in one frame.

use nalgebra::DVector;

use super::frames::Row;
use super::header::Header;
use super::ramp::At;

/// What supplies and correctors do in one frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Drive {
    /// Kick of each corrector [C] [rad].
    pub kick: DVector<f64>,
    /// `ln` of each supply's factor on its gradients [F].
    pub strength: DVector<f64>,
    /// Relative RF offset [1].
    pub rf_offset: f64,
}

impl Drive {
    /// The header's formulas: `k1 = var k1_design p(I/I_nominal)/p(1)/(I_dipole/I_dipole_nominal)`; what is in series with the dipoles
    /// keeps its strength, and a kick falls with the dipoles' current. Along a ramp, at the row's time in the cycle:
    ///
    /// `k1 = var k1_design p(I/I_nominal)/p(I(t)/I_nominal)/(I_dipole/I_dipole(t))`,
    /// `kick = kick_per_A I/(momentum(t) I_dipole/I_dipole(t))`;
    ///
    /// the RF offset is the one that would move the momentum as much at the reference momentum.
    ///
    /// # Panics
    /// If the row's time is not one of the ramp's: such recordings are refused.
    pub fn from_row(header: &Header, row: &Row) -> Self {
        let at = ramp_at(header, row);
        let rigidity = field(header, row).unwrap_or(1.0);
        let strength = |f: usize| (header.gradient(f, row.supply[f]) / (rigidity * at.gradient[f])).ln();
        let stiffness = rigidity * at.momentum;
        let kick =
            row.corrector_current.iter().zip(&header.kick_per_ampere).map(|(current, k)| current * k / stiffness);
        Self {
            kick: DVector::from_iterator(row.corrector_current.len(), kick),
            strength: DVector::from_fn(row.supply.len(), |f, _| strength(f)),
            rf_offset: row.rf_offset / at.slip,
        }
    }
}

/// What drove the beam in each frame.
pub(super) fn in_rows(header: &Header, rows: &[Row]) -> Vec<Drive> {
    rows.iter().map(|row| Drive::from_row(header, row)).collect()
}

/// The ramp's values at the time of a row.
fn ramp_at(header: &Header, row: &Row) -> At {
    header.ramp.at(row.cycle_time, row.supply.len()).expect("the ramp knows the times of its frames")
}

/// Field of the dipoles over the one that is nominal at the row's time in the cycle, where their current is read.
///
/// # Panics
/// If the row's time is not one of the ramp's: such recordings are refused.
pub(crate) fn field(header: &Header, row: &Row) -> Option<f64> {
    Some(header.dipole_field(row.dipole?)? / ramp_at(header, row).dipole)
}

/// Mean `ln` of each supply's factor over all frames [F]; none without frames.
pub(crate) fn mean_supplies(drives: &[Drive]) -> Vec<f64> {
    let supplies = drives.first().map_or(0, |drive| drive.strength.len());
    let mean = |f: usize| drives.iter().map(|drive| drive.strength[f]).sum::<f64>() / drives.len() as f64;
    (0..supplies).map(mean).collect()
}

/// Mean of some drives.
///
/// # Panics
/// Without any.
pub(crate) fn mean(drives: &[&Drive]) -> Drive {
    let share = 1.0 / drives.len() as f64;
    let mut mean = Drive {
        kick: drives[0].kick.map(|_| 0.0),
        strength: drives[0].strength.map(|_| 0.0),
        rf_offset: drives[0].rf_offset,
    };
    for drive in drives {
        mean.kick.axpy(share, &drive.kick, 1.0);
        mean.strength.axpy(share, &drive.strength, 1.0);
    }
    mean
}
