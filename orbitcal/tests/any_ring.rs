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

/// Every frame moves two correctors in a way of its own, as a feedback does.
#[test]
fn frames_that_nothing_repeats_are_no_settings() {
    let home = tempfile::tempdir().unwrap();
    let row = core::cell::Cell::new(0);
    let current = |step: i32| format!("{:.4}", 0.3 * 1.2f64.powi(step));
    let folder = edited(home.path(), |column, cell| match column {
        "seq" => {
            row.set(cell.parse().unwrap());
            cell.to_owned()
        }
        "ic_01F_A" => current(row.get() % 11),
        "ic_02F_A" => current(row.get() / 11),
        _ if column.starts_with("ic_") => "0.0000".into(),
        _ => cell.to_owned(),
    });
    let settings = &json(&["check", folder.to_str().unwrap()])["settings"];
    assert_eq!((number(&settings["count"]), number(&settings["repeats"][0])), (0.0, 0.0));
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

/// The plain recording with one line of its header changed.
fn with_header(home: &Path, old: &str, new: &str) -> String {
    let folder = edited(home, |_, cell| cell.to_owned());
    let header = std::fs::read_to_string(folder.join("header.toml")).unwrap();
    assert_eq!(header.matches(old).count(), 1, "{old}");
    std::fs::write(folder.join("header.toml"), header.replace(old, new)).unwrap();
    folder.display().to_string()
}

/// An exact design has vars that imitate it, so that the tunes are off; one that may be wrong has a kick constant that is.
#[test]
fn a_wrong_kick_constant_is_said() {
    let home = tempfile::tempdir().unwrap();
    let folder = with_header(home.path(), "kick_mrad_per_A = 0.08", "kick_mrad_per_A = 0.0816");
    let said = text(&["fit", &folder, "--exact-design"]).replace('\n', " ");
    assert!(said.contains("measured tunes differ from the model's"), "{said}");

    // so far off that the first vars of the screening have other tunes
    let home = tempfile::tempdir().unwrap();
    let folder = with_header(home.path(), "kick_mrad_per_A = 0.08", "kick_mrad_per_A = 0.1");
    let result = json(&["fit", &folder]);
    let kicks: Vec<&Value> =
        result["imperfections"].as_array().unwrap().iter().filter(|one| one["kind"] == "corrector_gain").collect();
    assert_eq!(kicks.len(), 2, "{result}");
    for kick in kicks {
        let pull = (number(&kick["mean"]) - (0.08 / 0.1 - 1.0)) / number(&kick["sigma"]);
        assert!(pull.abs() < 3.5, "{kick}");
    }
    let page = home.path().join("page.html");
    let said = text(&["fit", &folder, "--report", page.to_str().unwrap()]);
    let page = std::fs::read_to_string(page).unwrap();
    for what in [said, page] {
        assert!(what.contains("off throughout the ring: kick constant, H -2"), "{what}");
    }
}

#[test]
fn a_header_that_its_frames_contradict_is_refused_by_key() {
    for (old, new, expected) in [
        ("bpm_sigma_mm = 0.02", "bpm_sigma_mm = 1e-9", "line 6, key bpm_sigma_mm: 1e-9 mm, the repeats say 0.02"),
        ("bpm_sigma_mm = 0.02", "bpm_sigma_mm = 1.0", "line 6, key bpm_sigma_mm: 1.0 mm, the repeats say 0.02"),
        (
            "_per_A = 0.08",
            "_per_A = 80",
            "line 7, key kick_mrad_per_A: expected kicks up to 100.0 mrad, found 0.16 rad",
        ),
        (
            "quad_transfer",
            "radial_loop_monitors = [\"x_Z1\", \"x_Z2\"]\nquad_transfer",
            "line 11, key radial_loop_monitors: effect radial_loop: expected two horizontal monitors, found \"x_Z1,x_Z2\"",
        ),
    ] {
        let home = tempfile::tempdir().unwrap();
        let folder = with_header(home.path(), old, new);
        for command in ["check", "fit", "diagnose"] {
            let output = orbitcal(&[command, &folder, "--machine", RING]);
            let said = String::from_utf8_lossy(&output.stderr);
            assert_eq!(output.status.code(), Some(2), "{command}: {said}");
            assert!(
                said.lines().count() == 1 && said.contains(&format!("header.toml, {expected}")),
                "{command}: {said}"
            );
        }
    }
}

#[test]
fn a_stuck_monitor_counts_as_one_without_readings() {
    let fitted = |cell: &'static str| {
        let home = tempfile::tempdir().unwrap();
        let stuck = |column: &str, old: &str| if column == "x_04F_mm" { cell.to_owned() } else { old.to_owned() };
        json(&["fit", edited(home.path(), stuck).to_str().unwrap()])
    };
    let (stuck, silent) = (fitted("0.5"), fitted(""));
    assert_eq!(stuck["monitors"][3]["state"], "dead");
    // the same readings, from another first guess: both fits have settled to some 3e-3 of an error bar
    for (one, other) in stuck["vars"].as_array().unwrap().iter().zip(silent["vars"].as_array().unwrap()) {
        let away = (number(&one["mean"]) - number(&other["mean"])) / number(&other["sigma"]);
        assert!(away.abs() < 0.01, "{one} {other}");
    }
    assert!((number(&stuck["chi2_per_dof"]) / number(&silent["chi2_per_dof"]) - 1.0).abs() < 1e-6);
}

#[test]
fn monitors_that_are_all_stuck_leave_the_prior() {
    let home = tempfile::tempdir().unwrap();
    let is_monitor = |column: &str| column.starts_with("x_") || column.starts_with("y_");
    let stuck = |column: &str, cell: &str| if is_monitor(column) { "0.5".to_owned() } else { cell.to_owned() };
    let folder = edited(home.path(), stuck).display().to_string();
    let result = json(&["fit", &folder]);
    assert_eq!(result["lack"], "no monitor has a reading that counts");
    assert!(result["chi2_per_dof"].is_null() && result["mismatch"] == false, "{result}");
    assert!(text(&["fit", &folder]).contains("chi2/dof -,"));
}

#[test]
fn without_degrees_of_freedom_there_is_no_chi_square() {
    let home = tempfile::tempdir().unwrap();
    let folder = edited(home.path(), |_, cell| cell.to_owned());
    let frames = std::fs::read_to_string(folder.join("frames.csv")).unwrap();
    let first: String = frames.lines().take(3).map(|line| format!("{line}\n")).collect();
    std::fs::write(folder.join("frames.csv"), first).unwrap();
    let folder = folder.display().to_string();
    for arguments in [&["fit", folder.as_str()][..], &["replay", &folder, "--no-publish"]] {
        assert!(json(arguments)["chi2_per_dof"].is_null(), "{arguments:?}");
        assert!(text(arguments).contains("chi2/dof -"), "{arguments:?}");
    }
}

#[test]
fn a_fit_says_that_model_and_machine_disagree() {
    let gain = concat!(env!("CARGO_MANIFEST_DIR"), "/../recordings/ten-cells/gain");
    for (folder, expected) in [(gain, true), (PLAIN, false)] {
        assert_eq!(json(&["fit", folder])["mismatch"], expected);
        assert_eq!(text(&["fit", folder]).contains("model and machine disagree beyond the noise"), expected);
    }
}

/// Neighbouring steps of this fit shrink by a quarter: it ran out of them at a fiftieth of an error bar.
#[test]
fn a_fit_whose_last_step_was_small_has_converged() {
    let swapped = |line: &str, one: usize, other: usize| {
        let mut cells: Vec<&str> = line.split(',').collect();
        cells.swap(one, other);
        cells.join(",") + "\n"
    };
    let home = tempfile::tempdir().unwrap();
    let folder = edited(home.path(), |_, cell| cell.to_owned());
    let frames = std::fs::read_to_string(folder.join("frames.csv")).unwrap();
    let columns: Vec<&str> = frames.lines().next().unwrap().split(',').collect();
    let at = |name: &str| columns.iter().position(|column| *column == name).unwrap();
    let rows = frames.lines().skip(1).map(|line| swapped(line, at("y_01F_mm"), at("y_06F_mm")));
    let text: String = core::iter::once(columns.join(",") + "\n").chain(rows).collect();
    std::fs::write(folder.join("frames.csv"), text).unwrap();
    assert_eq!(json(&["fit", folder.to_str().unwrap()])["mismatch"], true);
}

/// Supplies that run 1 % above their nominal currents, by a header that says so: vars absorb it, tunes at the real currents do not.
#[test]
fn tunes_are_those_of_the_recorded_currents() {
    let home = tempfile::tempdir().unwrap();
    let folder = with_header(home.path(), "qh = 100.0", "qh = 99.0");
    let (stream, batch) = (json(&["replay", &folder, "--no-publish"]), json(&["fit", &folder]));
    for plane in ["x", "y"] {
        let away = number(&stream["tunes"][plane]) - number(&batch["tunes"][plane]);
        assert!(away.abs() < 1e-3, "{plane}: {away}"); // 1 % of the focusing gradients are 0.03
        let measured = number(&stream["tunes"][plane]) - number(&stream["tunes_measured"][plane]["mean"]);
        assert!(measured.abs() < 3e-3, "{plane}: {measured}");
    }
    let (result, lattice) = (home.path().join("fit.json"), home.path().join("ring.madx"));
    std::fs::write(&result, batch.to_string()).unwrap();
    let (result, lattice) = (result.display().to_string(), lattice.display().to_string());
    let said = text(&["export", &result, "--as", "madx", "--out", &lattice]).replace('\n', " ");
    let written = std::fs::read_to_string(&lattice).unwrap();
    let exported = json(&["export", &result, "--as", "madx", "--out", &lattice]);
    assert_eq!((exported["file"].as_str(), exported["format"].as_str()), (Some(lattice.as_str()), Some("madx")));
    let nominal = format!("{:.4} {:.4}", number(&exported["tunes"]["x"]), number(&exported["tunes"]["y"]));
    let remark =
        exported["remarks"].as_array().unwrap().iter().find_map(|remark| remark.as_str()?.split(": tunes ").nth(1));
    assert!(remark.unwrap().starts_with(&nominal), "{exported}");
    for text in [said.as_str(), &written] {
        let tunes = format!("{:.4} {:.4}", number(&batch["tunes"]["x"]), number(&batch["tunes"]["y"]));
        assert!(text.contains("at the supplies' nominal currents: tunes "), "{text}");
        assert!(text.contains(&format!("at the recording's mean currents {tunes}")), "{text}");
    }
}

#[test]
fn what_only_the_exact_twin_models_is_said_by_all_others() {
    let home = tempfile::tempdir().unwrap();
    let new = "believed_rf = \"radial_loop\"\nradial_loop_monitors = [\"x_03F\", \"x_08F\"]";
    let folder = with_header(home.path(), "believed_rf = \"fixed_momentum\"", new);
    let output = orbitcal(&["replay", &folder, "--no-publish", "--machine", RING]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said.contains("this does not model a radial loop"), "{said}");
    let output = orbitcal(&["fit", &folder, "--method", "nuts", "--machine", RING]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(2) && said.contains("this does not model a radial loop"), "{said}");
}

#[test]
fn a_surrogate_needs_a_monitor_and_a_var() {
    let mut blind: Value = serde_json::from_str(&std::fs::read_to_string(RING).unwrap()).unwrap();
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join("ring.json");
    (blind["data"]["bpm_x"], blind["data"]["bpm_y"]) = (serde_json::json!([]), serde_json::json!([]));
    std::fs::write(&path, blind.to_string()).unwrap();
    let output = orbitcal(&["surrogate", "check", "--machine", path.to_str().unwrap()]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(2) && said.ends_with(": no monitor to predict\n"), "{said}");
}

/// Stdout and stderr of a command that may fail, and its exit status.
fn said(arguments: &[&str]) -> (Option<i32>, String) {
    let output = orbitcal(&[arguments, &["--machine", RING]].concat());
    let said = [output.stdout, output.stderr].map(|text| String::from_utf8_lossy(&text).into_owned()).concat();
    (output.status.code(), said.replace('\n', " "))
}

#[test]
fn currents_that_leave_no_ring_name_the_supply() {
    let home = tempfile::tempdir().unwrap();
    let folder = with_header(home.path(), "qh = 100.0", "qh = 200.0");
    for command in ["check", "fit"] {
        let (status, said) = said(&[command, &folder]);
        assert_eq!(status, Some(2), "{said}");
        assert!(said.contains("no stable ring ten cells at its currents: "), "{said}");
        assert!(said.contains("; supply QF is at 100.0 A, its nominal current is 200.0 A"), "{said}");
    }
}

#[test]
fn a_tune_meter_that_scatters_is_said_to_scatter() {
    let home = tempfile::tempdir().unwrap();
    let frames = core::cell::Cell::new(0_u32);
    let scatter = |column: &str, cell: &str| {
        if column != "qx_frac" {
            return cell.to_owned();
        }
        frames.set(frames.get() + 1);
        format!("0.{:04}", frames.get() * 3571 % 10000)
    };
    let folder = edited(home.path(), scatter).display().to_string();
    let (_, said) = said(&["replay", &folder, "--no-publish"]);
    assert!(
        said.contains("the readings of the tune meter scatter") && !said.contains("a wrong kick constant"),
        "{said}"
    );
}

#[test]
fn noise_by_repeats_needs_repeats() {
    let home = tempfile::tempdir().unwrap();
    let folder = edited(home.path(), |_, cell| cell.to_owned());
    let frames = std::fs::read_to_string(folder.join("frames.csv")).unwrap();
    let first: String = frames.lines().take(2).map(|line| format!("{line}\n")).collect();
    std::fs::write(folder.join("frames.csv"), first).unwrap();
    let (status, said) = said(&["check", folder.to_str().unwrap()]);
    assert!(status == Some(0) && said.contains("no repeats, the header says 0.020 mm"), "{said}");
}
