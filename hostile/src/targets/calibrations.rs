//! Results that are read again: a fit to export, tables of a model, an effect in words.

use std::fs;
use std::path::Path;
use std::sync::LazyLock;

use lattices::export::{self, Calibration, Format, Lattice};
use results::StatedModel;
use serde_json::json;
use training::Tables;
use twin::limits;
use twin::{Effect, Ring};

use super::{Target, with_file};

pub(super) const TARGETS: [Target; 3] = [
    Target { name: "calibration", seeds: || vec![fit()], read: calibration },
    Target { name: "model_file", seeds: model_files, read: model_file },
    Target { name: "effect", seeds: effects, read: effect },
];

static RING: LazyLock<Ring> = LazyLock::new(Ring::booster);

fn fit() -> Vec<u8> {
    let vars: Vec<_> =
        RING.var_names().into_iter().map(|name| json!({"name": name, "mean": 1.01, "sigma": 0.01})).collect();
    let finding =
        |kind: &str, at: &str| json!({"kind": kind, "at": at, "amplitude": 0.01, "probability": 0.99, "sentence": "s"});
    let findings = [finding("bpm_gain", "x_E4"), finding("quad_roll", "D8"), finding("dipole_edge", "")];
    let fit =
        json!({"recording": "r", "vars": vars, "vars_after": vars, "findings": findings, "other": [], "wiring": []});
    fit.to_string().into_bytes()
}

/// As `orbitcal export`, and as the model that a matrix is held against.
fn calibration(bytes: &[u8]) -> bool {
    let Ok(text) = core::str::from_utf8(bytes) else { return false };
    let _ = limits::json::<StatedModel>(text);
    let Ok(calibration) = Calibration::parse(text, "fit.json") else { return false };
    let Ok(lattice) = Lattice::of(&RING, &calibration, Path::new("fit.json")) else { return false };
    Format::ALL.into_iter().all(|format| !export::text(&lattice, format).is_empty())
}

fn model_files() -> Vec<Vec<u8>> {
    let tables: Tables = training::green::tables(&RING).expect("the built-in ring has tables");
    let folder = tempfile::tempdir().expect("the system has room for a file");
    let path = folder.path().join("model");
    results::model_file::write(&path, &RING.name, &tables).expect("the system has room for a file");
    vec![fs::read(&path).expect("it was written")]
}

fn model_file(bytes: &[u8]) -> bool {
    with_file("model", bytes, |path| results::model_file::read(path, &RING).is_ok())
}

fn effects() -> Vec<Vec<u8>> {
    ["quad_roll@D8=0.01", "bpm_swap@x_E4,x_E6", "stray_gradient@SLOT_F6=1e-3", "dipole_edge=0.01"]
        .map(Into::into)
        .to_vec()
}

fn effect(bytes: &[u8]) -> bool {
    let Ok(text) = core::str::from_utf8(bytes) else { return false };
    Effect::parse(text, &RING).is_ok() | control::simulated::Fault::parse(text, &RING).is_ok()
}
