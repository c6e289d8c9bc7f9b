//! `orbitcal fit`, `diagnose` and `compare` of a response matrix that pyAT has measured on a ring of its own.

use std::path::Path;
use std::process::{Command, Output};

use serde_json::Value;

const BEFORE: &str = "recordings/measured/twelve-cells/before";
const AFTER: &str = "recordings/measured/twelve-cells/after";

fn repository() -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn orbitcal(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_orbitcal")).args(arguments).current_dir(repository()).output().unwrap()
}

fn json(arguments: &[&str]) -> Value {
    let run = orbitcal(&[arguments, &["--json", "-", "--quiet"]].concat());
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    serde_json::from_slice(&run.stdout).unwrap()
}

fn refused(arguments: &[&str]) -> String {
    let run = orbitcal(arguments);
    assert_eq!(run.status.code(), Some(2), "{arguments:?}");
    String::from_utf8(run.stderr).unwrap()
}

fn truth() -> Value {
    let text = std::fs::read_to_string(repository().join("recordings/measured/twelve-cells/truth.json")).unwrap();
    serde_json::from_str(&text).unwrap()
}

#[test]
fn factors_are_found_within_their_errors() {
    let (result, truth) = (json(&["fit", BEFORE]), truth());
    let vars = result["vars"].as_array().unwrap();
    assert_eq!(vars.len(), 24);
    let pull = |var: &Value| {
        let name = var["name"].as_str().unwrap();
        let off = var["mean"].as_f64().unwrap() - truth["before"][name].as_f64().unwrap();
        (off / var["sigma"].as_f64().unwrap()).powi(2)
    };
    // the mean of 24 squares scatters by 0.29; three times that, the matrix of another code
    let mean = vars.iter().map(pull).sum::<f64>() / 24.0;
    assert!((0.13..1.87).contains(&mean), "mean square pull {mean}");
    // 600 elements of noise as stated, 140 unknowns: 0.77 ± 0.06
    let chi2 = result["chi2_loco"].as_f64().unwrap();
    assert!((0.55..0.95).contains(&chi2), "{chi2}");
    let tunes = ["x", "y"].map(|plane| result["tunes"][plane].as_f64().unwrap());
    // pyAT: 0.18375878 and 0.21597504, of which a response tells 3e-4
    assert!((tunes[0] - 4.18376).abs() < 1e-3 && (tunes[1] - 3.21598).abs() < 1e-3, "{tunes:?}");
    assert_eq!(result["covariance"].as_array().unwrap().len(), 24);
    assert_eq!(result["wiring"][0]["kind"], "bpm_swap");
    assert!(result["other"].as_array().unwrap().iter().any(|one| one["kind"] == "corrector_gain"));
}

#[test]
fn exchanged_monitors_and_a_held_frequency_are_found() {
    let result = json(&["diagnose", BEFORE, "--rf", "fixed-momentum"]);
    let findings = result["findings"].as_array().unwrap();
    // of the whole ring, then by their gains
    assert_eq!((findings.len(), &findings[0]["kind"]), (2, &"fixed_rf_frequency".into()));
    assert_eq!((&findings[1]["kind"], &findings[1]["at"]), (&"bpm_swap".into(), &"x_BPM.22,x_BPM.52".into()));
    assert_eq!(findings[1]["sentence"], "x_BPM.22 and x_BPM.52 are exchanged");
    assert!(result["sentence"].as_str().unwrap().starts_with("the RF frequency is held, not the momentum"));
    assert!(findings.iter().all(|one| one["probability"].as_f64().unwrap() > 0.95 && one["alternatives"].is_array()));
    let [amplitude, sigma] = ["amplitude", "sigma"].map(|key| findings[0][key].as_f64().unwrap());
    assert!((amplitude - 1.0).abs() < 3.0 * sigma && sigma < 0.1, "{amplitude} {sigma}");
    let result = json(&["diagnose", BEFORE]);
    assert_eq!(result["findings"].as_array().unwrap().len(), 1, "{}", result["sentence"]);
    // what an ordinary ring has, what would be named, and elements held out
    assert!(
        result["imperfections"].as_array().unwrap().iter().any(|one| one["kind"] == "bpm_gain" && one["at"] == "x")
    );
    assert!(result["limits"].as_array().unwrap().len() > 100 && result["vars_after"].as_array().unwrap().len() == 24);
    assert!(result["fit"]["after"]["heldout_elpd"].is_f64() && result["fit"]["elpd_gain_se"].is_f64());
}

#[test]
fn what_changed_is_named() {
    let (result, truth) = (json(&["compare", BEFORE, AFTER]), truth());
    let change = |one: &Value| {
        let name = one["name"].as_str().unwrap();
        let [before, after] = ["before", "after"].map(|state| truth[state][name].as_f64().unwrap());
        let (relative, sigma) = (one["relative"].as_f64().unwrap(), one["sigma"].as_f64().unwrap());
        ((relative - (after / before - 1.0)) / sigma).powi(2)
    };
    let changes = result["changes"].as_array().unwrap();
    let mean = changes.iter().map(change).sum::<f64>() / changes.len() as f64;
    // 24 squares, as above
    assert!((0.13..1.87).contains(&mean), "mean square pull {mean}");
    let sentence = result["sentence"].as_str().unwrap();
    assert!(sentence.starts_with("Changed: QF.24 by +0.9"), "{sentence}");
    assert!(sentence.contains("QD.64 by -0."), "{sentence}");
    let same = json(&["compare", BEFORE, BEFORE]);
    assert!(same["sentence"].as_str().unwrap().starts_with("Nothing changed"), "{}", same["sentence"]);
}

#[test]
fn what_a_matrix_is_not_for_is_said() {
    assert!(
        refused(&["replay", BEFORE])
            .contains("holds a measured response matrix; `fit`, `diagnose` and `compare` read one")
    );
    assert!(refused(&["fit", BEFORE, "--method", "nuts"]).contains("--method nuts is for a recording"));
    assert!(
        refused(&["compare", BEFORE, "recordings/paper-vars"]).contains("one is a measured matrix, one a recording")
    );
    assert!(refused(&["diagnose", BEFORE, AFTER]).contains("orbitcal compare A B"));
    assert!(refused(&["fit", BEFORE, "--machine", "machines/x.json"]).contains("--machine is for a recording"));
}

/// Effects put into the matrix by a seed, its cables put right before: a wrong cable is named, nothing else is said but the effect itself.
#[test]
fn what_was_concealed_is_found_again() {
    let folder = tempfile::tempdir().unwrap();
    let mut cables = 0;
    for seed in 1..=16 {
        let out = folder.path().join(format!("{seed}"));
        let (out, seed) = (out.to_str().unwrap(), seed.to_string());
        let conceal = ["conceal", BEFORE, "--seed", &seed, "--out", out, "--quiet"];
        assert!(orbitcal(&conceal).status.success(), "seed {seed}");
        let key: Value = serde_json::from_slice(&std::fs::read(format!("{out}.truth.json")).unwrap()).unwrap();
        let effect = &key["effects"][0];
        let result = json(&["diagnose", out]);
        let found: Vec<&str> =
            result["findings"].as_array().unwrap().iter().map(|one| one["at"].as_str().unwrap()).collect();
        let place = effect["at"].as_str().unwrap();
        let is_cable = ["bpm_swap", "bpm_reversed"].contains(&effect["kind"].as_str().unwrap());
        cables += usize::from(is_cable);
        assert!(found == [place] || (!is_cable && found.is_empty()), "seed {seed}: {effect}, found {found:?}");
        assert!(refused(&conceal).contains("neither is overwritten"));
    }
    assert!(cables >= 3, "{cables} cables of 16");
}

/// The same of a recording: readings differ by the effect alone, and a strong one is named.
#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn an_effect_concealed_in_a_recording_is_found_again() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("concealed");
    let out = out.to_str().unwrap();
    assert!(orbitcal(&["conceal", "recordings/paper-vars", "--seed", "4", "--out", out, "--quiet"]).status.success());
    let key: Value = serde_json::from_slice(&std::fs::read(format!("{out}.truth.json")).unwrap()).unwrap();
    let (effect, result) = (&key["effects"][0], json(&["diagnose", out]));
    let finding = &result["findings"][0];
    assert_eq!((&finding["kind"], &finding["at"]), (&effect["kind"], &effect["at"]), "{}", result["sentence"]);
    let [found, sigma] = ["amplitude", "sigma"].map(|key| finding[key].as_f64().unwrap());
    assert!((found - effect["amplitude"].as_f64().unwrap()).abs() < 3.0 * sigma, "{found} ± {sigma}, put in {effect}");
}

const LOCO: &str = "recordings/measured/imports/twelve-cells.loco.mat";

#[test]
fn a_loco_file_in_one_command_is_fitted_as_its_folder_is() {
    let place = tempfile::tempdir().unwrap();
    let out = place.path().join("before");
    let made = json(&["import", LOCO, "--out", out.to_str().unwrap()]);
    assert_eq!((&made["format"], &made["left_out"]), (&"LOCO file".into(), &serde_json::json!({})));
    assert!(made["agreement"][1]["correlation"].as_f64().unwrap() > 0.99);
    let [own, other] = [out.to_str().unwrap(), BEFORE].map(|folder| json(&["fit", folder]));
    for (own, other) in own["vars"].as_array().unwrap().iter().zip(other["vars"].as_array().unwrap()) {
        assert_eq!(own["name"], other["name"]);
        for key in ["mean", "sigma"] {
            // positions are sums of the same lengths in another order
            assert!((own[key].as_f64().unwrap() - other[key].as_f64().unwrap()).abs() < 1e-9, "{own} {other}");
        }
    }
    assert_eq!(own["wiring"], other["wiring"]);
}

#[test]
fn what_a_loco_file_states_is_not_asked_for_nor_taken_twice() {
    for option in [["--kick-sign", "x+y+"], ["--orbit-unit", "mm"], ["--noise", "1"], ["--order", "planes"]] {
        let said = refused(&[&["import", LOCO], &option[..]].concat());
        assert!(said.contains(&format!("is a LOCO file, which states it; leave {} out", option[0])), "{said}");
    }
    assert!(refused(&["import", LOCO, "--kick", "1"]).contains("leave --kick out"));
    let lattice = "recordings/measured/imports/twelve-cells.at.mat";
    assert!(refused(&["import", lattice, "--out", "none"]).contains("is a lattice alone; --out needs --matrix"));
}

/// A fit is the model that is believed: of the same matrix nothing departs from it, of the later one what changed, and a gain that is taken out is
/// found again.
#[test]
fn what_departs_from_a_believed_model_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("fit.json");
    let model = model.to_str().unwrap();
    assert!(orbitcal(&["fit", BEFORE, "--json", model, "--quiet"]).status.success());
    let places = |arguments: &[&str]| {
        let result = json(&[&["diagnose"], arguments, &["--model-file", model]].concat());
        let findings = result["findings"].as_array().unwrap().clone();
        findings.into_iter().map(|one| (one["at"].as_str().unwrap().to_owned(), one)).collect::<Vec<_>>()
    };
    let cables = "x_BPM.22,x_BPM.52";
    assert!(places(&[BEFORE]).iter().all(|(at, _)| at == cables));
    let changed: Vec<String> = places(&[AFTER]).into_iter().map(|(at, _)| at).filter(|at| at != cables).collect();
    assert_eq!(changed, ["QF.24", "QD.64"]);
    let hidden = places(&[BEFORE, "--without", "y_BPM.52"]);
    let (_, gain) = hidden.iter().find(|(at, _)| at == "y_BPM.52").expect("its gain is 0.931");
    assert_eq!(gain["kind"], "bpm_gain");
    let [amplitude, sigma] = ["amplitude", "sigma"].map(|key| gain[key].as_f64().unwrap());
    assert!((amplitude + 0.069).abs() < 3.0 * sigma && sigma < 0.02, "{amplitude} ± {sigma}");
    assert!(refused(&["diagnose", BEFORE, "--model-file", model, "--without", "x_BPM.1"]).contains("no such value"));
}

/// The pages hold what their commands say, and the figures that a physicist looks at.
#[test]
fn a_matrix_has_its_pages() {
    let folder = tempfile::tempdir().unwrap();
    let page = |arguments: &[&str]| {
        let file = folder.path().join(format!("{}.html", arguments[0]));
        let run = orbitcal(&[arguments, &["--quiet", "--report", file.to_str().unwrap()]].concat());
        assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
        std::fs::read_to_string(file).unwrap()
    };
    let holds = |page: &str, all: &[&str]| all.iter().for_each(|text| assert!(page.contains(text), "{text}"));
    let rings =
        ["What is left over", "Strength factors", "Beta-beat", "Horizontal dispersion", "Gains of the monitors"];
    let fit = page(&["fit", BEFORE]);
    holds(&fit, &rings);
    let found = page(&["diagnose", BEFORE]);
    holds(&found, &rings);
    holds(&found, &["before: identified", "x_BPM.22 and x_BPM.52 are exchanged", "Residuals, element by element"]);
    holds(&page(&["compare", BEFORE, AFTER]), &["before to after", "Changed: QF.24 by +0.9", "What changed"]);
}

/// The skew quadrupoles of the ring, which its fit does not know: as they are, and 0.01 /m stronger.
#[test]
fn coupling_that_the_model_lacks_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let before = measured::Folder::read(&repository().join(BEFORE)).unwrap();
    let skews = [5, 27, 49, 71].map(|row| vec![row]).to_vec();
    let model =
        measured::Model::of(&before, &[Vec::new(), skews, Vec::new(), Vec::new()], twin::Rf::FixedFrequency).unwrap();
    let unknown = |group| measured::Unknown { kind: measured::Kind::Skew(group), mean: 0.0, width: 0.01 };
    let unknowns: Vec<measured::Unknown> = (0..4).map(unknown).collect();
    let at = |size: f64| model.predict(&unknowns, &nalgebra::DVector::from_vec(vec![size, -size, size, size])).unwrap();
    let (nothing, coupled) = (at(0.0).matrix, at(0.01).matrix);
    let mut stronger = before.clone();
    stronger.matrix += (coupled - nothing).columns(0, before.correctors.len());
    for (name, measurement, expected) in [("as-it-is", &before, false), ("stronger", &stronger, true)] {
        let out = folder.path().join(name);
        measured::conceal::write(&repository().join(BEFORE), measurement, &out).unwrap();
        let mut meta: Value = serde_json::from_slice(&std::fs::read(out.join("meta.json")).unwrap()).unwrap();
        let groups = meta["reference_fit"]["fit_parameters"].as_array_mut().unwrap();
        groups.retain(|one| one["field"] == "K");
        std::fs::write(out.join("meta.json"), meta.to_string()).unwrap();
        let sentence = json(&["diagnose", out.to_str().unwrap()])["sentence"].to_string();
        assert_eq!(sentence.contains("skew gradients in"), expected, "{name}: {sentence}");
    }
}
