//! Recordings of the repository that the tests read.

use std::path::Path;

use twin::Ring;

use crate::recording::Recording;

/// A recording of a ring, by its folder.
pub fn recorded(ring: &Ring, folder: &str) -> Recording {
    Recording::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings").join(folder), ring).unwrap()
}

/// The ring of ten cells, and a recording of it.
pub fn ten_cells() -> (Ring, Recording) {
    let ring = concat!(env!("CARGO_MANIFEST_DIR"), "/../recordings/ten-cells/ring.json");
    let ring = Ring::read(ring.as_ref()).unwrap();
    let recording = recorded(&ring, "ten-cells/plain");
    (ring, recording)
}
