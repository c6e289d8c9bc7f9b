//! `orbitcal watch`: another process looks on.

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
        println!(
            "{} estimates seen, {} lost, {} restarts of the publisher",
            summary.seen, summary.lost, summary.restarts
        );
    }
    Ok(())
}
