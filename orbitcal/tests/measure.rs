//! `orbitcal measure` and `simulate` as users run them, without a control system.

use std::io::Write;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use serde_json::Value;

const PLAN: &str = "config/measure-booster.toml";

fn command(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_orbitcal"));
    command.args(arguments).current_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join(".."));
    command
}

fn refused(arguments: &[&str], status: i32) -> String {
    let run: Output = command(arguments).output().unwrap();
    assert_eq!(run.status.code(), Some(status), "{run:?}");
    String::from_utf8(run.stderr).unwrap()
}

#[test]
fn what_cannot_be_measured_is_said_in_one_line() {
    let said = refused(&["measure", "nowhere.toml", "--dry-run"], 2);
    assert_eq!(said, "orbitcal: nowhere.toml: file not found\n");
    let said = refused(&["measure", PLAN], 2);
    assert!(said.contains("--out <DIR>"), "{said}");
    let said = refused(&["measure", PLAN, "--dry-run", "--epics", "/nowhere"], 1);
    assert_eq!(said, "orbitcal: /nowhere: file not found; `make control-env` installs it\n");
    let said = refused(&["measure", PLAN, "--dry-run", "--epics", "true"], 1);
    assert_eq!(said, "orbitcal: the process that speaks EPICS has ended\n");
    let said = refused(&["measure", "--restore", "nowhere.journal"], 2);
    assert_eq!(said, "orbitcal: nowhere.journal: file not found\n");
    let said = refused(&["simulate", PLAN, "--fault", "stick@Z9=3"], 2);
    assert!(said.contains("stick@CORRECTOR=CYCLE, found \"stick@Z9=3\""), "{said}");
}

#[test]
fn the_simulated_machine_answers_each_line_with_a_cycle() {
    let mut process = command(&["simulate", PLAN]).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let mut lines = process.stdin.take().unwrap();
    for _ in 0..2 {
        writeln!(lines, r#"{{"set": {{"BOOSTER:A2:SET": 22.0}}, "seconds": 4.0}}"#).unwrap();
    }
    drop(lines);
    let said = process.wait_with_output().unwrap();
    let lines: Vec<Value> =
        String::from_utf8(said.stdout).unwrap().lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    assert_eq!(lines.len(), 3);
    assert_eq!(lines[0]["records"].as_array().map(Vec::len), Some(106));
    let of = |cycle: usize, name: &str| lines[cycle]["values"][name].as_array().unwrap().clone();
    assert_eq!((of(1, "BOOSTER:CYCLE")[0].as_f64(), of(2, "BOOSTER:CYCLE")[0].as_f64()), (Some(1.0), Some(2.0)));
    assert_eq!((of(1, "BOOSTER:BPM:X").len(), of(1, "BOOSTER:BPM:Y").len()), (15, 18));
    // four seconds are thirteen time constants of the supply; it fluctuates by 0.02 A
    assert!((of(2, "BOOSTER:A2:READ")[0].as_f64().unwrap() - 22.0).abs() < 0.15);
}
