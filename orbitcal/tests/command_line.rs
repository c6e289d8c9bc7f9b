//! What a user meets at the command line: what is said, where, and with which exit status.

use core::time::Duration;
use std::collections::BTreeSet;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::Instant;

use shared_memory::Subscriber;

/// Longest wait for anything.
const SOON: Duration = Duration::from_secs(60);

const RECORDING: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../recordings/paper-vars");

fn command(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_orbitcal"));
    command.args(arguments).stdin(Stdio::null());
    command
}

fn orbitcal(arguments: &[&str]) -> Output {
    command(arguments).output().expect("the program was built for this test")
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// A service of its own for each test, so that they do not hear each other.
fn service(test: &str) -> String {
    format!("orbitcal/test/{}/{test}", std::process::id())
}

/// Files of a folder.
fn files(folder: &Path) -> Vec<PathBuf> {
    std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect()
}

#[test]
fn a_bare_command_lists_what_there_is() {
    let output = orbitcal(&[]);
    assert_eq!(output.status.code(), Some(2));
    for word in ["Usage:", "replay", "watch", "fit", "study", "diagnose", "serve"] {
        assert!(stderr(&output).contains(word), "{word}: {}", stderr(&output));
    }
    assert_eq!(orbitcal(&["--help"]).status.code(), Some(0));
}

#[test]
fn a_missing_file_is_not_found() {
    for arguments in [
        &["response", "--machine", "/nowhere/ring.json"][..],
        &["response", "--vars", "/nowhere/vars.json"],
        &["replay", RECORDING, "--no-publish", "--model-file", "/nowhere/model"],
        &["replay", "/nowhere", "--no-publish"],
    ] {
        let output = orbitcal(arguments);
        let said = stderr(&output);
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert!(said.lines().count() == 1 && said.trim_end().ends_with(": file not found"), "{arguments:?}: {said}");
    }
}

#[test]
fn outputs_are_checked_before_work_starts() {
    let folder = tempfile::tempdir().unwrap();
    let here = folder.path().display().to_string();
    for (option, command) in [
        ("--json", &["fit", "/nowhere"][..]),
        ("--json", &["replay", "/nowhere"]),
        ("--trace", &["replay", "/nowhere"]),
        ("--trace", &["watch"]),
        ("--report", &["study", "/nowhere"]),
        ("--report", &["diagnose", "/nowhere"]),
        ("--model-out", &["diagnose", "/nowhere"]),
        ("--json", &["response"]),
        ("--json", &["export", "/nowhere", "--as", "madx"]),
        ("--json", &["surrogate", "check"]),
    ] {
        let output = orbitcal(&[command, &[option, "/nonexistent/a"]].concat());
        assert_eq!(
            (output.status.code(), stderr(&output).as_str()),
            (Some(1), "orbitcal: /nonexistent/a: folder not found\n")
        );
        let output = orbitcal(&[command, &[option, &here]].concat());
        assert!(stderr(&output).ends_with(": expected a file, found a folder\n"), "{}", stderr(&output));
    }
    let output = orbitcal(&["fit", "/nowhere", "--method", "nuts", "--save-draws", "/proc/draws"]);
    assert!(
        output.status.code() == Some(1) && stderr(&output).starts_with("orbitcal: /proc/draws: "),
        "{}",
        stderr(&output)
    );
    assert!(files(folder.path()).is_empty());
}

#[test]
fn a_reader_of_stdout_may_leave() {
    for arguments in
        [&["response"][..], &["response", "--json", "-"], &["--help"], &["replay", RECORDING, "--no-publish"]]
    {
        let mut child = command(arguments).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        drop(child.stdout.take()); // as `| head -1` would, only sooner
        let mut said = String::new();
        child.stderr.take().unwrap().read_to_string(&mut said).unwrap();
        assert!(child.wait().unwrap().success() && said.is_empty(), "{arguments:?}: {said}");
    }
}

#[test]
fn nothing_is_wider_than_eighty_columns() {
    let commands = ["check", "replay", "watch", "response", "fit", "study", "diagnose", "export", "challenge", "serve"];
    let help: Vec<[&str; 2]> = commands.iter().map(|command| [*command, "--help"]).collect();
    let results: [&[&str]; 3] =
        [&["replay", RECORDING, "--no-publish"], &["response", "--effect", "quad_roll@D8=0.01"], &["--help"]];
    for arguments in results.into_iter().chain(help.iter().map(<[&str; 2]>::as_slice)) {
        let output = orbitcal(arguments);
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(output.status.success() && !text.is_empty(), "{arguments:?}");
        assert!(text.lines().all(|line| line.chars().count() <= 80), "{text}");
    }
}

#[test]
fn an_interrupted_replay_leaves_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let [trace, json] = ["a.csv", "a.json"].map(|name| folder.path().join(name).display().to_string());
    let name = service("interrupted");
    let mut watch = command(&["watch", "--service", &name, "--idle", "20"]).stdout(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(watch.stdout.take().unwrap()).lines().map(Result::unwrap);
    assert_eq!(lines.next(), Some(format!("listening on {name}")));
    let arguments = [
        "replay",
        RECORDING,
        "--rate",
        "20",
        "--service",
        &name,
        "--name",
        "night shift",
        "--trace",
        &trace,
        "--json",
        &json,
    ];
    let replay = command(&arguments).stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap();
    assert_eq!(lines.next().as_deref(), Some("from night shift: AGS Booster (BNL), deck"));
    assert_eq!(files(folder.path()).len(), 1, "the trace in the making");
    let interrupt = Command::new("kill").args(["-INT", &replay.id().to_string()]).status().unwrap();
    assert!(interrupt.success());
    let output = replay.wait_with_output().unwrap();
    assert_eq!(
        (output.status.code(), stderr(&output).as_str()),
        (Some(1), "orbitcal: interrupted; nothing was written\n")
    );
    assert!(files(folder.path()).is_empty());
    watch.kill().unwrap();
    watch.wait().unwrap();
}

#[test]
fn what_cannot_be_published_is_a_line_and_not_the_end() {
    let long = "x".repeat(300);
    let output = orbitcal(&["replay", RECORDING, "--service", &long]);
    assert_eq!(output.status.code(), Some(2), "a name that can be none: {}", stderr(&output));
    // no room for a fifth publisher
    let name = service("full");
    let arguments = ["replay", RECORDING, "--service", &name, "--rate", "1", "--quiet"];
    let mut busy: Vec<_> = (0..4).map(|_| command(&arguments).spawn().unwrap()).collect();
    let (mut subscriber, mut publishers, start) =
        (Subscriber::try_new(&name).unwrap(), BTreeSet::new(), Instant::now());
    while publishers.len() < busy.len() {
        assert!(start.elapsed() < SOON, "{} publishers of {}", publishers.len(), busy.len());
        publishers.extend(subscriber.wait(Duration::from_secs(1)).unwrap().iter().map(|each| each.stamp.started_ns));
    }
    let output = orbitcal(&["replay", RECORDING, "--service", &name]);
    for one in &mut busy {
        one.kill().unwrap();
        one.wait().unwrap();
    }
    let said = stderr(&output);
    assert!(output.status.success() && said.lines().count() == 1, "{said}");
    assert!(said.starts_with("orbitcal: not published: service ") && said.contains("--no-publish"), "{said}");
    assert!(String::from_utf8_lossy(&output.stdout).contains("chi2/dof"));
}
