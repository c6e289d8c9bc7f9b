//! Lattices as their codes wrote them (recordings/measured/imports), and what is refused.

use std::fs;
use std::path::{Path, PathBuf};

use lattices::import::{
    Conventions, Input, Instruments, KickIs, Lacking, Lattice, Measurement, OrbitUnit, Order, PerInstrument, Signs,
    Table, assemble, bare, write,
};
use measured::lattice::ring;
use measured::unknowns::groups;
use measured::{Folder, MeasuredError, Model, Settings};
use nalgebra::DMatrix;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use tempfile::TempDir;
use twin::{Hold, Optics, Rf, Tunes};

const FILES: [&str; 6] = [
    "twelve-cells.at.json",
    "twelve-cells.at.mat",
    "twelve-cells.octave.mat",
    "twelve-cells.tfs",
    "twelve-cells.xsuite.json",
    "twelve-cells.pals.yaml",
];

fn recorded(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/measured").join(name)
}

/// A lattice and its instruments, by patterns where the file has no types for them.
fn imported(path: &Path) -> Result<(Lattice, Instruments), MeasuredError> {
    let lattice = Lattice::read(path)?;
    let by = |pattern: &str| [pattern.parse().unwrap()];
    let instruments = Instruments::choose(&lattice, &by("bpm*"), &by("cor*"))?;
    Ok((lattice, instruments))
}

fn tunes(folder: &Folder) -> Tunes {
    Optics::of(&ring(folder, &[], &[]).unwrap(), Hold::Momentum { delta: 0.0 }).unwrap().tunes().unwrap()
}

/// The response [mm/mrad] of the lattice as written.
fn response(folder: &Folder) -> DMatrix<f64> {
    Model::of(folder, &groups(folder), Rf::FixedMomentum).unwrap().as_written().unwrap()
}

fn conventions() -> Conventions {
    Conventions {
        unit: OrbitUnit::Millimetres,
        kick: PerInstrument::parse("--kick", "x=0.2,y=0.15").unwrap(),
        kick_is: KickIs::Full,
        signs: Signs([true, true]),
        noise: PerInstrument::parse("--noise", "0.002").unwrap(),
    }
}

/// The measurement of the twelve cells by a lattice file and a table.
fn measurement(file: &str, table: &str, order: Option<Order>, conventions: &Conventions) -> Folder {
    let (lattice, instruments) = imported(&recorded("imports").join(file)).unwrap();
    let table = Table::read(&recorded("imports").join(table)).unwrap();
    let dispersion = Table::read(&recorded("imports/dispersion.csv")).unwrap();
    let dispersion = order.is_none().then_some((&dispersion, 2000.0));
    let measured = Measurement { matrix: &table, dispersion, order, conventions };
    assemble(&lattice, &instruments, Some(499_654_096.7), &measured).unwrap()
}

#[test]
fn tunes_are_those_that_madx_wrote() {
    let table = fs::read_to_string(recorded("imports/twelve-cells.tfs")).unwrap();
    let stated = |name: &str| -> f64 {
        let line = table.lines().find(|line| line.split_whitespace().nth(1) == Some(name)).unwrap();
        line.split_whitespace().nth(3).unwrap().parse().unwrap()
    };
    for file in FILES {
        let (lattice, instruments) = imported(&recorded("imports").join(file)).unwrap();
        let tunes = tunes(&bare(&lattice, &instruments).unwrap());
        // MAD-X and the twin agree to 3e-10 with angles of 15 digits
        assert!((tunes.x - stated("Q1")).abs() < 1e-9 && (tunes.y - stated("Q2")).abs() < 1e-9, "{file}: {tunes:?}");
    }
}

#[test]
fn all_formats_give_one_matrix() {
    let of = |file: &str| {
        let (lattice, instruments) = imported(&recorded("imports").join(file)).unwrap();
        response(&bare(&lattice, &instruments).unwrap())
    };
    let first = of(FILES[0]);
    for file in &FILES[1..] {
        let largest = (of(file) - &first).amax();
        assert!(largest < 1e-6, "{file}: {largest} mm/mrad");
    }
}

#[test]
fn what_is_imported_is_what_was_measured() {
    let measured = Folder::read(&recorded("twelve-cells/before")).unwrap();
    let imported = measurement(FILES[0], "response.csv", None, &conventions());
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("ring");
    write(&imported, &path, &Settings::default()).unwrap();
    let read = Folder::read(&path).unwrap();
    assert_eq!((&read.matrix, &read.dispersion), (&measured.matrix, &measured.dispersion));
    for (own, other) in read.correctors.iter().zip(&measured.correctors) {
        assert_eq!((own.plane, own.at, own.kick), (other.plane, other.at, other.kick));
    }
    for (own, other) in read.monitors.iter().zip(&measured.monitors) {
        assert_eq!((own.plane, own.at, own.sigma), (other.plane, other.at, other.sigma));
    }
    assert!((read.meta.rf - measured.meta.rf).abs() < 0.1 && read.meta.delta_rf == measured.meta.delta_rf);
    assert!(twin::Ring::read(&path.join("machine.json")).is_ok());
    let again = write(&imported, &path, &Settings::default()).unwrap_err().to_string();
    assert!(again.contains("ring"), "{again}");
}

#[test]
fn a_dataset_of_hdf5_is_a_table_without_names() {
    let file = recorded("imports/response.h5");
    let of = |path: &str| Table::read(Path::new(&format!("{}{path}", file.display())));
    let (lattice, instruments) = imported(&recorded("imports/twelve-cells.at.mat")).unwrap();
    let folder = |table: &Table, unit| {
        let conventions = Conventions { unit, ..conventions() };
        let measured =
            Measurement { matrix: table, dispersion: None, order: Some(Order::Planes), conventions: &conventions };
        assemble(&lattice, &instruments, None, &measured)
    };
    let own = folder(&of(":/response_matrix").unwrap(), OrbitUnit::Metres).unwrap();
    let other = folder(&Table::read(&recorded("imports/response.txt")).unwrap(), OrbitUnit::Millimetres).unwrap();
    // metres of the file, rounded once each way
    assert!((own.matrix - other.matrix).amax() < 1e-15);
    let said = |path: &str| of(path).unwrap_err().to_string();
    assert!(said("").contains("response.h5:PATH; it has /dkick (f64), /measured_eta_x (12 f64), /measured_eta_y"));
    assert!(said(":/orm").contains("path not found: orm; the file has /dkick (f64)"), "{}", said(":/orm"));
    assert!(said(":/dkick").contains("expected a matrix or a list of numbers, found f64"));
    let both = of(":/measured_eta_x,/measured_eta_y").unwrap();
    assert!(folder(&both, OrbitUnit::Metres).unwrap_err().to_string().contains("1 columns, the lattice has 24"));
    assert!(
        said(":/response_matrix,/measured_eta_x")
            .contains("/measured_eta_x: 1 numbers in a line, 24 in the dataset before it")
    );
    let conventions = Conventions { unit: OrbitUnit::Metres, ..conventions() };
    let dispersion = Some((&both, 2000.0));
    let matrix = &of(":/response_matrix").unwrap();
    let measured = Measurement { matrix, dispersion, order: Some(Order::Planes), conventions: &conventions };
    let dispersion = assemble(&lattice, &instruments, None, &measured).unwrap().dispersion.unwrap();
    let stated = measurement("twelve-cells.at.json", "response.csv", None, &self::conventions()).dispersion.unwrap();
    assert!((dispersion - stated).amax() < 1e-15);
    let column = folder(&Table::read(&recorded("imports/values.octave.mat:i8")).unwrap(), OrbitUnit::Metres);
    assert!(
        column
            .unwrap_err()
            .to_string()
            .contains("values.octave.mat:i8: 2 lines, the lattice has 24 channels in that order")
    );
    let lattice = Table::read(&recorded("imports/twelve-cells.at.mat:RING")).unwrap_err().to_string();
    assert!(lattice.ends_with("RING: expected numbers, found 1x90 cells"), "{lattice}");
}

#[test]
fn no_byte_of_a_table_makes_it_panic() {
    let mut random = StdRng::seed_from_u64(8);
    let seeds = ["response.h5", "response-x.sdds", "response-y.sdds", "response.pyaml.json", "response.pyaml.yaml"];
    for (name, column) in seeds.into_iter().zip([":/response_matrix", "", "", "", ""]) {
        let whole = fs::read(recorded("imports").join(name)).unwrap();
        for _ in 0..1500 {
            let mut bytes = whole.clone();
            for _ in 0..random.random_range(1..4) {
                // what is behind the mark of the format; in half of the inputs the header, where the shapes stand
                let end = if random.random() { bytes.len() } else { bytes.len() / 3 };
                let at = random.random_range(8..end);
                bytes[at] = if random.random() { 0xff } else { random.random() };
            }
            if random.random_range(0..8) == 0 {
                bytes.truncate(random.random_range(8..whole.len()));
            }
            let folder = TempDir::new().unwrap();
            let path = folder.path().join("some.table");
            fs::write(&path, bytes).unwrap();
            for column in [column, ":s", ":rf_response"] {
                drop(Table::read(Path::new(&format!("{}{column}", path.display()))));
            }
        }
    }
}

#[test]
fn conventions_change_units_sizes_and_signs_and_nothing_else() {
    let plain = measurement("twelve-cells.tfs", "response.txt", Some(Order::Planes), &conventions());
    let other =
        Conventions { unit: OrbitUnit::Metres, kick_is: KickIs::Half, signs: Signs([false, true]), ..conventions() };
    let other = measurement("twelve-cells.tfs", "response.txt", Some(Order::Planes), &other);
    assert_eq!(other.matrix[(0, 0)], -1e3 * plain.matrix[(0, 0)]);
    assert_eq!(other.matrix[(0, 12)], 1e3 * plain.matrix[(0, 12)]);
    assert_eq!((other.correctors[0].kick, other.monitors[0].sigma), (0.4, 2.0));
}

/// A pyAT file of these elements.
fn at(elements: &str) -> (TempDir, PathBuf) {
    file("ring.json", &format!(r#"{{"atjson": 1, "elements": [{elements}], "properties": {{"energy": 1.5e9}}}}"#))
}

fn file(name: &str, text: &str) -> (TempDir, PathBuf) {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join(name);
    fs::write(&path, text).unwrap();
    (folder, path)
}

fn refused(path: &Path) -> String {
    imported(path).unwrap_err().to_string()
}

/// A file of pyAT may state how often it is repeated; without that one cell is no ring, though its tunes would be those of a cell.
#[test]
fn one_period_is_not_taken_for_the_ring() {
    let dipole = format!(
        r#"{{"FamName": "B", "Class": "Dipole", "Length": 1, "BendingAngle": {}, "EntranceAngle": 0.1, "ExitAngle": 0.1}}"#,
        core::f64::consts::TAU / 12.0
    );
    let read = |properties: &str| {
        let text = format!(r#"{{"atjson": 1, "elements": [{BPM}, {COR}, {dipole}], "properties": {{{properties}}}}}"#);
        let (_folder, path) = file("ring.json", &text);
        Input::read(&path, &Lacking::default())
    };
    let said = read("").unwrap_err().to_string();
    let expected = "the dipoles bend by 30.0000 degrees, expected the 360 of a ring; it looks like one of 12 periods: state the periodicity, or write all of the ring";
    assert!(said.ends_with(expected), "{said}");
    let Input::Lattice(lattice) = read(r#""periodicity": 12"#).unwrap() else { panic!("a lattice") };
    assert_eq!(lattice.elements.len(), 36);
    let said = read(r#""periodicity": 7"#).unwrap_err().to_string();
    assert!(said.ends_with("the dipoles bend by 210.0000 degrees, expected the 360 of a ring"), "{said}");
    // a table of MAD-X states no periodicity
    let text = fs::read_to_string(recorded("imports/twelve-cells.tfs")).unwrap();
    let (cell, _) = text.split_once(" \"BPM.8\"").unwrap();
    let (_folder, path) = file("ring.tfs", cell);
    let said = Input::read(&path, &Lacking::default()).unwrap_err().to_string();
    assert!(
        said.ends_with("expected the 360 of a ring; it looks like one of 12 periods: write all of the ring"),
        "{said}"
    );
}

const BPM: &str = r#"{"FamName": "BPM", "Class": "Monitor", "Length": 0.2}"#;
const COR: &str =
    r#"{"FamName": "COR", "Class": "Quadrupole", "Length": 0.4, "PolynomB": [0, 2], "PolynomA": [0, 0.1]}"#;

#[test]
fn long_monitors_and_correctors_in_magnets_act_in_the_middle() {
    let (_folder, path) = at(&format!("{BPM}, {COR}"));
    let (lattice, instruments) = imported(&path).unwrap();
    let folder = bare(&lattice, &instruments).unwrap();
    let rows: Vec<(f64, f64, f64)> = folder.lattice.iter().map(|one| (one.s, one.length, one.k1)).collect();
    let halves = [(0.0, 0.1, 0.0), (0.1, 0.0, 0.0), (0.1, 0.1, 0.0), (0.2, 0.2, 2.0), (0.4, 0.0, 0.0), (0.4, 0.2, 2.0)];
    assert_eq!(rows, halves);
    assert_eq!((folder.monitors[0].at, folder.correctors[0].at), (1, 4));
    assert_eq!(groups(&folder)[0], [[3, 5]], "the halves are one magnet");
    assert_eq!(lattice.left_out["skew gradient (couples the planes)"], 1);
}

/// Correctors that are windings of dipoles with a gradient of -0.5 /m^2, by pyAT, which spreads a `KickAngle` along its magnet: a thin kick in the middle
/// gives 3 % less in x and more in y.
#[test]
fn a_corrector_in_a_magnet_kicks_all_along_it() {
    let drift = |length: f64| format!(r#"{{"FamName": "D", "Class": "Drift", "Length": {length}}}"#);
    let quadrupole = |length: f64, k1: f64| {
        format!(r#"{{"FamName": "Q", "Class": "Quadrupole", "Length": {length}, "PolynomB": [0, {k1}]}}"#)
    };
    let bend = core::f64::consts::TAU / 16.0;
    let dipole = format!(
        r#"{{"FamName": "cor", "Class": "Dipole", "Length": 1.2, "BendingAngle": {bend}, "PolynomB": [0, -0.5]}}"#
    );
    let (focusing, other) = (quadrupole(0.4, 1.6), quadrupole(0.5, 0.4));
    let monitor = r#"{"FamName": "bpm", "Class": "Monitor", "Length": 0}"#.to_owned();
    let gap = || drift(0.4);
    let cell = [monitor, drift(0.5), focusing, gap(), dipole.clone(), gap(), other, gap(), dipole, drift(0.5)];
    let text = format!(
        r#"{{"atjson": 1, "elements": [{}], "properties": {{"energy": 1.5e9, "periodicity": 8}}}}"#,
        cell.join(", ")
    );
    let (_folder, path) = file("ring.json", &text);
    let (lattice, instruments) = imported(&path).unwrap();
    let response = response(&bare(&lattice, &instruments).unwrap());
    // x of the first monitor to all windings in x, y to all in y [mm/mrad]
    let by_pyat = [
        [
            2.32419, 3.03558, 3.45351, 2.15833, 1.05845, -0.92154, -2.41678, -3.06096, -3.42564, -2.07661, -0.93856,
            1.02696, 2.50634, 3.08250, 3.39346, 1.99228,
        ],
        [
            1.31803, 1.57007, 0.09145, -0.89387, -1.37738, -0.98993, 0.80250, 1.53635, 0.85654, -0.00719, -1.35842,
            -1.53169, 0.02510, 1.00129, 1.34212, 0.88183,
        ],
    ];
    for (plane, expected) in by_pyat.into_iter().enumerate() {
        let found = response.view((8 * plane, 16 * plane), (1, 16));
        let off = found.iter().zip(expected).map(|(found, expected)| (found - expected).abs()).fold(0.0, f64::max);
        // pyAT's ten steps a magnet
        assert!(off < 1e-4 * found.amax(), "plane {plane}: {off}");
    }
}

#[test]
fn a_roll_by_an_eighth_of_a_turn_leaves_no_normal_gradient() {
    let s = core::f64::consts::FRAC_1_SQRT_2;
    let rolled = format!(
        r#"{{"FamName": "COR", "Class": "Quadrupole", "Length": 0.4, "PolynomB": [0, 2], "R1": [[{s}, 0, {s}]]}}"#
    );
    let (_folder, path) = at(&format!("{BPM}, {rolled}"));
    let (lattice, _) = imported(&path).unwrap();
    assert_eq!(lattice.elements[1].k1, 0.0);
    assert_eq!(lattice.left_out.len(), 1);
}

/// By pyAT: a magnet that is tracked as a drift has no field, and method 0 of an edge no soft one.
#[test]
fn a_magnet_that_is_switched_off_has_no_field() {
    let of = |element: &str| {
        let (_folder, path) = at(&format!("{BPM}, {COR}, {element}"));
        imported(&path).unwrap().0.elements[2].clone()
    };
    let quadrupole = r#""FamName": "Q", "Class": "Quadrupole", "Length": 0.4, "PolynomB": [0, 2], "PassMethod""#;
    assert_eq!(of(&format!(r#"{{{quadrupole}: "DriftPass"}}"#)).k1, 0.0);
    assert_eq!(of(&format!(r#"{{{quadrupole}: "StrMPoleSymplectic4RadPass"}}"#)).k1, 2.0);
    let dipole = r#""FamName": "B", "Class": "Dipole", "Length": 1, "BendingAngle": 0.1, "EntranceAngle": 0.05, "FullGap": 0.04, "FringeInt1": 0.5, "FringeInt2": 0.5"#;
    let whole = of(&format!("{{{dipole}}}"));
    let half = of(&format!(r#"{{{dipole}, "FringeBendExit": 0}}"#));
    assert_eq!((whole.fringe, whole.edge_in, half.fringe, half.edge_in), (0.02, 0.05, 0.01, 0.05));
    let (_folder, path) = at(&format!(r#"{BPM}, {{{quadrupole}: "CavityPass"}}"#));
    assert!(refused(&path).contains("element Q: pass method CavityPass of a Quadrupole is not known here"));
    // a dipole too: insertion devices are modelled so, and the rest of the ring closes
    let (_folder, path) = at(&format!(r#"{BPM}, {COR}, {{{dipole}, "PassMethod": "DriftPass"}}"#));
    let lattice = imported(&path).unwrap().0;
    assert_eq!((lattice.elements[2].bend, lattice.elements[2].length), (0.0, 1.0));
    let said = lattice.expect_ring().unwrap_err().to_string();
    assert!(
        said.ends_with("bend by 0.0000 degrees, expected the 360 of a ring; 1 of them are tracked as drifts"),
        "{said}"
    );
}

/// What moves the orbit is said, since the twin's is straight.
#[test]
fn kicks_displacements_and_rolls_are_said() {
    let kicked = r#"{"FamName": "K", "Class": "Corrector", "Length": 0, "KickAngle": [1e-3, 0]}"#;
    let dipole = r#"{"FamName": "Q", "Class": "Quadrupole", "Length": 0.4, "PolynomB": [1e-4, 2]}"#;
    let moved =
        r#"{"FamName": "M", "Class": "Quadrupole", "Length": 0.4, "PolynomB": [0, 2], "T1": [1e-3, 0, 0, 0, 0, 0]}"#;
    let rolled = r#"{"FamName": "R", "Class": "Monitor", "Length": 0, "R1": [[0.8, 0, 0.6]]}"#;
    let (_folder, path) = at(&format!("{BPM}, {COR}, {kicked}, {dipole}, {moved}, {rolled}"));
    let left_out: Vec<(&str, usize)> = imported(&path).unwrap().0.left_out.into_iter().collect();
    let begins = ["displacements", "kicks of correctors", "rolls of monitors", "skew gradient"];
    assert!(left_out.iter().zip(begins).all(|((what, _), begin)| what.starts_with(begin)), "{left_out:?}");
    assert_eq!(left_out.iter().map(|(_, count)| *count).collect::<Vec<_>>(), [1, 2, 1, 1]);
}

/// A dipole that is rolled and shifted is the one that stands right, in every format; its gradient turns as a quadrupole's does.
#[test]
fn errors_of_alignment_of_a_dipole_are_left_out_and_said() {
    let (sin, cos) = 2.8e-5_f64.sin_cos();
    let at_file = format!(
        r#"{{"atjson": 1, "elements": [{BPM}, {{"FamName": "cor", "Class": "Dipole", "Length": 1, "BendingAngle": 0.1, "PolynomB": [0, 0.5],
           "R1": [[{cos}, 0, {sin}]], "T1": [1e-4, 0, 0, 0, 0, 0]}}], "properties": {{}}}}"#
    );
    let xsuite = r#"{"element_names": ["bpm", "cor"], "elements": {"bpm": {"__class__": "Marker"},
        "cor": {"__class__": "Bend", "length": 1.0, "angle": 0.1, "k1": 0.5, "rot_s_rad_no_frame": 2.8e-5, "shift_x": 1e-4}}}"#;
    let pals = BY_TAO.replace("L: 2", "L: 1").replace(
        "          e1: 0.05",
        "        MagneticMultipoleP: {Kn1: 0.5}\n        BodyShiftP: {x_rot: 1e-4, z_rot: 2.8e-5}",
    );
    for text in [at_file.as_str(), xsuite, &pals] {
        let (_folder, path) = file("ring", text);
        let (lattice, _) = imported(&path).unwrap();
        let dipole = lattice.elements.last().unwrap();
        assert!((dipole.bend - 0.1).abs() < 1e-12 && (dipole.k1 - 0.5).abs() < 1e-8, "{dipole:?}");
        let said: Vec<&str> = lattice.left_out.into_keys().map(|what| &what[..12]).collect();
        assert_eq!(said, ["displacement", "rolls of dip", "skew gradien"], "{text}");
    }
    // a table of MAD-X has rolls alone
    let text = fs::read_to_string(recorded("imports/twelve-cells.tfs")).unwrap();
    let names = text.lines().find(|line| line.starts_with('*')).unwrap();
    let tilt = names.split_whitespace().skip(1).position(|name| name == "TILT").unwrap();
    let rolled = |line: &str| {
        let mut cells: Vec<&str> = line.split_whitespace().collect();
        cells[tilt] = "2.8e-5";
        cells.join(" ")
    };
    let lines = text.lines().map(|line| if line.contains("\"SBEND\"") { rolled(line) } else { line.to_owned() });
    let (_folder, path) = file("ring.tfs", &lines.collect::<Vec<_>>().join("\n"));
    let (lattice, instruments) = imported(&path).unwrap();
    assert_eq!(lattice.left_out.values().copied().collect::<Vec<_>>(), [12]);
    let [own, flat] = [bare(&lattice, &instruments).unwrap(), {
        let (lattice, instruments) = imported(&recorded("imports/twelve-cells.tfs")).unwrap();
        bare(&lattice, &instruments).unwrap()
    }]
    .map(|folder| tunes(&folder));
    assert_eq!((own.x, own.y), (flat.x, flat.y));
}

/// By Xsuite, `line.insert` leaves slices of a drift; an edge may be switched off.
#[test]
fn a_line_with_something_inserted_is_read() {
    let line = |edge: &str| {
        file(
            "ring.json",
            &format!(
                r#"{{"element_names": ["d..0", "bpm", "d..1", "cor"], "elements": {{"d": {{"__class__": "Drift", "length": 2.0}},
                "d..0": {{"__class__": "DriftSlice", "parent_name": "d", "weight": 0.25}}, "bpm": {{"__class__": "Marker"}},
                "d..1": {{"__class__": "DriftSlice", "parent_name": "d", "weight": 0.75, "slice_offset": 0.5}},
                "cor": {{"__class__": "RBend", "length": 1.0, "angle": 0.1, "shift_x": 0.001, "edge_entry_hgap": 0.02, "edge_entry_fint": 0.5{edge}}}}}}}"#
            ),
        )
    };
    let read = |edge: &str| {
        let (_folder, path) = line(edge);
        imported(&path).unwrap().0
    };
    let lattice = read("");
    let lengths: Vec<f64> = lattice.elements.iter().map(|one| one.length).collect();
    assert_eq!(lengths, [0.5, 0.0, 1.5, 1.0]);
    assert_eq!(lattice.left_out.len(), 2, "displaced, and a soft edge at one side only");
    let edges =
        |lattice: &Lattice| (lattice.elements[3].edge_in, lattice.elements[3].edge_out, lattice.elements[3].fringe);
    assert_eq!(edges(&lattice), (0.05, 0.05, 0.01));
    assert_eq!(edges(&read(r#", "edge_entry_active": 0"#)), (0.0, 0.05, 0.0));
    assert_eq!(edges(&read(r#", "edge_entry_model": "suppressed", "edge_exit_model": "full""#)), (0.0, 0.05, 0.0));
}

#[test]
fn what_the_twin_cannot_carry_is_refused_with_its_element() {
    let thin = r#"{"FamName": "T", "Class": "ThinMultipole", "Length": 0, "PolynomB": [0, 0.3]}"#;
    let wiggler = r#"{"FamName": "W", "Class": "Wiggler", "Length": 1, "PassMethod": "GWigSymplecticPass"}"#;
    let vertical = r#"{"FamName": "V", "Class": "Dipole", "Length": 1, "BendingAngle": 0.1, "R1": [[0, 0, 1]]}"#;
    let infinite = r#"{"FamName": "I", "Class": "Drift", "Length": Infinity}"#;
    for (element, said) in [
        (thin, "element T: a thin quadrupole of 0.3 /m"),
        (wiggler, "element W: class Wiggler acts on the orbit"),
        (vertical, "element V: a dipole rolled by 1.57"),
        (infinite, "element I: Length: expected a number from -1e15 to 1e15, found null"),
    ] {
        let (_folder, path) = at(element);
        let found = refused(&path);
        assert!(found.contains(said), "{found}");
    }
}

#[test]
fn a_dipole_of_xsuite_bends_by_its_field_as_its_reference_orbit_does() {
    let line = |field: &str| {
        let bend = format!(r#"{{"__class__": "Bend", "length": 1.0, "angle": 0.1{field}}}"#);
        file(
            "ring.json",
            &format!(
                r#"{{"element_names": ["bpm", "cor"], "elements": {{"bpm": {{"__class__": "Marker"}}, "cor": {bend}}}}}"#
            ),
        )
    };
    for same in ["", r#", "k0": 0.1"#, r#", "k0": 0.2, "k0_from_h": true"#] {
        let (_folder, path) = line(same);
        assert_eq!(imported(&path).unwrap().0.elements[1].bend, 0.1);
    }
    let (_folder, path) = line(r#", "k0": 0.11"#);
    assert!(refused(&path).contains("element cor: field k0 0.11 /m bends by 0.11 rad, the reference orbit by 0.1 rad"));
}

#[test]
fn a_replica_of_itself_is_refused() {
    let line = r#"{"element_names": ["a"], "elements": {"a": {"__class__": "Replica", "parent_name": "b"}, "b": {"__class__": "Replica", "parent_name": "a"}}}"#;
    let (_folder, path) = file("ring.json", line);
    assert!(refused(&path).contains("element a, a replica: expected at most 64 levels within each other, found 65"));
}

/// As Tao writes: `L`, `pc_ref`, and a dipole's numbers among `ParticleP`.
const BY_TAO: &str = "PALS:
  facility:
    - begin:
        kind: BeginningEle
        ReferenceP:
          pc_ref: 1.5e9
    - bpm:
        kind: Drift
        L: 0.5
    - cor:
        kind: SBend
        L: 2
        ParticleP:
          g_ref: 0.1
          e1: 0.05
    - ring:
        kind: BeamLine
        line: [begin, bpm, cor]
    - lat:
        kind: Lattice
        branches:
          - ring
";

#[test]
fn the_words_of_tao_in_pals_are_read() {
    let (_folder, path) = file("ring.pals.yaml", BY_TAO);
    let (lattice, _) = imported(&path).unwrap();
    let [bpm, cor] = lattice.elements.as_slice() else { panic!("{:?}", lattice.elements) };
    assert_eq!((bpm.length, cor.length, cor.bend, cor.edge_in), (0.5, 2.0, 0.2, 0.05));
    assert!((lattice.energy.unwrap() - 1.5).abs() < 1e-6);
    let (_folder, path) = file("ring.pals.yaml", &BY_TAO.replace("g_ref", "g"));
    assert!(refused(&path).contains("element cor: a dipole without g_ref or angle_ref"));
}

#[test]
fn a_file_of_no_known_format_is_refused_with_what_it_holds() {
    let said = |text: &str| {
        let (_folder, path) = file("ring.txt", text);
        refused(&path)
    };
    assert!(said(r#"{"lattice": [], "beam": 1}"#).contains("found the keys beam, lattice"));
    assert!(said("Q1: QUADRUPOLE, L=0.3;").contains("found the line \"Q1: QUADRUPOLE, L=0.3;\""));
    assert!(said("@ ENERGY %le 1.5\n* NAME S\n").contains("the table lacks KEYWORD, L, ANGLE"));
    assert!(said("PALS:\n  facility:\n    - use: ring\n").contains("ring stands in a line and not in the facility"));
    assert!(said("PALS: [").contains("ring.txt: "));
    assert!(said("").contains("found the line \"\""));
}

/// Correctors that differ by another field of the file alone; what holds the properties of the ring is none of them.
#[test]
fn instruments_are_chosen_by_any_field() {
    let kicker =
        |common: &str| format!(r#"{{"FamName": "KICK", "Class": "Corrector", "Length": 0, "CommonName": "{common}"}}"#);
    let ring = r#"{"FamName": "SOME_RING", "Class": "RingParam", "Length": 0, "CommonName": "PKH_0"}"#;
    let (_folder, path) = at(&format!("{ring}, {BPM}, {}, {COR}, {}", kicker("PKH_1"), kicker("PKV_1")));
    let lattice = Lattice::read(&path).unwrap();
    let choose = |patterns: &[&str]| {
        let correctors: Vec<_> = patterns.iter().map(|pattern| pattern.parse().unwrap()).collect();
        Instruments::choose(&lattice, &[], &correctors)
    };
    let chosen = choose(&["x:CommonName=pkh*", "y:CommonName=PKV*"]).unwrap();
    assert_eq!(chosen.corrector_names(&lattice), ["x:PKH_1", "y:PKV_1"]);
    // by name and by type as before
    assert_eq!(choose(&["KICK"]).unwrap().corrector_names(&lattice), choose(&[]).unwrap().corrector_names(&lattice));
    assert_eq!(choose(&["*"]).unwrap().correctors.len(), lattice.elements.len() - 1);
    let said = choose(&["SOME*"]).unwrap_err().to_string();
    assert!(said.contains("--correctors SOME*: no element has such a name; there are BPM, COR, KICK"), "{said}");
    let said = choose(&["CommonName=Q*"]).unwrap_err().to_string();
    assert!(said.contains("--correctors CommonName=Q*: no element has such a name; there are PKH_1, PKV_1"), "{said}");
    let said = choose(&["Device=Q*"]).unwrap_err().to_string();
    assert!(said.ends_with("no element has the field; fields that are text are Class, CommonName, FamName"), "{said}");
}

#[test]
fn a_mat_file_is_read_by_the_name_of_its_lattice() {
    let several = recorded("imports/twelve-cells.at.mat");
    let of = |name: &str| Lattice::read(Path::new(&format!("{}:{name}", several.display())));
    assert_eq!(of("RING").unwrap().elements.len(), 90);
    let problem = of("THERING").unwrap_err().to_string();
    assert!(problem.ends_with("THERING is no lattice of AT; found RING (1x90 cells)"), "{problem}");
    let none = recorded("imports/values.octave.mat");
    assert!(
        refused(&none)
            .contains("expected a cell array of elements with FamName, found f (a 1x1 struct), P (a 1x2 struct)")
    );
}

#[test]
fn a_table_of_madx_holds_all_elements_at_their_ends() {
    let text = fs::read_to_string(recorded("imports/twelve-cells.tfs")).unwrap();
    let without: String =
        text.lines().filter(|line| !line.contains("QF.2\"")).map(|line| format!("{line}\n")).collect();
    let (_folder, path) = file("ring.tfs", &without);
    assert!(refused(&path).contains("COR.3 of 0.2 m ends at 0.9 m, the element before it at 0.4 m"));
}

#[test]
fn tables_that_do_not_fit_are_refused() {
    let (lattice, instruments) = imported(&recorded("imports/twelve-cells.at.json")).unwrap();
    let said = |text: &str, order: Option<Order>| {
        let (_folder, path) = file("r.csv", text);
        let conventions = conventions();
        let read = Table::read(&path).and_then(|matrix| {
            assemble(
                &lattice,
                &instruments,
                None,
                &Measurement { matrix: &matrix, dispersion: None, order, conventions: &conventions },
            )
        });
        read.map(|folder| format!("{:?}", folder.matrix)).unwrap_or_else(|error| error.to_string())
    };
    assert!(said("1 2\n3 4\n", None).contains("lines have no names; say their order with --order"));
    assert!(said("1 2\n3 4\n", Some(Order::Pairs)).contains("2 lines, the lattice has 24 channels in that order"));
    assert!(said("1 2\n3\n", None).contains("line 2: 1 numbers, line 1 has 2"));
    assert!(said(",x:COR[1]\nBPM[1],0.5\n", None).contains("BPM[1] has both planes; write x:BPM[1] or y:BPM[1]"));
    assert!(
        said(",x:COR[1]\nx:BPM[13],0.5\n", None)
            .contains("x:BPM[13] is none of the lattice's, which are x:BPM[1], y:BPM[1]")
    );
    assert!(said(",x:COR[1],x:COR[1]\nx:BPM[1],0.5,1\n", None).contains("columns: x:COR[1] stands there twice"));
    assert!(
        said(",x:COR[1]\nx:BPM[1],a\n", None).contains("line 2: expected a number from -1e15 to 1e15, found \"a\"")
    );
    assert!(said("", None).contains("no line of numbers"));
    for mark in ['#', '%', '!'] {
        let comment = format!("  {mark} of a shift, 3 mA\n,x:COR[1]\nx:BPM[1],0.5\n");
        assert!(Table::parse("t", &comment).is_ok(), "{comment}");
    }
    // a comment has commas, a table has spaces
    assert!(said("  # mm, by 0.2 mrad; of May\n_ x:COR[1] y:COR[2]\nx:BPM[2] 0.5 nan\n", None).contains("0.5, NaN"));
    assert!(
        said("# by hand\n\nx:BPM[1] 0.5\n# more\nx:BPM[2] a\n", Some(Order::Planes))
            .contains("line 5: expected a number")
    );
    assert!(said("# by hand\n; x:COR[1]; y:COR[2]\nx:BPM[2]; 0.5;\n", None).contains("0.5, NaN"));
}

/// Blocks of planes are one matrix; what no block has was not measured.
#[test]
fn blocks_are_put_together_by_their_names() {
    let table = |text: &str| Table::parse("t", text).unwrap();
    let x = table(",x:COR[1],x:COR[2]\nx:BPM[1],0.5,1\n");
    let y = || table(",y:COR[1]\ny:BPM[1],3\n");
    let whole = x.clone().joined(y()).unwrap();
    let (lattice, instruments) = imported(&recorded("imports").join(FILES[0])).unwrap();
    let conventions = conventions();
    let measured = Measurement { matrix: &whole, dispersion: None, order: None, conventions: &conventions };
    let folder = assemble(&lattice, &instruments, None, &measured).unwrap();
    assert_eq!(folder.matrix.row(0).iter().take(2).copied().collect::<Vec<_>>(), [0.5, 1.0]);
    assert!(folder.matrix[(0, 2)].is_nan() && folder.matrix[(1, 0)].is_nan() && folder.matrix[(1, 2)] == 3.0);
    let said = whole.joined(y()).unwrap_err().to_string();
    assert_eq!(said, "t: y:BPM[1] to y:COR[1] stands in t too");
    let said = x.joined(table("1 2\n")).unwrap_err().to_string();
    assert_eq!(said, "t: lines or columns have no names, by which several tables are put together");
    // a line of as many columns as fit into a megabyte, and a column of as many lines
    let names = |plane: &str| (1..=60_000).map(move |number| format!("{plane}{number}")).collect::<Vec<_>>();
    let wide = table(&format!(",{}\nx:BPM[1]{}\n", names("c").join(","), ",1".repeat(60_000)));
    let long = table(&format!(",y:COR[1]\n{},1\n", names("r").join(",1\n")));
    let said = wide.joined(long).unwrap_err().to_string();
    assert!(said.contains("t: beside t: expected at most 201326592 bytes in memory"), "{said}");
}

#[test]
fn a_matrix_of_pyaml_says_its_names_and_units() {
    let json = r#"{"type": "pyaml.tuning_tools.orbit_response_matrix_data", "matrix": [[1.5, NaN], [-2, 0.25]],
        "variable_names": ["COR[1]", "COR[1]"], "observable_names": ["BPM[1]", "BPM[1]"], "rf_response": [1e-6, 2e-6],
        "variable_planes": ["H", "V"], "observable_planes": ["H", "V"]}"#;
    let yaml = "matrix:\n- [1.5, .nan]\n- [-2, 0.25]\nobservable_names: ['BPM[1]', 'BPM[1]']\nobservable_planes: [H, V]\n\
        rf_response: [1.0e-6, 2.0e-6]\nvariable_names: ['COR[1]', 'COR[1]']\nvariable_planes: [H, V]\n";
    let (lattice, instruments) = imported(&recorded("imports").join(FILES[0])).unwrap();
    for (name, text) in [("orm.json", json), ("orm.yaml", yaml)] {
        let (_folder, path) = file(name, text);
        let matrix = Table::read(&path).unwrap();
        assert_eq!((matrix.stated.unit, matrix.stated.kick), (Some(OrbitUnit::Metres), Some(1e3)));
        let rf = Table::read(Path::new(&format!("{}:rf_response", path.display()))).unwrap();
        let conventions = Conventions {
            unit: OrbitUnit::Metres,
            kick: PerInstrument::All(1e3),
            noise: PerInstrument::All(0.01),
            ..conventions()
        };
        let measured =
            Measurement { matrix: &matrix, dispersion: Some((&rf, 1.0)), order: None, conventions: &conventions };
        let folder = assemble(&lattice, &instruments, None, &measured).unwrap();
        assert_eq!((folder.matrix[(0, 0)], folder.matrix[(1, 0)], folder.matrix[(1, 1)]), (1500.0, -2000.0, 250.0));
        assert!(folder.matrix[(0, 1)].is_nan());
        assert!((folder.dispersion.unwrap()[1] - 2e-3).abs() < 1e-15);
    }
    let said = |text: &str| {
        let (_folder, path) = file("orm.json", text);
        Table::read(&path).unwrap_err().to_string()
    };
    let wrong = said(&json.replace(r#""variable_planes": ["H", "V"]"#, r#""variable_planes": ["H", "S"]"#));
    assert!(wrong.ends_with("variable_planes: expected H or V, found S"), "{wrong}");
    let wrong = said(&json.replace(", [-2, 0.25]", ""));
    assert!(wrong.ends_with("1 lines of numbers, 2 observable_names"), "{wrong}");
}

/// A response as elegant writes it: names of two correctors of one name with their number, the plane in the description.
fn sdds(mode: &str, data: &[u8]) -> Vec<u8> {
    let header = format!(
        "SDDS2\n!# little-endian\n&description text=\"ring\", contents=\"horizontal-plane \\\"response\\\" matrix\", &end\n\
         &parameter name=NMonitors, type=long, fixed_value=2, &end\n&parameter name=Stage, type=string, &end\n\
         &column name=BPMName, type=string, description=\"a, b=c\", &end\n&column name=s, units=m, type=double, &end\n\
         &column name=COR#1, units=m/rad,\n type=double, &end\n\n&column name=COR#2.HKICK, units=m/rad, type=float, &end\n\
         &column name=Flag, type=character, &end\n\
         &data mode={mode}, &end\n"
    );
    [header.as_bytes(), data].concat()
}

#[test]
fn a_response_in_sdds_is_read_in_ascii_and_binary() {
    let ascii = sdds("ascii", b"! page number 1\ntune corrected\n2\nBPM#1 0.5 1.5 -2 k\n\"BPM#2\" 1.25 0.25 4e0 k\n");
    let text = |text: &str| [&(text.len() as i32).to_le_bytes()[..], text.as_bytes()].concat();
    let row = |name: &str, numbers: [f64; 2], last: f32| {
        [text(name), numbers.map(f64::to_le_bytes).concat(), last.to_le_bytes().to_vec(), b"k".to_vec()].concat()
    };
    let page = [
        2i32.to_le_bytes().to_vec(),
        text("tune corrected"),
        row("BPM#1", [0.5, 1.5], -2.0),
        row("BPM#2", [1.25, 0.25], 4.0),
    ];
    let binary = sdds("binary", &page.concat());
    let (lattice, instruments) = imported(&recorded("imports").join(FILES[0])).unwrap();
    let conventions = Conventions { unit: OrbitUnit::Metres, kick: PerInstrument::All(1e3), ..conventions() };
    for bytes in [&ascii, &binary] {
        let folder = TempDir::new().unwrap();
        let path = folder.path().join("response.sdds");
        fs::write(&path, bytes).unwrap();
        let matrix = Table::read(&path).unwrap();
        assert_eq!((matrix.stated.unit, matrix.stated.kick), (Some(OrbitUnit::Metres), Some(1e3)));
        let measured = Measurement { matrix: &matrix, dispersion: None, order: None, conventions: &conventions };
        let folder = assemble(&lattice, &instruments, None, &measured).unwrap();
        assert_eq!(folder.matrix, DMatrix::from_row_slice(2, 2, &[1500.0, -2000.0, 250.0, 4000.0]));
        let column = Table::read(Path::new(&format!("{}:s", path.display()))).unwrap();
        assert_eq!(column.stated.unit, Some(OrbitUnit::Metres));
    }
    let said = |bytes: &[u8]| {
        let folder = TempDir::new().unwrap();
        let path = folder.path().join("response.sdds");
        fs::write(&path, bytes).unwrap();
        Table::read(&path).unwrap_err().to_string()
    };
    assert!(said(&[&ascii[..], b"again\n0\n"].concat()).ends_with("more than one page, expected one response"));
    assert!(said(&binary[..binary.len() - 2]).ends_with("cut off within its data"));
    assert!(said(&sdds("ascii", b"none\n1\nBPM#1 0.5 x 2 k\n")).ends_with("expected a number, found x"));
    let units = String::from_utf8(ascii.clone()).unwrap().replacen("m/rad", "m/A", 1);
    assert!(said(units.as_bytes()).ends_with("columns have the units m/a and m/rad, expected one"));
    for length in 4..binary.len() {
        assert!(!said(&binary[..length]).is_empty());
    }
}

/// By pyAML itself, and by Argonne's library in the columns of elegant (tests/peers/response_tables.py), rounded to six digits.
#[test]
fn matrices_of_pyaml_and_elegant_are_the_plain_one() {
    let (lattice, instruments) = imported(&recorded("imports").join(FILES[0])).unwrap();
    let read = |name: &str| Table::read(&recorded("imports").join(name)).unwrap();
    let plain = measurement(FILES[0], "response.csv", None, &conventions());
    let conventions = Conventions { unit: OrbitUnit::Metres, kick: PerInstrument::All(1e3), ..conventions() };
    let blocks = read("response-x.sdds").joined(read("response-y.sdds")).unwrap();
    for (matrix, has_coupling) in
        [(read("response.pyaml.json"), true), (read("response.pyaml.yaml"), true), (blocks, false)]
    {
        assert_eq!(
            (matrix.stated.unit, matrix.stated.kick, matrix.stated.kick_is),
            (Some(OrbitUnit::Metres), Some(1e3), Some(KickIs::Full))
        );
        let measured = Measurement { matrix: &matrix, dispersion: None, order: None, conventions: &conventions };
        let folder = assemble(&lattice, &instruments, None, &measured).unwrap();
        for (i, monitor) in plain.monitors.iter().enumerate() {
            for (j, corrector) in plain.correctors.iter().enumerate() {
                assert_eq!((folder.monitors[i].at, folder.correctors[j].at), (monitor.at, corrector.at));
                let (found, expected) = (folder.matrix[(i, j)] / 1e3, plain.matrix[(i, j)] / corrector.kick);
                if has_coupling || monitor.plane == corrector.plane {
                    assert!((found - expected).abs() < 1e-5 * expected.abs(), "{i} {j}: {found} {expected}");
                } else {
                    assert!(found.is_nan());
                }
            }
        }
    }
    let rf =
        Table::read(Path::new(&format!("{}:rf_response", recorded("imports/response.pyaml.json").display()))).unwrap();
    let matrix = read("response.pyaml.json");
    let measured =
        Measurement { matrix: &matrix, dispersion: Some((&rf, 1.0)), order: None, conventions: &conventions };
    let dispersion = assemble(&lattice, &instruments, None, &measured).unwrap().dispersion.unwrap();
    let off = (dispersion * 2000.0 - plain.dispersion.unwrap()).amax();
    assert!(off < 1e-6, "{off}");
}
