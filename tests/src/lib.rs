//! What the system tests share: where the repository's files lie, and the truth behind its recordings.

pub mod attackers;
pub mod cells;
pub mod drift;
pub mod endurance;
pub mod faults;
pub mod feedback;
pub mod machine;
pub mod posterior;
pub mod qemu;
pub mod sil;
pub mod soak;
pub mod surrogates;

use std::path::{Path, PathBuf};

use inference::Recording;
use twin::Ring;

/// A file or folder of the repository.
pub fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

/// A recording that ships with the repository, and the built-in machine that it is of.
///
/// # Panics
/// If it cannot be read.
pub fn recording(name: &str) -> (Ring, Recording) {
    let folder = repository("recordings").join(name);
    let ring = Recording::built_in_ring(&folder).expect("of a built-in machine");
    let recording = Recording::read(&folder, &ring).expect("a recording of the repository");
    (ring, recording)
}

/// True vars of a recording, in the order of the ring's quadrupoles [N].
///
/// # Panics
/// If the recording has no `truth.json` with every var.
pub fn truth(recording: &str, ring: &Ring) -> Vec<f64> {
    let text = std::fs::read_to_string(repository(recording).join("truth.json")).expect("a recording with its truth");
    let truth: serde_json::Value = serde_json::from_str(&text).expect("truth is JSON");
    let var = |name: &String| truth["vars"][name].as_f64().expect("a number for every var");
    ring.var_names().iter().map(var).collect()
}

/// The folder of a measured ring, if there is one: the measurements have no licence and are not part of the repository. They are looked for in
/// `ORBITCAL_MEASURED`, then in `../shared/recordings/real` beside the checkout; where there is none, that is said.
pub fn measured_ring(name: &str) -> Option<std::path::PathBuf> {
    let folder = std::env::var_os("ORBITCAL_MEASURED")
        .map_or_else(|| repository("../shared/recordings/real"), std::path::PathBuf::from);
    let folder = folder.join(name);
    if !folder.is_dir() {
        eprintln!("{} is absent: not tested", folder.display());
        return None;
    }
    Some(folder)
}
