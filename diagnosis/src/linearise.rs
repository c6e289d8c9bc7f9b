//! Readings linearised about the machine that is fitted to them.
//!
//! A fit knows orbits to first order in the kicks; what exact orbits have besides is taken off the readings, for the machine of some fit. Where an
//! effect changes that machine much, the fit without the effect needs readings of its own: on those of the other machine it would be worse than it
//! is, and an effect that is not there, such as a momentum of 5 per mille, seem to be needed.

use nalgebra::DVector;

use super::data::Data;
use super::error::FitError;
use super::fit::Fitted;
use super::hypothesis::Hypothesis;

/// Most linearisations of a fit, and the chi-square of the change by one that calls for the next.
const PASSES: usize = 4;
pub(super) const CURVED: f64 = 4.0;

/// Fit, and linearise the readings about the fitted machine, until they no longer change.
pub(super) fn fit(data: &mut Data, hypothesis: &Hypothesis, guess: &DVector<f64>) -> Result<Fitted, FitError> {
    let mut fitted = Fitted::of(data, hypothesis, guess)?;
    if !fitted.is_poor() && data.trim_each(&fitted.residual) {
        fitted = Fitted::of(data, hypothesis, &fitted.u)?;
    }
    for _ in 0..PASSES {
        let mut linearised = data.clone();
        // a machine that keeps no beam in one of the settings is not the one that was recorded
        let Ok(moved) = linearised.linearise_each(&fitted.machines(data)?) else { break };
        let Ok(again) = Fitted::of(&linearised, hypothesis, &fitted.u) else { break };
        // nor is one that is far off, whose exact orbits may be metres: each pass then goes further away
        if again.is_poor() && again.cost > fitted.cost {
            break;
        }
        (*data, fitted) = (linearised, again);
        if moved < CURVED {
            break;
        }
    }
    Ok(fitted)
}

/// A fit to readings that were linearised about a machine with further effects: the same to readings of its own, where these differ.
pub(super) fn about_itself(data: &Data, mut fitted: Fitted) -> Fitted {
    let mut own = fitted.data(data).clone();
    let linearise = |own: &mut Data, fitted: &Fitted| own.linearise_each(&fitted.machines(own)?);
    for pass in 0..PASSES {
        if fitted.is_poor() {
            break;
        }
        let Ok(moved) = linearise(&mut own, &fitted) else { break };
        if pass == 0 && moved < CURVED {
            break;
        }
        let Ok(again) = Fitted::of(&own, &fitted.hypothesis, &fitted.u) else { break };
        fitted = again.to(&own);
        if moved < CURVED {
            break;
        }
    }
    fitted
}
