//! Lattices of other codes, tables of a response and LOCO files.

use std::io::Read;
use std::path::Path;
use std::sync::LazyLock;

use flate2::read::ZlibDecoder;
use lattices::import::{
    Conventions, Input, Instruments, KickIs, Lacking, Lattice, Measurement, OrbitUnit, Order, Pattern, PerInstrument,
    Signs, Table, agreement, assemble, bare,
};
use measured::{Folder, MeasuredError};
use twin::{Hold, Optics, Rf};

use super::{Target, file, repository, with_file};

pub(super) const TARGETS: [Target; 11] = [
    Target { name: "at_json", seeds: || imports(&["twelve-cells.at.json"]), read: lattice },
    Target { name: "at_mat", seeds: || inflated("twelve-cells.at.mat"), read: lattice },
    Target { name: "loco_mat", seeds: || inflated("twelve-cells.loco.mat"), read: lattice },
    Target { name: "octave_mat", seeds: || imports(&["twelve-cells.octave.mat"]), read: lattice },
    Target { name: "madx", seeds: || imports(&["twelve-cells.tfs"]), read: lattice },
    Target { name: "xsuite", seeds: || imports(&["twelve-cells.xsuite.json"]), read: lattice },
    Target { name: "pals", seeds: || imports(&["twelve-cells.pals.yaml"]), read: lattice },
    Target { name: "table", seeds: || imports(&["response.csv", "response.txt", "dispersion.csv"]), read: table },
    Target { name: "table_binary", seeds: binary_tables, read: table },
    Target { name: "pyaml", seeds: || imports(&["response.pyaml.json", "response.pyaml.yaml"]), read: table },
    Target { name: "sdds", seeds: || imports(&["response-x.sdds", "response-y.sdds"]), read: table },
];

fn imports(names: &[&str]) -> Vec<Vec<u8>> {
    names.iter().map(|name| file(&format!("recordings/measured/imports/{name}"))).collect()
}

fn binary_tables() -> Vec<Vec<u8>> {
    imports(&["response.h5", "values.v73.mat", "values.octave.mat"])
}

/// A MAT-file of level 5, and the same without compression, so that changes reach what is within.
fn inflated(name: &str) -> Vec<Vec<u8>> {
    let packed = imports(&[name]).remove(0);
    let (header, mut rest) = packed.split_at(128);
    let mut plain = header.to_vec();
    while let Some((head, after)) = rest.split_first_chunk::<8>() {
        let (kind, length) = (u32::from_le_bytes([head[0], head[1], head[2], head[3]]), &head[4..]);
        let length = u32::from_le_bytes(length.try_into().expect("four bytes")) as usize;
        let (contents, next) = after.split_at(length.min(after.len()));
        match kind {
            COMPRESSED => _ = ZlibDecoder::new(contents).read_to_end(&mut plain).expect("a good file"),
            _ => plain.extend([head, contents].concat()),
        }
        rest = next;
    }
    vec![plain, packed]
}

/// The kind of an element that holds another one, deflated.
const COMPRESSED: u32 = 15;

/// As `orbitcal import` without a matrix.
fn lattice(bytes: &[u8]) -> bool {
    with_file("lattice", bytes, |path| imported(path).unwrap_or(false))
}

fn imported(path: &Path) -> Result<bool, MeasuredError> {
    let lacking = Lacking { kick: None, rf: None };
    let folder = match Input::read(path, &lacking)? {
        Input::Loco(loco) => loco.folder,
        Input::Lattice(lattice) => bare(&lattice, &instruments(&lattice)?)?,
    };
    Ok(is_stable(&folder) | agreement(&folder, Rf::FixedFrequency).is_ok())
}

/// By their types, or as they are called in the seeds.
fn instruments(lattice: &Lattice) -> Result<Instruments, MeasuredError> {
    let named = |name: &str| [name.parse::<Pattern>().expect("a pattern")];
    Instruments::choose(lattice, &[], &[]).or_else(|_| Instruments::choose(lattice, &named("BPM*"), &named("C*")))
}

pub(super) fn is_stable(folder: &Folder) -> bool {
    let tunes = |ring| Optics::of(&ring, Hold::Momentum { delta: 0.0 }).and_then(|optics| optics.tunes()).is_ok();
    measured::lattice::ring(folder, &[], &[]).is_ok_and(tunes)
}

/// As `orbitcal import` with a matrix.
fn table(bytes: &[u8]) -> bool {
    static LATTICE: LazyLock<Lattice> = LazyLock::new(|| {
        let path = repository().join("recordings/measured/imports/twelve-cells.at.json");
        Lattice::read(&path).expect("a lattice that ships with the repository")
    });
    let conventions = Conventions {
        unit: OrbitUnit::Millimetres,
        kick: PerInstrument::All(1.0),
        kick_is: KickIs::Full,
        signs: Signs([false; 2]),
        noise: PerInstrument::All(0.001),
    };
    let assembled = |matrix: &Table, order| {
        let instruments = instruments(&LATTICE)?;
        let measurement = Measurement { matrix, dispersion: None, order, conventions: &conventions };
        let with = Measurement { dispersion: Some((matrix, 1e3)), ..measurement.clone() };
        let _ = assemble(&LATTICE, &instruments, Some(5e8), &with);
        agreement(&assemble(&LATTICE, &instruments, Some(5e8), &measurement)?, Rf::FixedFrequency)
    };
    with_file("table", bytes, |path| {
        let read = |name: &&str| Table::read(Path::new(&format!("{}{name}", path.display()))).ok();
        let tables: Vec<Table> = DATASETS.iter().filter_map(read).collect();
        for order in [None, Some(Order::Planes)] {
            tables.iter().for_each(|table| drop(assembled(table, order)));
        }
        !tables.is_empty()
    })
}

/// The file, and datasets of it: those of the seeds and of the corpus.
const DATASETS: [&str; 8] = [
    "",
    ":i8",
    ":/response_matrix",
    ":/measured_eta_x,/measured_eta_y",
    ":/d0",
    ":/d0,/d1,/d2,/d0",
    ":rf_response",
    ":s",
];
