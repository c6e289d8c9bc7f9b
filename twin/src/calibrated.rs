//! Optics functions of a fitted ring with the error bars of what was fitted: beta, phase advance, dispersion and tunes.

use nalgebra::{DMatrix, DVector};

use crate::lattice::Ring;
use crate::orbit::{Hold, OrbitError};
use crate::response::Optics;
use crate::tune::Tunes;
use crate::twiss::Twiss;

/// Optics functions at some values of what was fitted, and their derivative with respect to each.
#[derive(Debug, Clone)]
pub struct CalibratedOptics {
    /// At the entrance of every element, and once more at the end of the ring.
    pub twiss: Vec<Twiss>,
    /// Tunes with their integer part.
    pub tunes: Tunes,
    /// Rows all numbers of `twiss`, then the tunes; columns what was fitted.
    slopes: DMatrix<f64>,
}

/// Step of each value; truncation and rounding of the central difference stay below 1e-6 of a derivative.
const STEP: f64 = 1e-4;

/// Numbers of one place.
const EACH: usize = 6;

/// Functions `[M]` of values `[N]`, and their derivatives `[M][N]` by central differences of a step of 1e-4: of optics by params, by strength
/// factors and by skew gradients [1/m] to 1e-6.
///
/// # Errors
/// Those of the functions.
pub fn differentiate<E>(
    values: &[f64],
    functions: impl Fn(&[f64]) -> Result<DVector<f64>, E>,
) -> Result<(DVector<f64>, DMatrix<f64>), E> {
    let here = functions(values)?;
    let mut slopes = DMatrix::zeros(here.len(), values.len());
    for j in 0..values.len() {
        let stepped = |step: f64| {
            let mut values = values.to_vec();
            values[j] += step;
            functions(&values)
        };
        slopes.set_column(j, &((stepped(STEP)? - stepped(-STEP)?) / (2.0 * STEP)));
    }
    Ok((here, slopes))
}

impl CalibratedOptics {
    /// Of a ring at params and supplies, as in [`Ring::strengths`].
    ///
    /// # Errors
    /// [`OrbitError`] where there is no stable ring, there or a step of 1e-4 beside it.
    pub fn of(ring: &Ring, params: &[f64], supplies: &[f64]) -> Result<Self, OrbitError> {
        Self::at(params, |params| ring.with_strengths(&ring.strengths(params, supplies)))
    }

    /// Of the ring at some values [N].
    ///
    /// # Errors
    /// As [`CalibratedOptics::of`].
    pub fn at(values: &[f64], ring: impl Fn(&[f64]) -> Ring) -> Result<Self, OrbitError> {
        let (functions, slopes) = differentiate(values, |values| functions(&ring(values)))?;
        let (twiss, tunes) = from_numbers(&functions);
        Ok(Self { twiss, tunes, slopes })
    }

    /// Standard deviations of all functions, from the covariance of what was fitted `[N][N]`: `sigma^2 = J C J^T`.
    pub fn sigma(&self, covariance: &DMatrix<f64>) -> (Vec<Twiss>, Tunes) {
        self.sigma_by(|slopes| (slopes * covariance).component_mul(slopes).column_sum())
    }

    /// The same from the variances `[M]` of combinations of what was fitted, rows `[M][N]`.
    pub fn sigma_by(&self, variances: impl Fn(&DMatrix<f64>) -> DVector<f64>) -> (Vec<Twiss>, Tunes) {
        from_numbers(&variances(&self.slopes).map(|variance| variance.max(0.0).sqrt()))
    }
}

impl Twiss {
    /// Beta-beat `beta/beta_design - 1` of both planes [1]; its error is that of beta over the design's.
    pub fn beta_beat(&self, design: &Self) -> [f64; 2] {
        [0, 1].map(|plane| self.beta[plane] / design.beta[plane] - 1.0)
    }

    fn numbers(&self) -> [f64; EACH] {
        let ([a, b], [c, d], [e, f]) = (self.beta, self.phase_advance, self.dispersion);
        [a, b, c, d, e, f]
    }

    fn from_numbers(numbers: &[f64]) -> Self {
        let pair = |i: usize| [numbers[i], numbers[i + 1]];
        Self { beta: pair(0), phase_advance: pair(2), dispersion: pair(4) }
    }
}

fn functions(ring: &Ring) -> Result<DVector<f64>, OrbitError> {
    let optics = Optics::of(ring, Hold::Momentum { delta: 0.0 })?;
    let (twiss, tunes) = (optics.twiss()?, optics.tunes()?);
    let numbers = twiss.iter().flat_map(Twiss::numbers).chain([tunes.x, tunes.y]);
    Ok(DVector::from_iterator(EACH * twiss.len() + 2, numbers))
}

fn from_numbers(numbers: &DVector<f64>) -> (Vec<Twiss>, Tunes) {
    let (places, tunes) = numbers.as_slice().split_at(numbers.len() - 2);
    (places.chunks(EACH).map(Twiss::from_numbers).collect(), Tunes { x: tunes[0], y: tunes[1] })
}

#[cfg(test)]
mod tests {
    use core::f64::consts::{PI, TAU};

    use super::*;
    use crate::Plane;

    /// `d(beta)/beta = dk L beta_q cos(2|mu - mu_q| - 2 pi Q)/(2 sin 2 pi Q)`, with the opposite sign in x, of a short quadrupole
    /// and elsewhere. Source: S. Y. Lee, Accelerator Physics, ch. 2, effects of gradient errors.
    #[test]
    fn beta_beats_as_the_text_book_says() {
        let ring = Ring::booster();
        let calibrated = CalibratedOptics::of(&ring, &[0.0; 48], &[]).unwrap();
        let (twiss, tunes) = (&calibrated.twiss, calibrated.tunes);
        let (parameter, q) = (3, ring.quadrupoles[3].element);
        let mut covariance = DMatrix::zeros(48, 48);
        covariance[(parameter, parameter)] = 1e-4;
        let (sigma, tune_sigma) = calibrated.sigma(&covariance);
        let k1l = ring.integrated_gradients()[parameter];
        let middle = |plane: usize| {
            let optics = Optics::of(&ring, Hold::Momentum { delta: 0.0 }).unwrap();
            let depth = 0.5 * ring.elements[q].length;
            let plane_of = [Plane::X, Plane::Y][plane];
            (
                optics.beta(crate::Place { element: q, depth }, plane_of),
                0.5 * (twiss[q].phase_advance[plane] + twiss[q + 1].phase_advance[plane]),
            )
        };
        for (plane, tune, tune_sigma) in [(0, tunes.x, tune_sigma.x), (1, tunes.y, tune_sigma.y)] {
            let (beta, phase) = middle(plane);
            for monitor in &ring.monitors {
                let at = &twiss[monitor.element];
                let angle = 2.0 * (at.phase_advance[plane] - phase).abs() - TAU * tune;
                let known = (k1l * beta * angle.cos() / (2.0 * (TAU * tune).sin()) * at.beta[plane]).abs() * 1e-2;
                let ours = sigma[monitor.element].beta[plane];
                // the quadrupole is 0.37 rad thick: 2 % of the largest
                assert!((ours - known).abs() < 0.02 * k1l.abs() * beta * at.beta[plane] * 1e-2, "{ours} {known}");
            }
            let known = k1l.abs() * beta / (4.0 * PI) * 1e-2;
            assert!((tune_sigma / known - 1.0).abs() < 0.03, "{tune_sigma} {known}");
        }
    }

    /// Of each quadrupole alone against the exact derivative of the tunes.
    #[test]
    fn differences_are_derivatives() {
        let ring = Ring::booster();
        let calibrated = CalibratedOptics::of(&ring, &[0.0; 48], &[]).unwrap();
        let optics = Optics::of(&ring, Hold::Momentum { delta: 0.0 }).unwrap();
        for (parameter, quadrupole) in ring.quadrupoles.iter().enumerate() {
            let mut covariance = DMatrix::zeros(48, 48);
            covariance[(parameter, parameter)] = 1.0;
            let (_, tunes) = calibrated.sigma(&covariance);
            let exact = optics.tune_slope(&optics.gradient(quadrupole.element));
            for (ours, exact) in [tunes.x, tunes.y].into_iter().zip(exact) {
                let exact = (exact * ring.gradients()[parameter]).abs();
                assert!((ours / exact - 1.0).abs() < 1e-6, "{ours} {exact}");
            }
        }
    }

    #[test]
    fn the_phase_advances_by_the_tune() {
        let ring = Ring::booster();
        let optics = Optics::of(&ring, Hold::Momentum { delta: 0.0 }).unwrap();
        let (twiss, tunes) = from_numbers(&functions(&ring).unwrap());
        let (first, last) = (twiss[0], twiss[ring.elements.len()]);
        assert!((last.phase_advance[0] - TAU * tunes.x).abs() < 1e-9, "{last:?}");
        assert!((last.phase_advance[1] - TAU * tunes.y).abs() < 1e-9, "{last:?}");
        assert_eq!(first.phase_advance, [0.0; 2]);
        assert!((0..2).all(|plane| (first.beta[plane] / last.beta[plane] - 1.0).abs() < 1e-9));
        let monitor = ring.monitors[5].element;
        assert_eq!(twiss[monitor].dispersion[0], optics.dispersion(&optics.observe(monitor, Plane::X)));
    }

    #[test]
    fn a_ring_beats_against_itself_by_nothing() {
        let (twiss, _) = from_numbers(&functions(&Ring::booster()).unwrap());
        assert_eq!(twiss[3].beta_beat(&twiss[3]), [0.0; 2]);
        let more = Twiss { beta: twiss[3].beta.map(|beta| 1.1 * beta), ..twiss[3] };
        assert!(more.beta_beat(&twiss[3]).iter().all(|beat| (beat - 0.1).abs() < 1e-12));
    }
}
