//! `orbitcal request`: ask something of a running daemon.

use core::time::Duration;
use std::path::{Path, PathBuf};

use results::output;
use shared_memory::{self, Reply, RequestClient};

use super::{CommandError, check_outputs};
use crate::cli::{Ask, Request, Switch};

/// Longest wait for the reply.
const PATIENCE: Duration = Duration::from_secs(10);

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Request) -> Result<(), CommandError> {
    let (request, to) = match &options.ask {
        Ask::Snapshot { out } => {
            check_outputs([Some(out.as_path())])?;
            (shared_memory::Request::Snapshot, Some(out))
        }
        Ask::Reset => (shared_memory::Request::Reset, None),
        Ask::Feedback { state } => (shared_memory::Request::Feedback(*state == Switch::On), None),
        Ask::Model { file } => (shared_memory::Request::Model(whole(file)?), None),
    };
    let mut client = RequestClient::try_new(&options.service).map_err(CommandError::other)?;
    match (client.ask(&request, PATIENCE).map_err(CommandError::other)?, to) {
        (Reply::Done(bytes), Some(out)) => {
            host_bridge::write_checkpoint(out, &bytes)
                .map_err(|error| CommandError::Other(format!("{}: {error}", out.display())))?;
            output::say(format_args!("{}: {} bytes", out.display(), bytes.len()))?;
        }
        (Reply::Done(words), None) => output::say(String::from_utf8_lossy(&words))?,
        (Reply::Refused(why), _) => return Err(CommandError::Other(format!("refused: {why}"))),
    }
    Ok(())
}

/// A path as the daemon, which works in another folder, finds it.
fn whole(file: &Path) -> Result<String, CommandError> {
    let wrong = |reason: &dyn core::fmt::Display| CommandError::Input(format!("{}: {reason}", file.display()));
    let path: PathBuf = std::fs::canonicalize(file).map_err(|error| wrong(&error))?;
    path.into_os_string().into_string().map_err(|_| wrong(&"its name is no UTF-8"))
}
