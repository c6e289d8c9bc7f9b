//! Tunes that are so close that coupling mixes the planes: both modes are then of both planes, and neither tune tells the focusing of one.
//!
//! With `D` the distance of the tunes without coupling, that of the modes is `sqrt(D^2 + C^2)`, and a change of `D` shows in it by the share
//! `D/sqrt(D^2 + C^2)`, 0.94 where the modes are `3 C` apart. `C` is the closest approach: that of the orbit in the fields of the design, with what rolls of the
//! quadrupoles that are ordinary add to it, `C^2 = sum of (2 roll K1L sqrt(beta_x beta_y)/(2 pi))^2`.
//!
//! Source: G. Guignard, CERN 76-06 (1976).

use core::f64::consts::TAU;
use core::fmt;

use nalgebra::DMatrix;
use twin::{Machine, OrbitError, Plane};

/// The tunes of a recording that are too close.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CloseTunes {
    /// Mean distance of their fractional parts.
    pub distance: f64,
    /// Closest approach that is expected.
    pub approach: f64,
}

/// Ordinary roll of a quadrupole, as surveys leave it [rad].
pub const ROLL: f64 = 0.001;
/// Closest approaches that tunes have to be apart.
const APART: f64 = 3.0;

impl CloseTunes {
    /// Of a machine on its orbit, and tunes as recorded, rows frames; none where they are far enough apart, or not recorded.
    pub fn find(machine: &Machine, recorded: &DMatrix<f64>) -> Result<Option<Self>, OrbitError> {
        let distances = recorded.row_iter().map(|tunes| tunes[0] - tunes[1]).filter(|distance| distance.is_finite());
        let distances: Vec<f64> = distances.map(|distance| (distance - distance.round()).abs()).collect();
        if distances.is_empty() {
            return Ok(None);
        }
        let (distance, optics) = (distances.iter().sum::<f64>() / distances.len() as f64, machine.optics()?);
        let ring = machine.ring();
        let by_roll = ring.quadrupoles.iter().zip(ring.integrated_gradients()).map(|(quadrupole, k1l)| {
            let [x, y] = [Plane::X, Plane::Y].map(|plane| optics.beta(quadrupole.element, plane));
            2.0 * ROLL * k1l * (x * y).sqrt() / TAU
        });
        let approach = by_roll.map(|one| one * one).sum::<f64>().sqrt().hypot(optics.closest_tune_approach()?);
        Ok((distance < APART * approach).then_some(Self { distance, approach }))
    }
}

impl fmt::Display for CloseTunes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { distance, approach } = self;
        write!(
            f,
            "the tunes are {distance:.3} apart, less than three times the closest approach of {approach:.3} that coupling leaves, and are not used"
        )
    }
}

#[cfg(test)]
mod tests {
    use twin::{Effect, Rf};

    use super::*;
    use crate::testing::{template, whitened};

    #[test]
    fn tunes_that_coupling_mixes_are_left_out_and_told() {
        let (ring, mut recording) = template();
        let data = |recording: &_| whitened(&ring, recording);
        let apart = data(&recording);
        assert!(apart.close_tunes.is_none() && apart.tune_noise(0).is_some());
        // as a meter reads two modes next to each other
        recording.rows.iter_mut().for_each(|row| row.tune[1] = row.tune[0].map(|tune| tune + 0.004));
        let close = data(&recording);
        let told = close.close_tunes.unwrap();
        assert!((told.distance - 0.004).abs() < 1e-9 && close.tune_noise(0).is_none());
        let said = told.to_string();
        assert!(
            said.starts_with("the tunes are 0.004 apart, less than three times the closest approach of 0.00"),
            "{said}"
        );
    }

    /// A skew gradient that keeps tunes apart by more than rolls do.
    #[test]
    fn the_closest_approach_is_that_of_the_machine_and_of_rolls() {
        let ring = template().0;
        let of = |effects: &[&str]| {
            let effects: Vec<Effect> = effects.iter().map(|text| Effect::parse(text, &ring).unwrap()).collect();
            let machine = Machine::new(ring.clone(), Rf::FixedMomentum, &effects).unwrap();
            let own = machine.optics().unwrap().closest_tune_approach().unwrap();
            let tunes = DMatrix::from_row_slice(2, 2, &[0.7, 0.699, f64::NAN, 0.7]);
            (CloseTunes::find(&machine, &tunes).unwrap().unwrap(), own)
        };
        let ((plain, none), (coupled, own)) = (of(&[]), of(&["stray_skew_gradient@SLOT_F6=0.02"]));
        assert!(none < 1e-6 && (plain.distance - 1e-3).abs() < 1e-12);
        assert!((coupled.approach - own.hypot(plain.approach)).abs() < 0.05 * coupled.approach && own > plain.approach);
    }
}
