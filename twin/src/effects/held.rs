//! What a machine holds while its correctors kick, if it is not the momentum: the RF frequency, or the mean orbit of two
//! monitors.
//!
//! With `R` the response at constant momentum, `R_f` that at constant frequency and `D` the dispersion, a share `a` of the
//! frequency held gives `R + a (R_f - R)`, and a share `a` of the mean of monitors i and j held gives
//!
//! `R - D m`, `m = a (R_i + R_j)/(D_i + D_j)` the momentum that brings the mean back.

use nalgebra::DMatrix;

use crate::lattice::{Plane, Ring};
use crate::orbit::{Hold, OrbitError};
use crate::response::{Gradient, Observer, Optics, Source};

#[derive(Debug)]
pub(super) struct Held<'r> {
    /// Optics at constant frequency, and the share of it.
    frequency: Option<(Optics<'r>, f64)>,
    /// The two monitors, and the share of the loop.
    radial: Option<([Observer; 2], f64)>,
}

impl<'r> Held<'r> {
    /// On a ring of these optics at constant momentum: shares of the frequency and of the mean of two monitor places.
    pub(super) fn of(
        ring: &'r Ring,
        optics: &Optics,
        share: f64,
        radial_loop: Option<([usize; 2], f64)>,
    ) -> Result<Self, OrbitError> {
        let offset = optics.frequency_offset();
        let held = || Ok((Optics::of(ring, Hold::Frequency { offset })?, share));
        let frequency = (share != 0.0).then(held).transpose()?;
        let of_place = |place: usize| optics.observe(ring.monitors[place].element, Plane::X);
        let radial = radial_loop.map(|(pair, share)| (pair.map(of_place), share));
        Ok(Self { frequency, radial })
    }

    /// Orbit response, rows observers, columns sources [m/rad].
    pub(super) fn response(&self, optics: &Optics, observers: &[Observer], sources: &[Source]) -> DMatrix<f64> {
        let mut response = self.by_frequency(optics, |optics| optics.response(observers, sources));
        if let Some((pair, share)) = &self.radial {
            let of_pair = self.by_frequency(optics, |optics| optics.response(pair, sources)).row_sum();
            let momentum = of_pair * (share / optics.dispersion_of(pair).sum());
            response -= optics.dispersion_of(observers) * momentum;
        }
        response
    }

    /// Its derivative with respect to a gradient [m/rad per 1/m^2, or per 1/m of a thin one].
    pub(super) fn jacobian(
        &self,
        optics: &Optics,
        observers: &[Observer],
        sources: &[Source],
        gradient: &Gradient,
    ) -> DMatrix<f64> {
        let gradients = core::slice::from_ref(gradient);
        let slope = |observers: &[Observer]| {
            self.by_frequency(optics, |optics| optics.response_jacobian(observers, sources, gradients).remove(0))
        };
        let mut change = slope(observers);
        if let Some((pair, share)) = &self.radial {
            let dispersion = optics.dispersion_of(pair).sum();
            let dispersion_slope = optics.dispersion_jacobian(pair, gradients).sum();
            let momentum = self.by_frequency(optics, |optics| optics.response(pair, sources)).row_sum() / dispersion;
            let momentum_slope = (slope(pair).row_sum() - &momentum * dispersion_slope) / dispersion;
            change -= optics.dispersion_jacobian(observers, gradients) * momentum * *share;
            change -= optics.dispersion_of(observers) * momentum_slope * *share;
        }
        change
    }

    fn by_frequency(&self, optics: &Optics, of: impl Fn(&Optics) -> DMatrix<f64>) -> DMatrix<f64> {
        let at_momentum = of(optics);
        match &self.frequency {
            Some((held, share)) => at_momentum * (1.0 - share) + of(held) * *share,
            None => at_momentum,
        }
    }
}
