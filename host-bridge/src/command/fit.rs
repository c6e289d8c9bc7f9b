//! `orbitcal fit`: the batch answer, by Gauss-Newton or by NUTS.

use std::sync::Arc;

use indicatif::ProgressBar;
use inference::nuts::{self, NutsRun};
use inference::{BatchFit, Campaign, Posterior, Readings, Recording, ResponseModel, Width};
use twin::Ring;

use super::{CommandError, machine, progress, recording};
use crate::answer::Answer;
use crate::cli::{Fit, FitModel, Method};
use crate::output;

/// Width of the prior of a var, the paper's.
const WIDTH: Width = Width::Lognormal(inference::stream::PRIOR_WIDTH as f64);

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Fit) -> Result<(), CommandError> {
    let ring = machine(options.common.machine.as_deref())?;
    let recording = recording(&options.recording, &ring)?;
    let (answer, remark) = match (options.method, options.model) {
        (Method::Map, FitModel::Twin) => by_steps(options, &ring, &recording)?,
        (Method::Map, FitModel::Green) => {
            return Err(CommandError::Input("--model green needs --method nuts; Gauss-Newton runs on the twin".into()));
        }
        (Method::Nuts, _) => by_draws(options, &ring, &recording)?,
    };
    if let Some(path) = &options.common.json {
        output::json(path, &answer)?;
    }
    if !options.common.quiet && options.common.json.as_deref() != Some("-".as_ref()) {
        answer.print();
        println!("{remark}");
    }
    Ok(())
}

/// Damped Gauss-Newton on the twin.
fn by_steps(options: &Fit, ring: &Ring, recording: &Recording) -> Result<(Answer, String), CommandError> {
    if options.save_draws.is_some() {
        return Err(CommandError::Input("--save-draws needs --method nuts".into()));
    }
    let spinner = spinner(options);
    let fit = BatchFit::of(ring, recording, |step| spinner.set_message(format!("Gauss-Newton step {step}")));
    spinner.finish_and_clear();
    let fit = fit?;
    Ok((Answer::of_fit(ring, recording, &fit), format!("{} Gauss-Newton steps", fit.steps)))
}

/// NUTS about the Laplace approximation.
fn by_draws(options: &Fit, ring: &Ring, recording: &Recording) -> Result<(Answer, String), CommandError> {
    let failed = |error: String| CommandError::Other(format!("{}: {error}", recording.name));
    let spinner = spinner(options);
    let campaign = Campaign::of(ring, recording, |step| spinner.set_message(format!("Gauss-Newton step {step}")));
    spinner.finish_and_clear();
    let campaign = campaign?;
    let model = match options.model {
        FitModel::Twin => ResponseModel::twin(ring).map_err(|e| failed(e.to_string()))?,
        FitModel::Green => ResponseModel::green(ring).map_err(|e| failed(e.to_string()))?,
    };
    let word = model.word();
    let readings = Readings::of_frames(&campaign, &model);
    let posterior = Posterior { model, readings, width: WIDTH };
    let laplace = posterior.laplace(&campaign.fit.map_params).map_err(|e| failed(e.to_string()))?;
    let settings = options.sampling.into();
    let nuts::NutsSettings { chains, warm_up, draws, .. } = settings;
    let bar = progress(chains * (warm_up + draws), "draws", options.common.quiet);
    let names = ring.var_names();
    let run =
        nuts::sample(Arc::new(posterior), Arc::new(laplace), &names, settings, |done| bar.set_position(done as u64));
    bar.finish_and_clear();
    let run = run.map_err(|e| failed(e.to_string()))?;
    if let Some(folder) = &options.save_draws {
        run.draws.write(folder).map_err(|e| CommandError::Other(e.to_string()))?;
    }
    let answer = Answer::of_draws(ring, &campaign, word, &run);
    Ok((answer, remark(&run)))
}

/// How well the posterior was sampled.
fn remark(run: &NutsRun) -> String {
    let summary = run.draws.summary();
    let largest = summary.iter().map(|s| s.r_hat).fold(0.0, f64::max);
    let bulk = summary.iter().map(|s| s.ess_bulk).fold(f64::INFINITY, f64::min);
    let tail = summary.iter().map(|s| s.ess_tail).fold(f64::INFINITY, f64::min);
    let mut text = format!(
        "R-hat at most {largest:.4}, ESS at least {bulk:.0} (bulk) and {tail:.0} (tail), {} divergences\n{} evaluations in {:.1} s: \
         {:.0} us each on one core",
        run.draws.divergences(),
        run.evaluations,
        run.seconds,
        1e6 * run.seconds * run.threads as f64 / run.evaluations as f64,
    );
    run.divergences.iter().for_each(|sentence| text += &format!("\n{sentence}"));
    text
}

fn spinner(options: &Fit) -> ProgressBar {
    if options.common.quiet { ProgressBar::hidden() } else { ProgressBar::new_spinner() }
}
