//! `orbitcal`: read the arguments, run the command, report what went wrong in one line.

use std::io::Write;
use std::process::ExitCode;

use clap::Parser;
use clap::error::ErrorKind;
use host_bridge::logs;
use orbitcal::Cli;
use results::CommandError;
use results::output::{self, OutputError};

fn main() -> ExitCode {
    logs::start();
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        // a bare `orbitcal` asks what it can do
        Err(help) if help.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand => {
            let _ = write!(std::io::stderr(), "{help}");
            return ExitCode::from(2);
        }
        Err(error) if error.use_stderr() => return refuse(&first_line(&error)),
        Err(help) => return said(output::say(help.to_string().trim_end())),
    };
    match orbitcal::run(&cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(CommandError::Input(message)) => refuse(&message),
        Err(CommandError::Other(message)) => fail(&message),
    }
}

fn said(said: Result<(), OutputError>) -> ExitCode {
    said.map_or_else(|error| fail(&error.to_string()), |()| ExitCode::SUCCESS)
}

fn refuse(message: &str) -> ExitCode {
    output::warn(message);
    ExitCode::from(2)
}

fn fail(message: &str) -> ExitCode {
    output::warn(message);
    ExitCode::from(1)
}

/// What clap complains about, without its usage lines.
fn first_line(error: &clap::Error) -> String {
    let text = error.to_string();
    let lines: Vec<&str> = text.lines().map(str::trim).take_while(|line| !line.starts_with("Usage:")).collect();
    let line = lines.join(" ");
    line.trim_start_matches("error: ").split(" For more information").next().unwrap_or_default().trim().to_owned()
}
