//! What a surrogate does to the vars: its Laplace approximation beside that of the twin.

use core::error::Error;

use inference::{
    BaseModel, BatchFit, Campaign, Posterior, Prior, Readings, Recording, Reduced, ResponseModel, TuneUse,
};
use nalgebra::{DMatrix, DVector};
use twin::Ring;

use super::Surrogate;
use crate::{repository, truth};

/// Beside the twin's posterior of the same recording.
#[derive(Debug, Clone, Copy)]
pub struct Effect {
    /// Shift of the vars in the twin's standard deviations: rms and largest.
    pub shift: [f64; 2],
    /// Standard deviations over the twin's: least and largest.
    pub width: [f64; 2],
    /// Normalised estimation error squared over the number of vars: 1 on average.
    pub nees: f64,
}

/// A Gaussian in `ln var`.
struct Gaussian {
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
}

/// Of each surrogate that is a model of the host, under its name; the first is the twin.
///
/// # Errors
/// If the recording cannot be read or fitted.
pub fn effects(
    ring: &Ring,
    recording: &str,
    surrogates: &[Surrogate],
) -> Result<Vec<(&'static str, Effect)>, Box<dyn Error>> {
    let campaign = Campaign::of(ring, &Recording::read(&repository(recording), ring)?)?;
    let fit = BatchFit::best(&campaign, TuneUse::Readings, BaseModel::EXACT, |_| ())?;
    let reduced = Reduced::from_fit(campaign, fit)?;
    let truth = DVector::from_iterator(ring.parameters.len(), truth(recording, ring).into_iter().map(f64::ln));
    let twin = posterior(&reduced, ResponseModel::twin(&reduced.campaign.ring)?)?;
    let modelled = surrogates.iter().filter_map(|surrogate| Some((surrogate.name, surrogate.model.clone()?)));
    modelled.map(|(name, model)| Ok((name, effect(&twin, &posterior(&reduced, model)?, &truth)))).collect()
}

fn posterior(reduced: &Reduced, model: ResponseModel) -> Result<Gaussian, Box<dyn Error>> {
    let readings = Readings::of_frames(reduced, &model, TuneUse::Readings);
    let posterior = Posterior::new(model, readings, Prior::from_ring(&reduced.campaign.ring));
    let laplace = posterior.laplace(&reduced.fit.map_params)?;
    let slopes = posterior.coordinates.each().iter().zip(&laplace.centre).map(|(one, u)| one.at(*u).slope);
    let mut factor = laplace.factor;
    factor.row_iter_mut().zip(slopes).for_each(|(mut row, slope)| row *= slope);
    let mean = DVector::from_vec(posterior.coordinates.params(laplace.centre.as_slice()));
    Ok(Gaussian { mean, covariance: &factor * factor.transpose() })
}

fn effect(twin: &Gaussian, own: &Gaussian, truth: &DVector<f64>) -> Effect {
    let count = truth.len() as f64;
    let sigma = |of: &Gaussian| of.covariance.diagonal().map(f64::sqrt);
    let shift = (&own.mean - &twin.mean).component_div(&sigma(twin));
    let width = sigma(own).component_div(&sigma(twin));
    let error = &own.mean - truth;
    let whitened = own.covariance.clone().cholesky().expect("a positive covariance").solve(&error);
    Effect {
        shift: [shift.norm() / count.sqrt(), shift.amax()],
        width: [width.min(), width.max()],
        nees: error.dot(&whitened) / count,
    }
}
