//! `orbitcal fit`: the batch answer.

use indicatif::ProgressBar;
use inference::{BatchError, BatchFit};

use super::{CommandError, machine, recording};
use crate::answer::Answer;
use crate::cli::{Fit, FitModel, Method};
use crate::output;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Fit) -> Result<(), CommandError> {
    let (Method::Map, FitModel::Twin) = (options.method, options.model);
    let ring = machine(options.common.machine.as_deref())?;
    let recording = recording(&options.recording, &ring)?;
    let spinner = if options.common.quiet { ProgressBar::hidden() } else { ProgressBar::new_spinner() };
    let fit = BatchFit::of(&ring, &recording, |step| spinner.set_message(format!("Gauss-Newton step {step}")));
    spinner.finish_and_clear();
    let fit = fit.map_err(|error| match error {
        BatchError::Stream(error) => CommandError::from(error),
        error => CommandError::Other(format!("{}: {error}", recording.name)),
    })?;
    let answer = Answer::of_fit(&ring, &recording, &fit);
    if let Some(path) = &options.common.json {
        output::json(path, &answer)?;
    }
    if !options.common.quiet && options.common.json.as_deref() != Some("-".as_ref()) {
        answer.print();
        println!("{} Gauss-Newton steps", fit.steps);
    }
    Ok(())
}
