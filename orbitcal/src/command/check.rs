//! `orbitcal check`: what a recording holds, and what each command can do with it.

use results::CheckResult;

use super::{CommandError, check_outputs, deliver, machine_for, recording};
use crate::cli::Check;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Check) -> Result<(), CommandError> {
    check_outputs([options.common.json.as_deref()])?;
    let ring = machine_for(&options.recording, options.common.machine.as_deref())?;
    deliver(&options.common, &CheckResult::of(&ring, &recording(&options.recording, &ring)?)?)
}
