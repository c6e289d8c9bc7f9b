//! `orbitcal fit`: the batch fit, by Gauss-Newton or by NUTS.

use core::ops::ControlFlow;

use indicatif::ProgressBar;
use inference::Recording;
use inference::nuts::NutsSettings;
use measured::Folder;
use results::{Design, FitResult, fit_by_draws, fit_by_steps, fit_page, output, save_draws};
use twin::Ring;

use super::{CommandError, check_outputs, deliver, machine_with, matrix, progress, recording};
use crate::cli::{Fit, FitModel, Method};

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Fit) -> Result<(), CommandError> {
    if Folder::is_one(&options.recording) {
        if options.exact_design {
            return Err(CommandError::Input(
                "--exact-design is for a recording; a measured matrix has no such room".into(),
            ));
        }
        return matrix::fit(options);
    }
    check(options)?;
    let ring = machine_with(&options.recording, options.common.machine.as_deref(), &options.priors)?;
    let recording = recording(&options.recording, &ring)?;
    let result = match options.method {
        Method::Map => with_spinner(options, &ring, &recording)?,
        Method::Nuts => with_bar(options, &ring, &recording)?,
    };
    if let Some(path) = &options.report {
        output::bytes(path, fit_page(&ring, &recording, &result)?.render().as_bytes())?;
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

fn design(options: &Fit) -> Design {
    if options.exact_design { Design::Exact } else { Design::Uncertain }
}

fn with_spinner(options: &Fit, ring: &Ring, recording: &Recording) -> Result<FitResult, CommandError> {
    let spinner = if options.common.quiet { ProgressBar::hidden() } else { ProgressBar::new_spinner() };
    let result = fit_by_steps(ring, recording, design(options), |step| {
        spinner.set_message(format!("Gauss-Newton step {step}"));
    });
    spinner.finish_and_clear();
    result
}

fn with_bar(options: &Fit, ring: &Ring, recording: &Recording) -> Result<FitResult, CommandError> {
    let settings: NutsSettings = options.sampling.into();
    let bar = progress(settings.chains * (settings.warm_up + settings.draws), "draws", options.common.quiet);
    let sampled = fit_by_draws(ring, recording, (options.model.into(), design(options)), settings, |done| {
        bar.set_position(done as u64);
        ControlFlow::Continue(())
    });
    bar.finish_and_clear();
    let (result, draws) = sampled?;
    if let Some(folder) = &options.save_draws {
        save_draws(&draws, folder)?;
    }
    Ok(result)
}
