//! How far a measurement departs from values of the unknowns that are expected of it: those of an earlier measurement, or of a model that is
//! believed.
//!
//! Magnets may depart by 3 %, skew gradients by 0.003 /m (gradients that are added by 0.003 /m^2), instruments by 1 %; those that clearly depart further by as much as a fit allows. Of a
//! departure `m ± s` with a prior `0 ± w` the `ln` Bayes factor against none is
//!
//! `m^2/(2 s^2) - ln(w/s)`.
//!
//! Source: J. M. Dickey, Ann. Math. Stat. 42 (1971) 204, the ratio of posterior and prior density where nothing departs.

use nalgebra::{DMatrix, DVector};

use crate::chance::deviations;
use crate::data::Data;
use crate::descent::{EXACT, descend};
use crate::error::MeasuredError;
use crate::fit::with_model_error;
use crate::model::Model;
use crate::noise::Noise;
use crate::released::{Held, Released};
use crate::uncertainty::Uncertainty;
use crate::unknowns::{Kind, Unknown, Widths};

/// Standard deviations of departures beforehand.
const DEPARTURES: Widths = Widths { strength: 0.03, skew: 0.003, wiggler: 0.03, gain: 0.01, coupling: 0.01 };

/// Measurements of which anything is said that is not so: one in so many.
const FALSE: f64 = 100.0;

/// Standard deviations from which on one of `unknowns` departs: 3.7 of 48, 4.4 of 900.
pub fn clear(unknowns: usize) -> f64 {
    deviations(FALSE * unknowns.max(1) as f64)
}

/// Values that are expected of the unknowns.
pub struct Expected {
    /// The values.
    pub values: DVector<f64>,
    /// Covariance of their errors, none where they count as exact.
    pub covariance: Option<DMatrix<f64>>,
}

/// Values that are found beside those that are expected.
pub struct Departures {
    /// Unknowns with their expected values, and the priors that they had at the end.
    pub unknowns: Vec<Unknown>,
    /// Values found.
    pub values: DVector<f64>,
    /// How well they are known.
    pub uncertainty: Uncertainty,
    /// Covariance of the departures that the errors of the expected values make, none where these count as exact.
    of_expected: Option<DMatrix<f64>>,
}

impl Departures {
    /// From expected values of the unknowns of a fit. Most things do not depart, and what does may do so by more than is expected: the clearest
    /// departure of an instrument or of a skew gradient is given the prior of the fit, one after the other, until none is clear that is held.
    ///
    /// # Errors
    /// [`MeasuredError`].
    pub fn of(
        model: &Model,
        fitted: &[Unknown],
        expected: &Expected,
        data: &Data,
        progress: &mut dyn FnMut(&str),
    ) -> Result<Self, MeasuredError> {
        let held = fitted.iter().zip(&expected.values);
        let mut unknowns: Vec<Unknown> =
            held.map(|(one, &mean)| Unknown { mean, width: beforehand(one.kind), ..*one }).collect();
        loop {
            let start = descend(model, &unknowns, &data.measured, &data.stated(), (expected.values.clone(), EXACT))?;
            let stated = Noise::stated(data.measured.nrows());
            let (here, noise, uncertainty) = with_model_error(model, &unknowns, data, (start, stated), progress)?;
            let held = Held::of((&unknowns, &here.values, &here.prediction), (data, &noise), &uncertainty.independent);
            let clear = clear(unknowns.len());
            let of_expected = expected.covariance.as_ref().map(|errors| followed(&uncertainty, &unknowns, errors));
            let off = |at: usize, free: Released| {
                // without its prior an unknown follows the data the further by this
                let left = (1.0 - uncertainty.independent[(at, at)] / unknowns[at].width.powi(2)).max(f64::EPSILON);
                let of_expected = of_expected.as_ref().map_or(0.0, |one| one[(at, at)].sqrt() / left);
                (free.value - expected.values[at]).abs() / free.sigma.hypot(unknowns[at].width).hypot(of_expected)
            };
            let off = (0..unknowns.len())
                .filter(|&at| unknowns[at].width < fitted[at].width)
                .filter(|&at| off(at, held.about(at, expected.values[at])) > clear / 2.0)
                .map(|at| (at, off(at, held.released(at, fitted[at].width))))
                .filter(|(_, off)| *off > clear);
            match off.max_by(|a, b| a.1.total_cmp(&b.1)) {
                Some((clearest, _)) => unknowns[clearest].width = fitted[clearest].width,
                None => return Ok(Self { unknowns, values: here.values, uncertainty, of_expected }),
            }
        }
    }

    /// Departure of an unknown with its standard deviation: of a strength or a gain by a share of itself; of a coupling beside the gain, since
    /// electronics scale both; of a skew gradient as it is.
    pub fn change(&self, at: usize) -> (f64, f64) {
        let (before, after) = (self.unknowns[at].mean, self.values[at]);
        let gain = match self.unknowns[at].kind {
            Kind::MonitorCoupling(row) => Some(Kind::MonitorGain(row)),
            Kind::CorrectorCoupling(column) => Some(Kind::CorrectorGain(column)),
            Kind::Skew(_) | Kind::Gradient(_) | Kind::Wiggler(_) | Kind::Moment(..) | Kind::Added(_) => {
                return (after - before, self.sigma(at));
            }
            _ => None,
        };
        match gain.and_then(|gain| self.unknowns.iter().position(|one| one.kind == gain)) {
            Some(gain) => {
                let share = after / self.values[gain];
                let mut combination = DVector::zeros(self.values.len());
                (combination[at], combination[gain]) = (1.0, -share);
                let sigma = self.variance(&combination).sqrt() / self.values[gain].abs();
                (share - before / self.unknowns[gain].mean, sigma)
            }
            None => (after / before - 1.0, (self.sigma(at) / before).abs()),
        }
    }

    /// Standard deviation of the departure of an unknown.
    fn sigma(&self, at: usize) -> f64 {
        let of_expected = self.of_expected.as_ref().map_or(0.0, |one| one[(at, at)]);
        (self.uncertainty.sigma[at].powi(2) + of_expected).sqrt()
    }

    /// Variance of the departure of a combination of unknowns.
    fn variance(&self, combination: &DVector<f64>) -> f64 {
        let of_expected = self.of_expected.as_ref().map_or(0.0, |one| combination.dot(&(one * combination)));
        self.uncertainty.variance(combination) + of_expected
    }

    /// True where a departure is too large for chance.
    pub fn is_clear(&self, (change, sigma): (f64, f64)) -> bool {
        change.abs() > clear(self.unknowns.len()) * sigma
    }

    /// `ln` Bayes factor of an unknown's departure against none [nat].
    pub fn log_evidence_gain(&self, at: usize) -> f64 {
        let (change, sigma) = (self.values[at] - self.unknowns[at].mean, self.sigma(at));
        0.5 * (change / sigma).powi(2) - (self.unknowns[at].width / sigma).ln()
    }
}

/// Covariance of the departures where the expected values have errors and nothing departs: with the precision `P` of the prior about them,
/// `values - expected = (1 - C P) (true - expected)`.
fn followed(uncertainty: &Uncertainty, unknowns: &[Unknown], errors: &DMatrix<f64>) -> DMatrix<f64> {
    let held = DVector::from_iterator(unknowns.len(), unknowns.iter().map(|one| one.width.powi(-2)));
    let by_data =
        DMatrix::identity(unknowns.len(), unknowns.len()) - &uncertainty.independent * DMatrix::from_diagonal(&held);
    &by_data * errors * by_data.transpose()
}

/// Standard deviation of a departure beforehand.
pub fn beforehand(kind: Kind) -> f64 {
    match kind {
        Kind::Strength(_) => DEPARTURES.strength,
        Kind::Skew(_) | Kind::Gradient(_) | Kind::Moment(..) | Kind::Added(_) => DEPARTURES.skew,
        Kind::Wiggler(_) => DEPARTURES.wiggler,
        Kind::MonitorGain(_) | Kind::CorrectorGain(_) | Kind::RfScale | Kind::HeldFrequency => DEPARTURES.gain,
        Kind::MonitorCoupling(_) | Kind::CorrectorCoupling(_) => DEPARTURES.coupling,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_are_said_by_chance() {
        for (unknowns, expected) in [(48, 3.707), (900, 4.394)] {
            assert!((clear(unknowns) - expected).abs() < 0.005, "{}", clear(unknowns));
        }
    }
}
