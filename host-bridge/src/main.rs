//! `orbitcal`: read the arguments, run the command, report what went wrong in one line.

use std::process::ExitCode;

use clap::Parser;
use host_bridge::cli::{Cli, Command};
use host_bridge::command::{
    CommandError, challenge, diagnose, fit, prove, replay, response, serve, study, surrogate, watch,
};

fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) if error.use_stderr() => return refuse(&first_line(&error)),
        Err(help) => {
            print!("{help}");
            return ExitCode::SUCCESS;
        }
    };
    let done = match &cli.command {
        Command::Replay(options) => replay::run(options),
        Command::Watch(options) => watch::run(options),
        Command::Response(options) => response::run(options),
        Command::Fit(options) => fit::run(options),
        Command::Study(options) => study::run(options),
        Command::Diagnose(options) => diagnose::run(options),
        Command::Challenge(options) => challenge::run(options),
        Command::Prove(options) => prove::run(options),
        Command::Serve(options) => serve::run(options),
        Command::Surrogate(options) => surrogate::run(options),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(CommandError::Input(message)) => refuse(&message),
        Err(CommandError::Other(message)) => {
            eprintln!("orbitcal: {message}");
            ExitCode::from(1)
        }
    }
}

fn refuse(message: &str) -> ExitCode {
    eprintln!("orbitcal: {message}");
    ExitCode::from(2)
}

/// What clap complains about, without its usage lines.
fn first_line(error: &clap::Error) -> String {
    let text = error.to_string();
    let lines: Vec<&str> = text.lines().map(str::trim).take_while(|line| !line.starts_with("Usage:")).collect();
    let line = lines.join(" ");
    line.trim_start_matches("error: ").split(" For more information").next().unwrap_or_default().trim().to_owned()
}
