//! `orbitcal watch`: another process looks on.

use results::output;

use super::{CommandError, check_outputs};
use crate::cli::Watch;
use crate::watch::{WatchOptions, watch};

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Watch) -> Result<(), CommandError> {
    check_outputs([options.trace.as_deref()])?;
    let summary = watch(&WatchOptions {
        service: options.service.clone(),
        trace: options.trace.clone(),
        count: options.count,
        idle: options.idle,
        quiet: options.quiet,
    })
    .map_err(CommandError::other)?;
    if !options.quiet {
        let (seen, lost, restarts) = (summary.seen, summary.lost, summary.restarts);
        output::say(format_args!("{seen} estimates seen, {lost} lost, {restarts} restarts of the publisher"))?;
    }
    Ok(())
}
