//! `orbitcal fit`: the batch fit, by Gauss-Newton or by NUTS.

use std::sync::Arc;

use indicatif::ProgressBar;
use inference::campaign::supplies_of;
use inference::nuts::{self, NutsRun};
use inference::{BatchFit, Campaign, Posterior, Prior, Readings, Recording, Reduced, ResponseModel, TuneUse};
use measured::Folder;
use twin::Ring;

use super::{
    CommandError, campaign, check_outputs, deliver, expect_modelled, machine_with, matrix, progress, recording,
};
use crate::cli::{Fit, FitModel, Method};
use crate::result::FitResult;
use crate::{fit_page, output};

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Fit) -> Result<(), CommandError> {
    if Folder::is_one(&options.recording) {
        return matrix::fit(options);
    }
    check(options)?;
    let ring = machine_with(options.common.machine.as_deref(), &options.priors)?;
    let recording = recording(&options.recording, &ring)?;
    let result = match options.method {
        Method::Map => by_steps(options, &ring, &recording)?,
        Method::Nuts => by_draws(options, &ring, &recording)?,
    };
    if let Some(path) = &options.report {
        let page = fit_page::page(&recording.powered(&ring), &supplies_of(&recording), &result);
        let page = page.map_err(|error| CommandError::Other(format!("{}: {error}", recording.name)))?;
        output::bytes(path, page.render().as_bytes())?;
    }
    deliver(&options.common, &result)
}

/// See that the options go together and the outputs can be written.
fn check(options: &Fit) -> Result<(), CommandError> {
    if options.method == Method::Map && options.model != FitModel::Twin {
        let refused = "--model green, resnet and linear need --method nuts; Gauss-Newton runs on the twin";
        return Err(CommandError::Input(refused.into()));
    }
    if options.method == Method::Map && options.save_draws.is_some() {
        return Err(CommandError::Input("--save-draws needs --method nuts".into()));
    }
    if options.rf.is_some() {
        return Err(CommandError::Input(
            "--rf is for a measured matrix; a recording's header says what the RF held".into(),
        ));
    }
    check_outputs([options.common.json.as_deref(), options.report.as_deref()])?;
    Ok(options.save_draws.as_deref().map_or(Ok(()), output::check_folder)?)
}

/// Damped Gauss-Newton on the twin.
fn by_steps(options: &Fit, ring: &Ring, recording: &Recording) -> Result<FitResult, CommandError> {
    let (campaign, fit) = fitted(options, ring, recording)?;
    let notes = vec![format!("{} Gauss-Newton steps", fit.steps)];
    Ok(FitResult { notes, ..FitResult::of_fit(&campaign, &fit) })
}

/// The campaign and its batch fit, measured tunes as readings.
fn fitted(options: &Fit, ring: &Ring, recording: &Recording) -> Result<(Campaign, BatchFit), CommandError> {
    let spinner = spinner(options);
    let campaign = campaign(ring, recording)?;
    let fit = BatchFit::of(&campaign, TuneUse::Readings, |step| {
        spinner.set_message(format!("Gauss-Newton step {step}"));
    });
    spinner.finish_and_clear();
    Ok((campaign, fit?))
}

/// NUTS about the Laplace approximation.
fn by_draws(options: &Fit, ring: &Ring, recording: &Recording) -> Result<FitResult, CommandError> {
    expect_modelled(recording)?;
    let failed = |error: String| CommandError::Other(format!("{}: {error}", recording.name));
    let (campaign, fit) = fitted(options, ring, recording)?;
    let reduced = Reduced::of(campaign, fit)?;
    let ring = &reduced.campaign.ring;
    let model = match options.model {
        FitModel::Twin => ResponseModel::twin(ring).map_err(|e| failed(e.to_string()))?,
        FitModel::Green => ResponseModel::green(ring).map_err(|e| failed(e.to_string()))?,
        FitModel::Resnet => ResponseModel::resnet(ring)?,
        FitModel::Linear => ResponseModel::linear(ring).map_err(|e| failed(e.to_string()))?,
    };
    let word = model.word();
    let readings = Readings::of_frames(&reduced, &model, TuneUse::Readings);
    let posterior = Posterior::new(model, readings, Prior::of(ring));
    let laplace = posterior.laplace(&reduced.fit.map_params).map_err(|e| failed(e.to_string()))?;
    let settings = options.sampling.into();
    let nuts::NutsSettings { chains, warm_up, draws, .. } = settings;
    let bar = progress(chains * (warm_up + draws), "draws", options.common.quiet);
    let names = ring.var_names();
    let posterior = Arc::new(posterior);
    let run =
        nuts::sample(posterior.clone(), Arc::new(laplace), &names, settings, |done| bar.set_position(done as u64));
    bar.finish_and_clear();
    let run = run.map_err(|e| failed(e.to_string()))?;
    if let Some(folder) = &options.save_draws {
        run.draws.write(folder).map_err(|e| CommandError::Other(e.to_string()))?;
    }
    let result = FitResult::of_draws(&reduced, word, &run);
    let extrapolated = (options.model == FitModel::Resnet).then(|| outside(&posterior, &run));
    Ok(FitResult { notes: notes(&run), extrapolated, ..result })
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

fn spinner(options: &Fit) -> ProgressBar {
    if options.common.quiet { ProgressBar::hidden() } else { ProgressBar::new_spinner() }
}
