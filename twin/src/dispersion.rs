//! Dispersion, momentum compaction and what an RF frequency offset does to the orbit.

use nalgebra::{DMatrix, DVector, Matrix6};

use crate::map::{DELTA, PATH};
use crate::response::{Gradient, Observer, Optics, seen_rows};

/// Momentum step of differences in the RF frequency [1].
const DELTA_STEP: f64 = 1.9e-3;

impl Optics<'_> {
    /// Dispersion seen by an observer [m], momentum deviations closed at any hold.
    pub fn dispersion(&self, observer: &Observer) -> f64 {
        (observer.row * self.dispersive)[0]
    }

    /// The same of some observers.
    pub fn dispersion_of(&self, observers: &[Observer]) -> DVector<f64> {
        DVector::from_iterator(observers.len(), observers.iter().map(|observer| self.dispersion(observer)))
    }

    /// Derivative of [`Optics::dispersion`], rows observers, columns gradients.
    pub fn dispersion_jacobian(&self, observers: &[Observer], gradients: &[Gradient]) -> DMatrix<f64> {
        let seen = seen_rows(observers, &self.closed_at_momentum);
        let sent: Vec<_> = gradients.iter().map(|g| g.kernel * self.dispersive).collect();
        DMatrix::from_fn(observers.len(), gradients.len(), |i, q| {
            -(seen[i][usize::from(gradients[q].place < observers[i].place)] * sent[q])[0]
        })
    }

    /// Momentum compaction `d(path)/(C d(delta))` [1].
    pub fn momentum_compaction(&self) -> f64 {
        (self.orbit.one_turn().row(PATH) * self.dispersive)[0] / self.ring.circumference
    }

    /// Derivative of [`Optics::momentum_compaction`] with respect to each gradient.
    ///
    /// The path driven by a kick equals the dispersion at the kick, so `d(alpha)/dk = -integral(D_x^2 - D_y^2) ds / C`.
    pub fn compaction_jacobian(&self, gradients: &[Gradient]) -> Vec<f64> {
        // a unit source's path: row PATH of the turn, of its closed orbit and of itself
        let path = self.orbit.one_turn().row(PATH) * (self.closed_at_momentum + Matrix6::identity());
        gradients.iter().map(|g| -(path * g.kernel * self.dispersive)[0] / self.ring.circumference).collect()
    }

    /// Transition energy over the rest energy.
    pub fn gamma_transition(&self) -> f64 {
        self.momentum_compaction().powf(-0.5)
    }

    /// Revolution frequency on this orbit, relative to that of the reference particle, less 1.
    pub fn frequency_offset(&self) -> f64 {
        let (p, length) = (&self.ring.particle, self.ring.circumference + self.orbit.end()[PATH]);
        p.beta(self.orbit.at[0][DELTA]) / p.beta(0.0) * self.ring.circumference / length - 1.0
    }

    /// Slip factor `alpha_c - 1/gamma^2` [1].
    pub fn slip_factor(&self) -> f64 {
        self.momentum_compaction() - self.ring.particle.gamma(self.orbit.at[0][DELTA]).powi(-2)
    }

    /// Momentum offset per relative change `b` of the dipoles' field while the RF frequency is held, `1/(gamma^2 eta)` [1]: with the momentum
    /// `p_0 (1 + b)(1 + delta)` the path grows by `alpha_c delta`, and the speed by `(b + delta)/gamma^2` as well.
    pub fn momentum_per_field(&self) -> f64 {
        (self.ring.particle.gamma(self.orbit.at[0][DELTA]).powi(2) * self.slip_factor()).recip()
    }

    /// RF offset for differences of orbits [1], to one digit: it moves the momentum by 1.9e-3 or so, whatever the slip factor. The
    /// Booster's is 2e-4; with half of it the second order of an orbit changes by 5e-5 of its largest.
    pub fn rf_step(&self) -> f64 {
        let step = (self.slip_factor() * DELTA_STEP).abs();
        let digit = 10f64.powi(step.log10().floor() as i32);
        (step / digit).round() * digit
    }

    /// Derivative of the orbit per unit of RF frequency offset, `-D/eta`, rows observers, columns gradients [m per 1/m^2, or per 1/m
    /// of a thin one].
    pub fn rf_jacobian(&self, observers: &[Observer], gradients: &[Gradient]) -> DMatrix<f64> {
        let eta = self.slip_factor();
        let compaction = self.compaction_jacobian(gradients);
        let mut slope = self.dispersion_jacobian(observers, gradients) * (-1.0 / eta);
        for (b, observer) in observers.iter().enumerate() {
            let per_compaction = self.dispersion(observer) / (eta * eta);
            slope.row_mut(b).iter_mut().zip(&compaction).for_each(|(s, c)| *s += per_compaction * c);
        }
        slope
    }
}

#[cfg(test)]
mod tests {
    use super::DELTA;
    use crate::{Hold, Optics, Plane, Ring};

    #[test]
    fn the_boosters_rf_step_is_one_digit() {
        let ring = Ring::booster();
        assert_eq!(Optics::of(&ring, Hold::Momentum { delta: 0.0 }).unwrap().rf_step(), 2e-4);
    }

    /// At a held frequency the field moves the momentum by as much as an RF offset that changes the speed alike; Xsuite's ring gives -1.391.
    #[test]
    fn the_dipoles_field_moves_the_momentum_at_a_held_frequency() {
        let ring = Ring::paper_booster();
        let optics = Optics::of(&ring, Hold::Momentum { delta: 0.0 }).unwrap();
        let per_field = optics.momentum_per_field();
        assert!((per_field + 1.391).abs() < 2e-3, "{per_field}");
        let gamma = ring.particle.gamma(0.0);
        let step = 1e-6;
        let moved = Optics::of(&ring, Hold::Frequency { offset: -step / gamma.powi(2) }).unwrap().orbit.at[0][DELTA];
        assert!((moved / step - per_field).abs() < 1e-3 * per_field.abs(), "{moved}");
    }

    #[test]
    fn dispersion_and_compaction_follow_their_derivatives() {
        let ring = Ring::booster();
        // whatever the hold: both are slopes in momentum
        let optics = Optics::of(&ring, Hold::Frequency { offset: 0.0 }).unwrap();
        let observers = optics.monitor_places(Plane::X);
        let (exact, compaction) = (
            optics.dispersion_jacobian(&observers, &optics.quadrupoles()),
            optics.compaction_jacobian(&optics.quadrupoles()),
        );
        for n in [0, 5, 30] {
            let at = |factor: f64| {
                let mut vars = [1.0; 48];
                vars[n] = factor;
                let ring = ring.with_vars(&vars);
                let optics = Optics::of(&ring, Hold::Momentum { delta: 0.0 }).unwrap();
                let seen: Vec<f64> = optics.monitor_places(Plane::X).iter().map(|o| optics.dispersion(o)).collect();
                (seen, optics.momentum_compaction())
            };
            let (h, k1) = (1e-5, ring.gradients()[n]);
            let (up, down) = (at(1.0 + h), at(1.0 - h));
            for i in 0..observers.len() {
                let numeric = (up.0[i] - down.0[i]) / (2.0 * h * k1);
                assert!(
                    (numeric - exact[(i, n)]).abs() < 1e-5 * exact.column(n).abs().max(),
                    "{numeric} {}",
                    exact[(i, n)]
                );
            }
            let numeric = (up.1 - down.1) / (2.0 * h * k1);
            assert!((numeric - compaction[n]).abs() < 1e-5 * compaction[n].abs(), "{numeric} {}", compaction[n]);
        }
    }
}
