//! `orbitcal fit --method nuts` and `orbitcal study` as users run them.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

fn orbitcal(arguments: &[&str]) -> Output {
    let repository = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    Command::new(env!("CARGO_BIN_EXE_orbitcal")).args(arguments).current_dir(repository).output().unwrap()
}

#[test]
fn nuts_answers_as_the_contract_says_and_leaves_its_draws() {
    let folder = tempfile::tempdir().unwrap();
    let draws = folder.path().join("draws");
    let few = ["--chains", "2", "--warm-up", "100", "--draws", "50", "--seed", "5"];
    let arguments =
        ["fit", "recordings/paper-vars", "--method", "nuts", "--json", "-", "--save-draws", draws.to_str().unwrap()];
    let run = orbitcal(&[arguments.as_slice(), few.as_slice()].concat());
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let answer: Value = serde_json::from_slice(&run.stdout).unwrap();
    assert_eq!((answer["method"].as_str(), answer["model"].as_str()), (Some("nuts"), Some("twin")));
    assert_eq!(answer["vars"].as_array().unwrap().len(), 48);
    assert_eq!(answer["nuts"]["draws"], 100);
    assert!(answer["nuts"]["rhat_max"].as_f64().unwrap() < 1.2 && answer["nuts"]["seconds"].as_f64().unwrap() > 0.0);
    assert_eq!(std::fs::read_dir(&draws).unwrap().count(), 2);
    let second = std::fs::read_to_string(draws.join("chain-2.csv")).unwrap();
    let columns: Vec<usize> = second.lines().map(|line| line.split(',').count()).collect();
    assert_eq!(columns, [7 + 48; 1 + 50]); // statistics and vars, in a line of names and one a draw
    // the same seed, the same draws
    let again: Value =
        serde_json::from_slice(&orbitcal(&[arguments.as_slice(), few.as_slice()].concat()).stdout).unwrap();
    assert_eq!(answer["vars"], again["vars"]);
}

#[test]
fn what_does_not_go_together_is_refused() {
    for arguments in [
        ["fit", "recordings/paper-vars", "--save-draws", "draws"].as_slice(),
        &["fit", "recordings/paper-vars", "--model", "green"],
        &["fit", "recordings/paper-vars", "--method", "nuts", "--draws", "0"],
        &["study", "recordings/no-such"],
    ] {
        let run = orbitcal(arguments);
        assert_eq!(run.status.code(), Some(2), "{arguments:?}");
        assert_eq!(String::from_utf8_lossy(&run.stderr).lines().count(), 1, "{arguments:?}");
    }
}
