//! The files of a measured ring.

use std::fs;

use measured::{Folder, RawOrbits};

use super::lattices::is_stable;
use super::{Target, file, repository, with_file};

const RING: &str = "recordings/measured/twelve-cells/before";

pub(super) const TARGETS: [Target; 7] = [
    Target { name: "ring_lattice", seeds: || seeds("lattice.csv"), read: |bytes| folder("lattice.csv", bytes) },
    Target { name: "ring_monitors", seeds: || seeds("bpms.csv"), read: |bytes| folder("bpms.csv", bytes) },
    Target {
        name: "ring_correctors",
        seeds: || seeds("correctors.csv"),
        read: |bytes| folder("correctors.csv", bytes),
    },
    Target { name: "ring_meta", seeds: || seeds("meta.json"), read: |bytes| folder("meta.json", bytes) },
    Target {
        name: "ring_matrix",
        seeds: || seeds("orm_measured_mm.csv"),
        read: |bytes| folder("orm_measured_mm.csv", bytes),
    },
    Target {
        name: "ring_dispersion",
        seeds: || seeds("dispersion_orbit_mm.csv"),
        read: |bytes| folder("dispersion_orbit_mm.csv", bytes),
    },
    Target { name: "raw_orbits", seeds: || vec![b"1,2\n3,4\n".to_vec()], read: raw },
];

fn seeds(name: &str) -> Vec<Vec<u8>> {
    vec![file(&format!("{RING}/{name}"))]
}

/// A ring with one of its files changed.
fn folder(name: &str, bytes: &[u8]) -> bool {
    with_file(name, bytes, |path| {
        let own = path.parent().expect("it is in a folder");
        for entry in fs::read_dir(repository().join(RING)).expect("a folder that ships with the repository").flatten() {
            if entry.file_name() != name {
                fs::copy(entry.path(), own.join(entry.file_name())).expect("the system has room for a file");
            }
        }
        Folder::read(own).is_ok_and(|folder| is_stable(&folder))
    })
}

/// Orbits beside good ones.
fn raw(bytes: &[u8]) -> bool {
    with_file("raw_orbit_minus_mm.csv", bytes, |path| {
        let write = |name: &str, bytes: &[u8]| {
            fs::write(path.with_file_name(name), bytes).expect("the system has room for a file")
        };
        write("raw_orbit_plus_mm.csv", b"1,2\n3,4\n");
        write("meta.json", b"{\"actuator_delta_A\": [1.0, 2.0]}");
        RawOrbits::read(path.parent().expect("it is in a folder")).is_ok()
    })
}
