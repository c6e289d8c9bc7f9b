//! A ring that is not the Booster, by the commands: ten cells, 20 quadrupoles, ten monitors that read both planes.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

const RING: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../recordings/ten-cells/ring.json");
const PLAIN: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../recordings/ten-cells/plain");

fn orbitcal(arguments: &[&str]) -> Output {
    let output = Command::new(env!("CARGO_BIN_EXE_orbitcal")).args(arguments).output();
    output.expect("the program was built for this test")
}

/// The result of a command as JSON.
fn json(arguments: &[&str]) -> Value {
    let output = orbitcal(&[arguments, &["--machine", RING, "--json", "-"]].concat());
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("stdout holds the JSON alone")
}

/// What a person reads.
fn text(arguments: &[&str]) -> String {
    let output = orbitcal(&[arguments, &["--machine", RING]].concat());
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("no number: {value}"))
}

/// The plain recording with other cells: `change` gets the name of a column and its cell.
fn edited(home: &Path, change: impl Fn(&str, &str) -> String) -> PathBuf {
    let folder = home.join("edited");
    std::fs::create_dir(&folder).unwrap();
    std::fs::copy(Path::new(PLAIN).join("header.toml"), folder.join("header.toml")).unwrap();
    let frames = std::fs::read_to_string(Path::new(PLAIN).join("frames.csv")).unwrap();
    let mut lines = frames.lines();
    let columns: Vec<&str> = lines.next().unwrap().split(',').collect();
    let line = |line: &str| -> String {
        let cells: Vec<String> = line.split(',').zip(&columns).map(|(cell, column)| change(column, cell)).collect();
        cells.join(",") + "\n"
    };
    let text: String = core::iter::once(columns.join(",") + "\n").chain(lines.map(line)).collect();
    std::fs::write(folder.join("frames.csv"), text).unwrap();
    folder
}

#[test]
fn check_says_what_is_there_and_what_can_be_done() {
    let result = json(&["check", PLAIN]);
    assert_eq!((number(&result["frames"]), number(&result["settings"]["count"])), (120.0, 41.0));
    assert_eq!(result["settings"]["correctors"], serde_json::json!([20, 20]));
    let noise = |plane: &str| number(&result["noise"][plane]["of_repeats_mm"]);
    // 80 repeats a monitor, the median of ten of them: known to 3 %
    assert!([noise("x"), noise("y")].iter().all(|mm| (mm / 0.02 - 1.0).abs() < 0.1), "{}", result["noise"]);
    assert!(number(&result["tunes_measured"]["x"]["sigma"]) < 1e-3);
    let commands = result["commands"].as_array().unwrap();
    let words: Vec<&str> = commands.iter().map(|one| one["command"].as_str().unwrap()).collect();
    assert_eq!(words, ["replay", "fit", "study", "diagnose", "device"]);
    assert!(commands.iter().all(|one| one["can"] == true), "{}", result["commands"]);
    assert!(commands[2]["what"].as_str().unwrap().contains("-2 A to +2 A"), "{}", commands[2]);
    let text = text(&["check", PLAIN]);
    assert!(text.lines().all(|line| line.chars().count() <= 80), "{text}");
}

#[test]
fn stream_and_batch_fit_agree_and_stand_beside_the_measured_tunes() {
    let stream = json(&["replay", PLAIN, "--no-publish"]);
    let batch = json(&["fit", PLAIN]);
    for (one, other) in stream["vars"].as_array().unwrap().iter().zip(batch["vars"].as_array().unwrap()) {
        let away = (number(&one["mean"]) - number(&other["mean"])) / number(&other["sigma"]);
        // the tables of the core state an error of a tenth of the noise
        assert!(one["name"] == other["name"] && away.abs() < 0.1, "{one} {other}");
    }
    for result in [&stream, &batch] {
        assert!((0.9..1.1).contains(&number(&result["chi2_per_dof"])), "{}", result["chi2_per_dof"]);
        for plane in ["x", "y"] {
            let measured = &result["tunes_measured"][plane];
            let away = (number(&measured["mean"]) - number(&result["tunes"][plane])) / number(&measured["sigma"]);
            assert!(away.abs() < 3.0, "{plane}: {away}");
        }
        assert_eq!(result.get("lack"), None);
    }
}

#[test]
fn a_recording_that_says_nothing_gives_the_prior_and_says_so() {
    let home = tempfile::tempdir().unwrap();
    let no_reading = |column: &str, cell: &str| {
        if column.starts_with("x_") || column.starts_with("y_") { String::new() } else { cell.to_owned() }
    };
    let silent = edited(home.path(), no_reading).display().to_string();
    let home = tempfile::tempdir().unwrap();
    let no_kick = |column: &str, cell: &str| {
        if column.starts_with("ic_") || column == "setting_A" { "0".to_owned() } else { cell.to_owned() }
    };
    let still = edited(home.path(), no_kick).display().to_string();
    for (folder, expected) in [
        (&silent, "no monitor has a reading that counts"),
        (&still, "kicks and RF offsets move the beam by too little to tell anything"),
    ] {
        for arguments in [&["fit", folder.as_str()][..], &["replay", folder, "--no-publish"]] {
            let result = json(arguments);
            assert_eq!(result["lack"], *expected, "{arguments:?}");
            let said = text(arguments);
            assert!(said.replace('\n', " ").contains(&format!("{expected}: the result is the prior")), "{said}");
        }
        let checked = json(&["check", folder]);
        assert!(checked["commands"][1]["what"].as_str().unwrap().starts_with(expected), "{}", checked["commands"]);
    }
}

#[test]
fn a_narrow_prior_holds_the_vars_and_a_narrow_range_stops_them() {
    let narrow = json(&["fit", PLAIN, "--prior-width", "0.0001"]);
    assert!(narrow["vars"].as_array().unwrap().iter().all(|var| number(&var["sigma"]) < 1.01e-4));
    let stopped = json(&["replay", PLAIN, "--no-publish", "--range", "0.99,1.01"]);
    let vars = stopped["vars"].as_array().unwrap();
    assert!(vars.iter().all(|var| (0.99..=1.01).contains(&number(&var["mean"]))));
    assert!(vars.iter().any(|var| var["clipped"] == true), "the machine has vars beyond it");
}

#[test]
fn a_wrong_kick_constant_shows_in_the_tunes() {
    let home = tempfile::tempdir().unwrap();
    let folder = edited(home.path(), |_, cell| cell.to_owned());
    let header = std::fs::read_to_string(folder.join("header.toml")).unwrap();
    let wrong = header.replace("kick_mrad_per_A = 0.08", "kick_mrad_per_A = 0.0816");
    assert_ne!(header, wrong);
    std::fs::write(folder.join("header.toml"), wrong).unwrap();
    let said = text(&["fit", folder.to_str().unwrap()]);
    let said = said.replace('\n', " ");
    assert!(said.contains("measured tunes differ from the model's"), "{said}");
}
