//! What the RF holds: the share of the orbit that a held frequency adds, fitted with everything else.
//!
//! A ring holds its RF frequency, share 1, or the momentum of the beam, share 0. A share that is neither within its error tells that the model's dispersion or its
//! momentum compaction is wrong, and decides nothing.

use nalgebra::DVector;
use twin::{Plane, Rf, median};

use crate::descent::{EXACT, descend};
use crate::error::MeasuredError;
use crate::fit::{Fit, Settings, fit, with_model_error};
use crate::folder::Folder;
use crate::model::{Model, Prediction};
use crate::unknowns::{Kind, Unknown};

/// Error bars within which a share is that of a hold, and beyond which it is not.
const NEAR: f64 = 3.0;
/// `ln` Bayes factor from which on the other hold is said [nat].
const DECISIVE: f64 = 10.0;

/// The share of a held frequency.
#[derive(Debug, Clone, PartialEq)]
pub struct Share {
    /// What was believed to be held.
    pub believed: Rf,
    /// 1 where the frequency is held, 0 where the momentum is.
    pub value: f64,
    /// Its standard deviation by the residuals.
    pub scatter: f64,
    /// What the model misses of the measured dispersion, relative: the term is the product of two dispersions, and errors of the model's
    /// dispersion are long waves, which do not average.
    pub systematic: f64,
    /// `ln` Bayes factor of a free share over the believed one, the errors of the model learnt with both [nat].
    pub gain: f64,
}

impl Share {
    /// Of a fitted measurement.
    ///
    /// # Errors
    /// [`MeasuredError`].
    pub fn of_fit(
        folder: &Folder,
        fitted: &Fit,
        settings: &Settings,
        progress: &mut dyn FnMut(&str),
    ) -> Result<Self, MeasuredError> {
        let believed = share_of(settings.rf);
        let place = fitted.groups.iter().map(Vec::len).sum();
        let (mut unknowns, mut values) = (fitted.unknowns.clone(), fitted.values.as_slice().to_vec());
        unknowns.insert(place, Unknown { kind: Kind::HeldFrequency, mean: believed, width: 1.0 });
        values.insert(place, believed);
        let (model, data) = (Model::of(folder, &fitted.groups, settings.rf)?, &fitted.data);
        let weight = data.weight(&fitted.noise, &fitted.residual);
        let start = descend(&model, &unknowns, &data.measured, &weight, (DVector::from_vec(values), EXACT))?;
        let (here, noise, uncertainty) =
            with_model_error(&model, &unknowns, data, (start, fitted.noise.clone()), progress)?;
        let (value, scatter) = (here.values[place], uncertainty.sigma[place]);
        let likelihoods = data.log_likelihood(&noise, &data.residual(&here.prediction))
            - data.log_likelihood(&fitted.noise, &fitted.residual);
        let gain = likelihoods - 0.5 * (value - believed).powi(2) + scatter.ln();
        Ok(Self {
            believed: settings.rf,
            value,
            scatter,
            systematic: dispersion_missed(folder, &here.prediction),
            gain,
        })
    }

    /// The fit with what the share says is held, and how that was fitted.
    ///
    /// # Errors
    /// [`MeasuredError`].
    pub fn fitted(
        &self,
        folder: &Folder,
        fitted: &Fit,
        settings: &Settings,
        progress: &mut dyn FnMut(&str),
    ) -> Result<(Fit, Settings), MeasuredError> {
        let Some(rf) = self.other() else { return Ok((fitted.clone(), *settings)) };
        let settings = Settings { rf, ..*settings };
        Ok((fit(folder, &settings, progress)?, settings))
    }

    /// Standard deviation of the share, both causes together.
    pub fn sigma(&self) -> f64 {
        self.scatter.hypot(self.systematic)
    }

    /// What is held, if it is not what was believed.
    pub fn other(&self) -> Option<Rf> {
        let other = match self.believed {
            Rf::FixedFrequency => Rf::FixedMomentum,
            Rf::FixedMomentum => Rf::FixedFrequency,
        };
        let off = |rf: Rf| (self.value - share_of(rf)).abs() / self.sigma();
        (off(other) < NEAR && off(self.believed) > NEAR && self.gain > DECISIVE).then_some(other)
    }
}

/// Share where something is held.
fn share_of(rf: Rf) -> f64 {
    f64::from(u8::from(rf == Rf::FixedFrequency))
}

/// Scatter of the measured horizontal dispersion about the predicted one, at the scale that suits it best, over the rms of the predicted: by the
/// median, since few monitors are far off. 0 where it was not measured.
fn dispersion_missed(folder: &Folder, at: &Prediction) -> f64 {
    let Some(dispersion) = &folder.dispersion else { return 0.0 };
    let read = (0..folder.monitors.len())
        .filter(|&row| folder.monitors[row].is_used && folder.monitors[row].plane == Plane::X);
    let last = at.matrix.ncols() - 1;
    let pairs: Vec<(f64, f64)> =
        read.map(|row| (dispersion[row], at.matrix[(row, last)])).filter(|(m, _)| m.is_finite()).collect();
    let [squares, product] =
        [pairs.iter().map(|(_, p)| p * p).sum::<f64>(), pairs.iter().map(|(m, p)| m * p).sum::<f64>()];
    let scale = product / squares;
    let rms = scale.abs() * (squares / pairs.len() as f64).sqrt();
    let off = median(pairs.iter().map(|(m, p)| (m - scale * p).abs())).filter(|_| squares != 0.0);
    off.map_or(0.0, |off| 1.4826 * off / rms)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::fit;
    use crate::testing::{NOISE, machine, measured, ring};

    #[test]
    fn the_hold_that_was_not_believed_is_found() {
        let ring = ring();
        let folder = measured(&ring, &machine(&ring, 11), NOISE, 5);
        let share = |rf: Rf| {
            let settings = Settings { rf, ..Settings::default() };
            let fitted = fit(&folder, &settings, &mut |_| ()).unwrap();
            Share::of_fit(&folder, &fitted, &settings, &mut |_| ()).unwrap()
        };
        let [right, wrong] = [Rf::FixedFrequency, Rf::FixedMomentum].map(share);
        assert_eq!((right.other(), wrong.other()), (None, Some(Rf::FixedFrequency)), "{right:?} {wrong:?}");
        assert!((wrong.value - 1.0).abs() < 3.0 * wrong.sigma(), "{wrong:?}");
    }

    #[test]
    fn a_share_that_is_of_neither_hold_decides_nothing() {
        let share =
            |value: f64| Share { believed: Rf::FixedFrequency, value, scatter: 0.02, systematic: 0.0, gain: 400.0 };
        assert_eq!(share(0.30).other(), None);
        assert_eq!(share(0.03).other(), Some(Rf::FixedMomentum));
    }
}
