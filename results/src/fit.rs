//! The batch fit of a recording, by Gauss-Newton or by NUTS: the result of `orbitcal fit`, and its page.

use core::fmt::Display;
use core::ops::ControlFlow;
use std::sync::Arc;

use inference::nuts::{self, NutsError, NutsRun, NutsSettings};
use inference::{
    BaseModel, BatchFit, Campaign, Draws, Imitation, Posterior, Prior, Readings, Recording, Reduced, ResponseModel,
    TuneUse,
};
use report::Page;
use twin::Ring;

use crate::campaign::{campaign, expect_modelled};
use crate::error::CommandError;
use crate::fit_page::page;
use crate::fit_result::FitResult;

/// Predictions that the batch fit can make.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FitModel {
    /// The exact twin.
    Twin,
    /// The Green's function with the core's tables, in f64.
    Green,
    /// The network with the core's weights, in f32; of the built-in Booster only.
    Resnet,
    /// The first order about the design, as one step of LOCO takes it.
    Linear,
}

/// What is known of the design.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Design {
    /// It may be off throughout the ring, as decks are ([`BaseModel`]).
    Uncertain,
    /// It is exact but for the vars: for simulated machines, and to compare with fits that take it so.
    Exact,
}

impl Design {
    /// What a fit has amplitudes of.
    fn base(self) -> BaseModel {
        match self {
            Self::Uncertain => BaseModel::SCALES,
            Self::Exact => BaseModel::EXACT,
        }
    }

    /// What vars imitate.
    fn imitation(self, ring: &Ring, recording: &Recording) -> Result<Option<Imitation>, CommandError> {
        match self {
            Self::Uncertain => Ok(Some(Imitation::new(ring, recording)?)),
            Self::Exact => Ok(None),
        }
    }
}

/// The page of a fit.
///
/// # Errors
/// [`CommandError::Other`] where the design or the calibrated ring has no stable motion.
pub fn fit_page(ring: &Ring, recording: &Recording, result: &FitResult) -> Result<Page, CommandError> {
    let failed = |error: &dyn Display| CommandError::Other(format!("{}: {error}", recording.name));
    let made = page(&recording.powered(ring), result).map_err(|error| failed(&error))?;
    made.ok_or_else(|| failed(&"the ring as fitted has no stable motion"))
}

/// Damped Gauss-Newton on the twin; `progress` hears the number of each step.
///
/// # Errors
/// [`CommandError`].
pub fn fit_by_steps(
    ring: &Ring,
    recording: &Recording,
    design: Design,
    progress: impl FnMut(usize),
) -> Result<FitResult, CommandError> {
    let (campaign, fit) = fitted(ring, recording, design.base(), progress)?;
    let imitation = design.imitation(ring, recording)?;
    let notes = vec![format!("{} Gauss-Newton steps", fit.steps)];
    let result = FitResult::of_fit(&campaign, &fit, imitation.as_ref());
    Ok(FitResult { notes, ..result })
}

/// The campaign and its batch fit, measured tunes as readings.
fn fitted(
    ring: &Ring,
    recording: &Recording,
    base: BaseModel,
    progress: impl FnMut(usize),
) -> Result<(Campaign, BatchFit), CommandError> {
    let campaign = campaign(ring, recording)?;
    let fit = BatchFit::best(&campaign, TuneUse::Readings, base, progress)?;
    Ok((campaign, fit))
}

/// NUTS about the Laplace approximation; `progress` as in [`nuts::sample`]. The density has room for kick constants and the scale of RF steps that are off, and
/// its draws get what vars may imitate ([`Imitation`]).
///
/// # Errors
/// [`CommandError`].
pub fn fit_by_draws(
    ring: &Ring,
    recording: &Recording,
    (model, design): (FitModel, Design),
    settings: NutsSettings,
    progress: impl FnMut(usize) -> ControlFlow<()>,
) -> Result<(FitResult, Draws), CommandError> {
    expect_modelled(recording)?;
    let failed = |error: String| CommandError::Other(format!("{}: {error}", recording.name));
    let (campaign, fit) = fitted(ring, recording, design.base(), |_| ())?;
    let imitation = design.imitation(ring, recording)?;
    let reduced = Reduced::from_fit(campaign, fit)?;
    let ring = &reduced.campaign.ring;
    let is_network = model == FitModel::Resnet;
    let model = match model {
        FitModel::Twin => ResponseModel::twin(ring).map_err(|e| failed(e.to_string()))?,
        FitModel::Green => ResponseModel::green(ring).map_err(|e| failed(e.to_string()))?,
        FitModel::Resnet => ResponseModel::resnet(ring)?,
        FitModel::Linear => ResponseModel::linear(ring).map_err(|e| failed(e.to_string()))?,
    };
    let word = model.word();
    let readings = Readings::of_frames(&reduced, &model, TuneUse::Readings);
    let posterior = Posterior::new(model, readings, Prior::from_ring(ring));
    let laplace = posterior.laplace(&reduced.fit.map_params).map_err(|e| failed(e.to_string()))?;
    let names = ring.var_names();
    let posterior = Arc::new(posterior);
    let run = nuts::sample(posterior.clone(), Arc::new(laplace), &names, settings, progress);
    let run = run.map_err(|error| match error {
        NutsError::TooMany(_) => CommandError::Input(error.to_string()),
        _ => failed(error.to_string()),
    })?;
    let draws = imitation.as_ref().map_or_else(|| run.draws.clone(), |one| one.redrawn(&run.draws, settings.seed));
    let result = FitResult::of_draws(&reduced, word, &run, &draws);
    let extrapolated = is_network.then(|| outside(&posterior, &run));
    Ok((FitResult { notes: notes(&run), extrapolated, ..result }, draws))
}

/// Share of the draws outside the range that the model was made for.
fn outside(posterior: &Posterior, run: &NutsRun) -> f64 {
    let is_outside = |draw: &&Vec<f64>| {
        let params: Vec<f64> = draw.iter().map(|var| var.ln()).collect();
        !posterior.model.is_within(&posterior.readings.strength(&params)).unwrap_or(false)
    };
    let draws = || run.draws.chains.iter().flat_map(|chain| &chain.draws);
    draws().filter(is_outside).count() as f64 / draws().count().max(1) as f64
}

/// How well the posterior was sampled.
fn notes(run: &NutsRun) -> Vec<String> {
    let summary = run.draws.summary();
    let largest = summary.iter().map(|s| s.r_hat).fold(0.0, f64::max);
    let bulk = summary.iter().map(|s| s.ess_bulk).fold(f64::INFINITY, f64::min);
    let tail = summary.iter().map(|s| s.ess_tail).fold(f64::INFINITY, f64::min);
    let divergences = run.draws.divergences();
    let cost = 1e6 * run.seconds * run.threads as f64 / run.evaluations as f64;
    let quality = format!(
        "R-hat at most {largest:.4}, effective sample size at least {bulk:.0} (bulk) and {tail:.0} (tail), {divergences} divergences"
    );
    let effort = format!("{} evaluations in {:.1} s: {cost:.0} us each on one core", run.evaluations, run.seconds);
    [quality, effort].into_iter().chain(run.divergences.iter().cloned()).collect()
}
