//! What reads bytes: every reader of a file and every packet.

mod calibrations;
mod daemon;
mod lattices;
mod matrices;
mod packets;
mod recordings;

use std::fs;
use std::path::{Path, PathBuf};

/// Something that reads.
#[derive(Clone, Copy)]
pub struct Target {
    /// Its name, that of its folder in the corpus.
    pub name: &'static str,
    /// Inputs that it reads well.
    pub seeds: fn() -> Vec<Vec<u8>>,
    /// Read an input and use it as the program does; false if it is refused.
    pub read: fn(&[u8]) -> bool,
}

/// All of them.
pub fn targets() -> impl Iterator<Item = Target> {
    let all: [&[Target]; 6] = [
        &lattices::TARGETS,
        &matrices::TARGETS,
        &recordings::TARGETS,
        &calibrations::TARGETS,
        &daemon::TARGETS,
        &packets::TARGETS,
    ];
    all.into_iter().flatten().copied()
}

/// One by its name.
pub fn target(name: &str) -> Option<Target> {
    targets().find(|target| target.name == name)
}

/// Where the recordings are.
pub fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn file(path: &str) -> Vec<u8> {
    fs::read(repository().join(path)).expect("a file that ships with the repository")
}

fn text(path: &str) -> String {
    String::from_utf8(file(path)).expect("a text that ships with the repository")
}

/// Use bytes as a file of this name in a folder of its own.
fn with_file(name: &str, bytes: &[u8], read: impl FnOnce(&Path) -> bool) -> bool {
    let folder = tempfile::tempdir().expect("the system has room for a file");
    let path = folder.path().join(name);
    fs::write(&path, bytes).expect("the system has room for a file");
    read(&path)
}
