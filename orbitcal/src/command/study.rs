//! `orbitcal study`: the published studies of a recording, as one report.

use results::output;
use studies::{self, Options};

use super::{CommandError, check_outputs, expect_modelled, machine_with, progress, recording};
use crate::cli::Study;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Study) -> Result<(), CommandError> {
    check_outputs([options.common.json.as_deref(), Some(&options.report)])?;
    let ring = machine_with(&options.recording, options.common.machine.as_deref(), &options.priors)?;
    let recording = recording(&options.recording, &ring)?;
    expect_modelled(&recording)?;
    let bar = progress(1, "", options.common.quiet);
    let mut report = |what: &str, done: usize, total: usize| {
        bar.set_message(what.to_owned());
        bar.set_length(total as u64);
        bar.set_position(done as u64);
    };
    let made = studies::run(&ring, &recording, Options { nuts: options.sampling.into() }, &mut report);
    bar.finish_and_clear();
    let made = made.map_err(|error| CommandError::Other(format!("{}: {error}", recording.name)))?;
    output::bytes(&options.report, made.page.render().as_bytes())?;
    if let Some(path) = &options.common.json {
        output::json(path, &made.numbers)?;
    }
    if !options.common.speaks() {
        return Ok(());
    }
    Ok(output::say(format_args!("{}\n\n{}", output::fill(&made.page.lead), options.report.display()))?)
}
