//! `orbitcal watch`: another process looks on.

use std::io::Write;

use super::{CommandError, machine};
use crate::cli::Watch;
use crate::watch::{WatchOptions, watch};

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Watch) -> Result<(), CommandError> {
    let ring = machine(options.machine.as_deref())?;
    let summary = watch(
        &WatchOptions {
            service: options.service.clone(),
            trace: options.trace.clone(),
            count: options.count,
            idle: options.idle,
            quiet: options.quiet,
        },
        &ring,
    )
    .map_err(|error| CommandError::Other(error.to_string()))?;
    if !options.quiet {
        let (seen, lost, restarts) = (summary.seen, summary.lost, summary.restarts);
        // a reader of stdout that has gone, as in `watch | head`, is no error
        let _ = writeln!(std::io::stdout(), "{seen} estimates seen, {lost} lost, {restarts} restarts of the publisher");
    }
    Ok(())
}
