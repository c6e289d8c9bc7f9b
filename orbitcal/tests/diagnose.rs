//! `orbitcal diagnose`, `challenge` and `validate` as users run them, on good and on bad recordings.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

fn orbitcal(arguments: &[&str]) -> Output {
    let repository = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    Command::new(env!("CARGO_BIN_EXE_orbitcal")).args(arguments).current_dir(repository).output().unwrap()
}

fn diagnose(recording: &str) -> Value {
    let run = orbitcal(&["diagnose", recording, "--json", "-", "--quiet"]);
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    serde_json::from_slice(&run.stdout).unwrap()
}

/// The result has what the contract says, and the model that comes out fits better in the core.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn an_identified_effect_reaches_the_core() {
    let folder = tempfile::tempdir().unwrap();
    let [model, report, before, after] =
        ["model.bin", "report.html", "before.json", "after.json"].map(|name| folder.path().join(name));
    let recording = "recordings/concealed/open-04";
    let run = orbitcal(&[
        "diagnose",
        recording,
        "--json",
        "-",
        "--model-out",
        model.to_str().unwrap(),
        "--report",
        report.to_str().unwrap(),
    ]);
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let result: Value = serde_json::from_slice(&run.stdout).unwrap();
    assert_eq!(result["verdict"], "identified");
    let finding = &result["findings"][0];
    assert_eq!(
        (finding["kind"].as_str(), finding["at"].as_str(), finding["unit"].as_str()),
        (Some("quad_roll"), Some("F2"), Some("rad"))
    );
    assert!(finding["probability"].as_f64().unwrap() >= 0.95);
    let gain = |key: &str| result["fit"][key].as_f64().unwrap();
    assert!(gain("elpd_gain") > 2.0 * gain("elpd_gain_se"));
    let measured = &result["tunes_measured"]["x"];
    let away = measured["mean"].as_f64().unwrap() - result["tunes"]["x"].as_f64().unwrap();
    assert!(away.abs() < 4.0 * measured["sigma"].as_f64().unwrap(), "tune x is {away} away from {measured}");
    assert_eq!(result["vars_before"].as_array().map(Vec::len), Some(48));
    assert_eq!(result["vars_after"].as_array().map(Vec::len), Some(48));
    assert_eq!(result["monitors"].as_array().map(Vec::len), Some(33));
    assert!(fs::read_to_string(&report).unwrap().contains("quad_roll"));
    let core = |path: &Path, more: &[&str]| {
        let arguments =
            ["replay", recording, "--quiet", "--service", "orbitcal.DiagnoseTest.v1", "--json", path.to_str().unwrap()];
        let run = orbitcal(&[arguments.as_slice(), more].concat());
        assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
        let result: Value = serde_json::from_str(&fs::read_to_string(path).unwrap()).unwrap();
        (result["chi2_per_dof"].as_f64().unwrap(), result["mismatch"].as_bool().unwrap())
    };
    let (plain, extended) = (core(&before, &[]), core(&after, &["--model-file", model.to_str().unwrap()]));
    assert!(extended.0 < plain.0 - 0.04, "{plain:?} {extended:?}");
    assert!(plain.1 && !extended.1, "the core's alarm before, and silence after: {plain:?} {extended:?}");
}

/// Where nothing was found, the design would be no model of what was.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn a_model_of_nothing_is_not_written() {
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("model.bin");
    let arguments = ["diagnose", "recordings/random-vars", "--quiet", "--model-out", model.to_str().unwrap()];
    let run = orbitcal(&arguments);
    let said = String::from_utf8_lossy(&run.stderr).into_owned();
    assert_eq!(run.status.code(), Some(1), "{said}");
    assert!(said.ends_with("not written: nothing was identified beyond the ring as designed\n"), "{said}");
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}

/// Rewrites the rows of a recording into a folder.
fn altered(folder: &Path, change: impl Fn(usize, Vec<String>, &[String]) -> Option<Vec<String>>) -> String {
    altered_from("open-02", folder, change)
}

fn altered_from(
    name: &str,
    folder: &Path,
    change: impl Fn(usize, Vec<String>, &[String]) -> Option<Vec<String>>,
) -> String {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/concealed").join(name);
    fs::copy(source.join("header.toml"), folder.join("header.toml")).unwrap();
    let text = fs::read_to_string(source.join("frames.csv")).unwrap();
    let mut lines = text.lines();
    let names: Vec<String> = lines.next().unwrap().split(',').map(str::to_owned).collect();
    let rows =
        lines.enumerate().filter_map(|(i, line)| change(i, line.split(',').map(str::to_owned).collect(), &names));
    let body: Vec<String> = core::iter::once(names.join(",")).chain(rows.map(|row| row.join(","))).collect();
    fs::write(folder.join("frames.csv"), body.join("\n") + "\n").unwrap();
    folder.to_str().unwrap().to_owned()
}

/// Too little to tell anything from: one line that says what is too few, or nothing found and what would have been seen.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn bad_recordings_invent_no_effect() {
    let folder = || tempfile::tempdir().unwrap();
    let one_corrector = |_: usize, row: Vec<String>, _: &[String]| (row[3] == "A2").then_some(row);
    let few_frames = |i: usize, row: Vec<String>, _: &[String]| (i < 6).then_some(row);
    let no_baseline = |_: usize, row: Vec<String>, _: &[String]| (row[4] != "0" || row[5] != "0").then_some(row);
    let all_dead = |_: usize, mut row: Vec<String>, names: &[String]| {
        for (cell, name) in row.iter_mut().zip(names) {
            if name.starts_with("x_") || name.starts_with("y_") {
                cell.clear();
            }
        }
        Some(row)
    };
    for (what, expected) in [("one corrector", "correctors"), ("few frames", "correctors"), ("all dead", "monitors")] {
        let folder = folder();
        let recording = match what {
            "one corrector" => altered(folder.path(), one_corrector),
            "few frames" => altered(folder.path(), few_frames),
            _ => altered(folder.path(), all_dead),
        };
        let run = orbitcal(&["diagnose", &recording]);
        let error = String::from_utf8_lossy(&run.stderr).into_owned();
        assert_eq!(run.status.code(), Some(2), "{what}: {error}");
        assert!(
            error.lines().count() == 1 && error.contains(expected) && error.contains("expected at least"),
            "{what}: {error}"
        );
    }
    let folder = folder();
    let result = diagnose(&altered(folder.path(), no_baseline));
    let at = result["findings"][0]["at"].as_str();
    assert!(result["verdict"] == "consistent" || at == Some("x_E6"), "{result:#}");
}

#[test]
fn what_is_no_recording_is_refused() {
    for arguments in [
        ["diagnose", "recordings/no-such"].as_slice(),
        &["challenge", "docs"],
        &["validate", "recordings/no-such"],
        &["replay", "recordings/paper-vars", "--model-file", "Cargo.toml"],
    ] {
        let run = orbitcal(arguments);
        assert_eq!(run.status.code(), Some(2), "{arguments:?}");
        assert_eq!(String::from_utf8_lossy(&run.stderr).lines().count(), 1, "{arguments:?}");
    }
}

/// What could be scored is told, and then what could not.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn one_recording_that_cannot_be_read_does_not_lose_the_others() {
    let folder = tempfile::tempdir().unwrap();
    for (name, is_whole) in [("broken", false), ("sound", true)] {
        let to = folder.path().join(name);
        fs::create_dir(&to).unwrap();
        for file in ["header.toml", "frames.csv", "truth.json"] {
            fs::copy(format!("../recordings/concealed/open-00/{file}"), to.join(file)).unwrap();
        }
        if !is_whole {
            fs::write(to.join("frames.csv"), "seq\n").unwrap();
        }
    }
    let run = orbitcal(&["challenge", folder.path().to_str().unwrap()]);
    let (said, error) = (String::from_utf8_lossy(&run.stdout), String::from_utf8_lossy(&run.stderr));
    assert_eq!(run.status.code(), Some(2), "{error}");
    assert!(said.contains("1 right") && said.contains("sound: found nothing"), "{said}");
    assert!(error.lines().count() == 1 && error.contains("broken"), "{error}");
}

/// Two halves of a campaign, each with correctors of its own, are two campaigns of one machine.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn two_recordings_are_analysed_together() {
    let folders = [0, 1].map(|_| tempfile::tempdir().unwrap());
    let frames = fs::read_to_string("../recordings/concealed/open-04/frames.csv").unwrap().lines().count() - 1;
    let half = |which: usize| {
        let of_half = move |i: usize, row: Vec<String>, _: &[String]| (2 * i / frames == which).then_some(row);
        altered_from("open-04", folders[which].path(), of_half)
    };
    let halves = [half(0), half(1)];
    let report = folders[0].path().join("report.html");
    let arguments =
        ["diagnose", &halves[0], &halves[1], "--json", "-", "--quiet", "--report", report.to_str().unwrap()];
    let run = orbitcal(&arguments);
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let result: Value = serde_json::from_slice(&run.stdout).unwrap();
    assert_eq!(result["verdict"], "identified", "{result:#}");
    assert_eq!((&result["findings"][0]["kind"], &result["findings"][0]["at"]), (&"quad_roll".into(), &"F2".into()));
    assert_eq!(result["recordings"].as_array().map(Vec::len), Some(2));
    let said = result["sentence"].as_str().unwrap();
    assert!(said.contains("2 recordings analysed together"), "{said}");
    assert!(fs::read_to_string(report).unwrap().contains("Pictures of readings"));
}

#[test]
fn recordings_that_do_not_fit_together_are_refused() {
    let cases = [
        ("recordings/paper-vars", "recordings/../recordings/paper-vars", "given twice"),
        ("recordings/paper-vars", "recordings/ten-cells/gain", "of another machine"),
    ];
    for (one, other, expected) in cases {
        let run = orbitcal(&["diagnose", one, other]);
        let error = String::from_utf8_lossy(&run.stderr).into_owned();
        assert_eq!(run.status.code(), Some(2), "{error}");
        assert!(error.lines().count() == 1 && error.contains(expected), "{error}");
    }
}

/// A resumed run runs no campaign twice, and the tables are the same.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn a_stopped_validation_resumes() {
    let folder = tempfile::tempdir().unwrap();
    let outcomes = folder.path().join("outcomes.jsonl");
    let run = |single: &str| {
        let few = ["--empty", "1", "--single", single, "--pair", "0", "--unknown", "1"];
        let arguments =
            ["validate", "recordings/paper-vars", "--json", "-", "--quiet", "--outcomes", outcomes.to_str().unwrap()];
        let run = orbitcal(&[arguments.as_slice(), few.as_slice()].concat());
        assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
        let tables: Value = serde_json::from_slice(&run.stdout).unwrap();
        (tables, fs::read_to_string(&outcomes).unwrap().lines().count())
    };
    let (_, first) = run("1");
    let (tables, second) = run("2");
    assert_eq!((first, second), (3, 4));
    assert_eq!(run("2"), (tables, 4));
}
