//! The JSON of every command is what docs/schema says.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use host_bridge::history::{Columns, Row};
use jsonschema::Validator;
use serde_json::{Value, json};

/// Commands on recordings of the repository, quick ones, each under the name of its schema; `OUT` is a folder for what they make.
const COMMANDS: [(&str, &str); 18] = [
    ("check", "check recordings/paper-vars"),
    ("check", "check recordings/three-families/campaign --machine recordings/three-families/ring.json"),
    ("fit", "replay recordings/paper-vars --no-publish"),
    ("fit", "fit recordings/paper-vars"),
    (
        "fit",
        "fit recordings/ten-cells/gain --machine recordings/ten-cells/ring.json --method nuts --warm-up 50 --draws 4",
    ),
    ("fit-matrix", "fit recordings/measured/twelve-cells/before"),
    ("diagnose", "diagnose recordings/ten-cells/gain --machine recordings/ten-cells/ring.json"),
    ("diagnose-matrix", "diagnose recordings/measured/twelve-cells/after"),
    ("compare", "compare recordings/measured/twelve-cells/before recordings/measured/twelve-cells/after"),
    ("import", "import recordings/measured/imports/twelve-cells.at.json"),
    ("import", "import recordings/measured/imports/twelve-cells.loco.mat --out OUT/ring"),
    ("response", "response --effect bpm_roll@y_C5"),
    ("surrogate-check", "surrogate check --samples 2"),
    ("export", "export OUT/fit.json --as pals --out OUT/ring.yaml"),
    ("history", "history OUT/history"),
    ("challenge", "challenge OUT/concealed --machine recordings/ten-cells/ring.json"),
    (
        "validate",
        "validate recordings/ten-cells/plain --machine recordings/ten-cells/ring.json --empty 1 --single 1 --pair 0 --unknown 0 --outcomes OUT/outcomes",
    ),
    (
        "study",
        "study recordings/ten-cells/gain --machine recordings/ten-cells/ring.json --warm-up 50 --draws 4 --report OUT/study.html",
    ),
];

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn file(name: &str) -> PathBuf {
    repository().join("docs/schema").join(name).with_extension("json")
}

fn validator(name: &str) -> Validator {
    let text = fs::read_to_string(file(name)).unwrap();
    jsonschema::validator_for(&serde_json::from_str(&text).unwrap()).unwrap()
}

fn result(arguments: &str, out: &Path) -> Value {
    let arguments = arguments.replace("OUT", out.to_str().unwrap());
    let words = arguments.split(' ').chain(["--json", "-", "--quiet"]);
    let run = Command::new(env!("CARGO_BIN_EXE_orbitcal")).args(words).current_dir(repository()).output().unwrap();
    assert!(run.status.success(), "{arguments}: {}", String::from_utf8_lossy(&run.stderr));
    serde_json::from_slice(&run.stdout).unwrap()
}

/// What some of the commands read.
fn prepare(out: &Path) {
    let fit = result("fit recordings/paper-vars", out);
    fs::write(out.join("fit.json"), fit.to_string()).unwrap();
    let concealed = out.join("concealed/one");
    fs::create_dir_all(&concealed).unwrap();
    for name in ["header.toml", "frames.csv", "truth.json"] {
        fs::copy(repository().join("recordings/ten-cells/gain").join(name), concealed.join(name)).unwrap();
    }
    let columns = Columns { vars: vec!["A2".into()], instruments: vec![] };
    let row = Row {
        time_ms: 1,
        sequence: 2,
        frames: 3,
        is_usable: true,
        mismatch: false,
        chi_square: [1.0; 2],
        nis_per_reading: f32::NAN,
        vars: vec![[1.0, f32::NAN]],
        states: vec![],
    };
    fs::create_dir(out.join("history")).unwrap();
    fs::write(out.join("history/fine-1.csv"), columns.header() + &row.line()).unwrap();
}

/// `make schema` writes them.
#[test]
fn the_committed_schemas_are_those_of_the_types() {
    for (name, schema) in orbitcal::schemas() {
        let text = serde_json::to_string_pretty(&schema).unwrap() + "\n";
        if std::env::var_os("BLESS").is_some() {
            fs::write(file(name), &text).unwrap();
        }
        assert_eq!(fs::read_to_string(file(name)).unwrap_or_default(), text, "{name}: `make schema` writes it");
    }
}

#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn what_the_commands_write_is_valid() {
    let out = tempfile::tempdir().unwrap();
    prepare(out.path());
    for (name, arguments) in COMMANDS {
        let (validator, result) = (validator(name), result(arguments, out.path()));
        let wrong: Vec<String> =
            validator.iter_errors(&result).map(|error| format!("{}: {error}", error.instance_path())).collect();
        assert!(wrong.is_empty(), "{arguments}: {wrong:?}");
        let required =
            serde_json::from_str::<Value>(&fs::read_to_string(file(name)).unwrap()).unwrap()["required"].clone();
        // a schema that takes anything would say nothing
        for field in required.as_array().unwrap() {
            let mut without = result.clone();
            without.as_object_mut().unwrap().remove(field.as_str().unwrap());
            assert!(!validator.is_valid(&without), "{arguments}: without {field}");
        }
    }
}

#[test]
fn a_number_that_is_absent_is_valid_and_a_null_is_not() {
    let validator = validator("fit");
    let out = tempfile::tempdir().unwrap();
    let fit = result("fit recordings/ten-cells/plain --machine recordings/ten-cells/ring.json", out.path());
    let is_valid = |path: &str, value: Option<Value>| {
        let mut fit = fit.clone();
        let (parent, name) = path.rsplit_once('/').unwrap();
        let fields = fit.pointer_mut(parent).unwrap().as_object_mut().unwrap();
        match value {
            Some(value) => fields.insert(name.into(), value),
            None => fields.remove(name),
        };
        validator.is_valid(&fit)
    };
    assert!(is_valid("/vars/0/sigma", None));
    assert!(!is_valid("/vars/0/sigma", Some(Value::Null)));
    assert!(!is_valid("/vars/0/name", None));
    assert!(is_valid("/absent", Some(json!({"vars.0.sigma": "NaN"}))));
    assert!(!is_valid("/absent", Some(json!({"vars.0.sigma": 1}))));
}
