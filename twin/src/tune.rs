//! Tunes with their integer part, and their derivative with respect to a gradient.

use core::f64::consts::TAU;

use crate::lattice::Plane;
use crate::modes::Modes;
use crate::orbit::OrbitError;
use crate::response::{Gradient, Optics};

/// Tunes with their integer part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tunes {
    /// Horizontal (or the mode that becomes it without coupling).
    pub x: f64,
    /// Vertical.
    pub y: f64,
}

impl Optics<'_> {
    /// Tunes of the two normal modes; the integer part is counted from the projected phase advance.
    ///
    /// # Errors
    /// [`OrbitError::Unstable`] with the half trace, [`OrbitError::SumResonance`].
    pub fn tunes(&self) -> Result<Tunes, OrbitError> {
        let [x, y] = Modes::of(self.orbit.one_turn())?.fractions;
        Ok(Tunes { x: self.count_turns(x, Plane::X), y: self.count_turns(y, Plane::Y) })
    }

    /// Closest approach of the tunes that the coupling leaves, `|C-|`, from the one-turn matrix at the present tunes; for one thin skew
    /// gradient `K1sL sqrt(beta_x beta_y)/(2 pi)`.
    ///
    /// Source: G. Guignard, CERN 76-06 (1976); the form by the matrix is that of MAD-X's `DQMIN`.
    ///
    /// # Errors
    /// As [`Optics::tunes`].
    pub fn closest_tune_approach(&self) -> Result<f64, OrbitError> {
        Ok(Modes::of(self.orbit.one_turn())?.closest_approach())
    }

    /// The tune that has this fractional part, nearest to the projected phase advance.
    fn count_turns(&self, fraction: f64, plane: Plane) -> f64 {
        let phase = self.phase_advances(plane).last().copied().unwrap_or(0.0) / TAU;
        (phase - fraction).round() + fraction
    }

    /// Derivative of both tunes with respect to a gradient; `beta/(4 pi)` for a thin one without coupling. Not a number
    /// where motion is unstable.
    pub fn tune_slope(&self, gradient: &Gradient) -> [f64; 2] {
        let turn = self.orbit.one_turn();
        let modes = Modes::of(turn);
        modes.map_or([f64::NAN; 2], |modes| Modes::tune_slope(&modes.slopes(), turn, &gradient.kernel))
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Matrix4;

    use super::*;
    use serde_json::json;

    use crate::lattice::Kind;
    use crate::testing::ring_of;
    use crate::{Hold, Ring};

    const ON_MOMENTUM: Hold = Hold::Momentum { delta: 0.0 };

    fn tunes_of(ring: &Ring) -> [f64; 2] {
        let tunes = Optics::of(ring, ON_MOMENTUM).unwrap().tunes().unwrap();
        [tunes.x, tunes.y]
    }

    /// Two quadrupoles of opposite gradient that fill the ring: `cos(mu) = cos(phi) cosh(phi)` in both planes. With
    /// `phi = 7/2 pi + 1e-5` a ray that starts at 0 crosses the axis three times, so that `3 pi < mu < 4 pi`.
    #[test]
    fn turns_within_a_quadrupole_are_counted() {
        let phi = 3.5 * core::f64::consts::PI + 1e-5;
        let quadrupole = |k1: f64| json!({"type": "quadrupole", "length": phi, "k1": k1});
        let known = 2.0 - (phi.cos() * phi.cosh()).acos() / TAU;
        for tune in tunes_of(&ring_of(&[quadrupole(1.0), quadrupole(-1.0)])) {
            assert!((tune - known).abs() < 1e-9, "{tune} {known}"); // rounding of phi times cosh(phi)
        }
    }

    /// A bend that is the whole ring: `Q_x = sqrt(1 - n)`, `Q_y = sqrt(n)` with the field index `n = -k1 rho^2`.
    /// Source: S. Y. Lee, Accelerator Physics, ch. 2, weak focusing.
    #[test]
    fn turns_within_a_bend_are_counted() {
        let ring = ring_of(&[json!({"type": "sbend", "length": TAU, "angle": TAU, "k1": -0.4})]);
        for (tune, known) in tunes_of(&ring).into_iter().zip([0.6_f64.sqrt(), 0.4_f64.sqrt()]) {
            assert!((tune - known).abs() < 1e-3, "{tune} {known}"); // twelve slices of half a metre of the body
        }
    }

    /// With coupling, and with both planes on the coupling resonance: derivatives of the modes are those of differences.
    #[test]
    fn tunes_of_coupled_modes_follow_their_slopes() {
        let (mut ring, h) = (crate::testing::mixed(), 1e-5);
        let skew = ring.element("SLOT_F6").unwrap();
        ring.elements[skew].kind = Kind::Multipole { k1l: 0.0, k1sl: 0.05, k2l: 0.0, k3l: 0.0 };
        let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
        for q in [2, 30] {
            let tunes = |factor: f64| {
                let mut factors = [1.0; 48];
                factors[q] = factor;
                tunes_of(&ring.with_strengths(&factors))
            };
            let (up, down) = (tunes(1.0 + h), tunes(1.0 - h));
            let slope = optics.tune_slope(&optics.gradient(ring.quadrupoles[q].element));
            for mode in 0..2 {
                let known = (up[mode] - down[mode]) / (2.0 * h * ring.gradients()[q]);
                assert!((slope[mode] - known).abs() < 1e-5 * known.abs(), "{} {known}", slope[mode]); // rounding 1e-13/h
            }
        }
    }

    #[test]
    fn tunes_follow_their_slopes() {
        let ring = Ring::booster();
        let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
        for (n, at) in ring.quadrupoles.iter().map(|q| q.element).enumerate().step_by(7) {
            let tunes = |factor: f64| {
                let mut vars = [1.0; 48];
                vars[n] = factor;
                Optics::of(&ring.with_vars(&vars), ON_MOMENTUM).unwrap().tunes().unwrap()
            };
            let (h, k1) = (1e-4, ring.gradients()[n]);
            let (up, down, slope) = (tunes(1.0 + h), tunes(1.0 - h), optics.tune_slope(&optics.gradient(at)));
            for (ours, change) in slope.into_iter().zip([up.x - down.x, up.y - down.y]) {
                let known = change / (2.0 * h * k1);
                assert!((ours - known).abs() < 1e-6 * known.abs(), "{ours} {known}"); // truncation h^2, rounding 1e-13/h
            }
        }
        // beta/(4 pi) of a thin gradient, and nothing of a skew one to first order
        let slot = ring.element("SLOT_F6").unwrap();
        let beta = [optics.beta(slot, Plane::X), -optics.beta(slot, Plane::Y)];
        let slope = optics.tune_slope(&optics.thin_gradient(slot.into()));
        slope.into_iter().zip(beta).for_each(|(s, b)| assert!((s * 2.0 * core::f64::consts::TAU - b).abs() < 1e-9));
        assert!(optics.tune_slope(&optics.thin_skew_gradient(slot.into())).iter().all(|s| s.abs() < 1e-12));
    }

    /// The prefactor of the matrix form at tunes apart, `sqrt(s_x s_y)/(s_x + s_y)`, `s` the sines of both phases, is 0.4984 here instead of 1/2.
    #[test]
    fn a_thin_skew_gradient_keeps_the_tunes_apart() {
        let mut ring = Ring::booster();
        let at = ring.element("SLOT_F6").unwrap();
        let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
        let beta = [Plane::X, Plane::Y].map(|plane| optics.beta(at, plane));
        assert!(optics.closest_tune_approach().unwrap() < 1e-9);
        let known = 0.004 * (beta[0] * beta[1]).sqrt() / TAU;
        ring.elements[at].kind = Kind::Multipole { k1l: 0.0, k1sl: 0.004, k2l: 0.0, k3l: 0.0 };
        let ours = Optics::of(&ring, ON_MOMENTUM).unwrap().closest_tune_approach().unwrap();
        assert!((ours / known - 1.0).abs() < 0.005, "{ours} {known}");
    }

    #[test]
    fn instability_names_its_trace() {
        let ring = Ring::booster();
        let strong = ring.with_vars(&[2.2; 48]);
        let error = Optics::of(&strong, ON_MOMENTUM).unwrap().tunes().unwrap_err();
        assert!(matches!(error, OrbitError::Unstable { half_trace, .. } if half_trace.abs() > 1.0), "{error}");
    }

    #[test]
    fn a_rolled_corrector_leaves_the_tunes_alone() {
        for i in 1..40 {
            let mut ring = Ring::booster();
            let at = ring.correctors[i].element;
            ring.elements[at].misalignment.roll = 1.37e-3 * i as f64;
            let tunes = Optics::of(&ring, ON_MOMENTUM).unwrap().tunes().unwrap();
            assert!((tunes.x - 4.831339).abs() < 1e-6 && (tunes.y - 4.666904).abs() < 1e-6, "{tunes:?}");
        }
    }

    #[test]
    fn coupled_modes_keep_their_trace() {
        let mut ring = Ring::booster();
        let at = ring.element("SLOT_F6").unwrap();
        ring.elements[at].kind = Kind::Multipole { k1l: 0.0, k1sl: 0.05, k2l: 0.0, k3l: 0.0 };
        let optics = Optics::of(&ring, ON_MOMENTUM).unwrap();
        let tunes = optics.tunes().unwrap();
        // the modes' cosines sum to half the trace of the 4x4 matrix, and eigenvalues lie on the unit circle
        let m = optics.closed_orbit().one_turn().fixed_view::<4, 4>(0, 0).into_owned();
        let sum = (tunes.x * core::f64::consts::TAU).cos() + (tunes.y * core::f64::consts::TAU).cos();
        assert!((sum - 0.5 * m.trace()).abs() < 1e-12);
        for tune in [tunes.x, tunes.y] {
            let (s, c) = (tune * core::f64::consts::TAU).sin_cos();
            let z = nalgebra::Complex::new(c, s);
            let determinant = (m.map(|v| nalgebra::Complex::new(v, 0.0)) - Matrix4::identity() * z).determinant();
            assert!(determinant.norm() < 1e-10, "{determinant}");
        }
    }
}
