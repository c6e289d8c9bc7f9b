//! The document's examples, and one fault at a time.

use std::fs;

use super::*;

/// The documents' examples are what these tests read, so that neither can drift from the other.
const DOCUMENT: &str = include_str!("../../../docs/recording.md");
const MACHINES: &str = include_str!("../../../docs/machine.md");

/// A block of a document in some language, counted from 0.
fn block_of(document: &'static str, language: &str, number: usize) -> &'static str {
    let fence = format!("```{language}\n");
    let rest = document.split(&fence).nth(1 + number).expect("the document has this block");
    rest.split_once("```").expect("the block ends").0
}

fn block(language: &str) -> &'static str {
    block_of(DOCUMENT, language, 0)
}

/// The example in format 2.
fn second(language: &str) -> &'static str {
    block_of(DOCUMENT, language, 1)
}

fn toy() -> Ring {
    Ring::parse(block_of(MACHINES, "json", 0), "machines/toy.json").expect("the example is right")
}

/// The columns of the example.
fn columns() -> Vec<String> {
    block("csv").lines().next().expect("it has columns").split(',').map(String::from).collect()
}

/// Reads a campaign `toy`; a file without content is left out. The error's path starts at the campaign's folder.
fn read(header: &[u8], frames: &[u8]) -> Result<Recording, String> {
    let home = tempfile::tempdir().expect("a temporary folder can be made");
    let folder = home.path().join("toy");
    fs::create_dir(&folder).expect("it is writable");
    for (file, content) in [("header.toml", header), ("frames.csv", frames)] {
        if !content.is_empty() {
            fs::write(folder.join(file), content).expect("it is writable");
        }
    }
    let strip = |error: RecordingError| error.to_string().replace(&format!("{}/", home.path().display()), "");
    Recording::read(&folder, &toy()).map_err(strip)
}

/// The document's text with its one `old` changed to `new`.
fn edited(language: &str, old: &str, new: &str) -> String {
    assert_eq!(block(language).matches(old).count(), 1, "{old} stands once in the example");
    block(language).replace(old, new)
}

fn with_frames(old: &str, new: &str) -> Result<Recording, String> {
    read(block("toml").as_bytes(), edited("csv", old, new).as_bytes())
}

fn frames_error(old: &str, new: &str) -> String {
    with_frames(old, new).expect_err(new)
}

fn header_error(old: &str, new: &str) -> String {
    read(edited("toml", old, new).as_bytes(), block("csv").as_bytes()).expect_err(new)
}

/// What stands in the example, what stands there instead, and where and how that is refused.
type Fault = (&'static str, &'static str, &'static str);

fn assert_header_errors(faults: &[Fault]) {
    for (old, new, expected) in faults {
        assert_eq!(header_error(old, new), format!("toy/header.toml, line {expected}"));
    }
}

fn assert_frames_errors(faults: &[Fault]) {
    for (old, new, expected) in faults {
        assert_eq!(frames_error(old, new), format!("toy/frames.csv, line {expected}"));
    }
}

#[test]
fn example_of_the_document_reads_in_si_units() {
    let toy = read(block("toml").as_bytes(), block("csv").as_bytes()).expect("the example is right");
    assert_eq!((toy.name.as_str(), toy.rows.len()), ("toy", 2));
    assert_eq!((toy.header.noise, toy.header.kick_per_ampere), (vec![0.15e-3; 2], vec![0.00909091e-3; 2]));
    assert_eq!((toy.header.believed_rf, toy.header.nominal), (BelievedRf::FixedMomentum, vec![1800.0, 1790.0]));
    assert_eq!(toy.header.radial_loop_monitors, None);
    let row = &toy.rows[1];
    assert_eq!((row.sequence, row.time, row.cycle_time, row.rf_offset), (2, 8.0, 0.092, -0.0002));
    assert_eq!(row.correctors, [(0, 22.0)]);
    assert_eq!((row.dipole, row.supply.as_slice()), (Some(2400.314), [1799.611, 1789.777].as_slice()));
    assert_eq!((toy.other.as_slice(), row.other[1]), (["i_sh_A", "i_sv_A"].map(String::from).as_slice(), 0.045576));
    assert_eq!(row.corrector_current, [21.9987, -0.0121]);
    assert_eq!(row.reading, [Some(1.9287e-3), None]);
    assert_eq!(row.tune, [Some(0.80674), None]);
}

/// Kiloamperes, or a nominal current of another machine: the ring of the design would keep no beam.
#[test]
fn currents_in_another_unit_are_refused() {
    let nominal = "nominal_A = { dipole = 2400.0, qh = 1800.0, qv = 1790.0 }";
    let error = header_error(nominal, "nominal_A = { dipole = 2400.0, qh = 1.8, qv = 1790.0 }");
    println!("{error}");
    assert!(error.starts_with("toy/header.toml, line ") && error.contains("key nominal_A: the currents make "));
    assert!(
        error.contains("times the design's gradient of supply ") && error.contains(": expected about 1.8 A, found ")
    );
}

/// Zeros and other numbers that mean nothing, one monitor stuck elsewhere; not so few monitors that may agree by chance.
#[test]
fn a_frame_whose_monitors_read_one_number_has_no_beam() {
    let toy = read(block("toml").as_bytes(), block("csv").as_bytes()).expect("the example is right");
    let with = |reading: &[f64]| Row { reading: reading.iter().map(|x| Some(*x)).collect(), ..toy.rows[0].clone() };
    assert!(with(&[0.0; 15]).is_without_beam() && with(&[-99.9e-3; 4]).is_without_beam());
    let mut stuck = [0.0; 15];
    stuck[3] = 1.2e-3;
    assert!(with(&stuck).is_without_beam());
    assert!(!with(&[0.0; 3]).is_without_beam() && !with(&[]).is_without_beam());
    assert!(!with(&[1e-3, 1e-3, 2e-3, -1e-3, 1e-3]).is_without_beam());
    assert!(toy.rows.iter().all(|row| !row.is_without_beam()));
}

#[test]
fn example_errors_of_the_document_are_verbatim() {
    let errors = [
        header_error("bpm_sigma_mm = 0.15", "bpm_sigma_mm = -0.15"),
        header_error("lattice = \"toy.json\"\n", ""),
        frames_error("x_A2_mm", "x_A2_um"),
        frames_error("1.9287", "NaN"),
        frames_error("\n2,", "\n0,"),
    ];
    assert_eq!(block("text").lines().collect::<Vec<_>>(), errors);
}

#[test]
fn missing_files_are_named() {
    let (header, frames) = (block("toml").as_bytes(), block("csv").as_bytes());
    assert_eq!(read(b"", frames), Err("toy/header.toml: file not found".into()));
    assert_eq!(read(header, b""), Err("toy/frames.csv: file not found".into()));
}

#[test]
fn bytes_that_are_no_text_are_refused() {
    let error = read(block("toml").as_bytes(), b"seq,\xff").expect_err("0xff is not UTF-8");
    assert_eq!(error, "toy/frames.csv: expected UTF-8 text");
}

#[test]
fn byte_order_mark_and_crlf_are_accepted() {
    let [header, frames] = ["toml", "csv"].map(|language| format!("\u{feff}{}", block(language).replace('\n', "\r\n")));
    assert_eq!(read(header.as_bytes(), frames.as_bytes()), read(block("toml").as_bytes(), block("csv").as_bytes()));
    let error = read(header.as_bytes(), frames.replace("1.9287", "x").as_bytes()).expect_err("x is no number");
    assert!(error.contains(", line 3, "), "{error}");
}

#[test]
fn what_is_wrong_in_a_header_is_said() {
    assert_header_errors(&[
        (
            "kinetic_energy_GeV = 0.05",
            "kinetic_energy_GeV =",
            "5, key kinetic_energy_GeV: string values must be quoted, expected literal string",
        ),
        ("recorded_with", "lattice", "3, key lattice: duplicate key"),
        (", qv = 1790.0", "", "10, key nominal_A: missing field `qv`"),
        (
            "qv = 1790.0",
            "qv = 1790.0, qd = 1.0",
            "10, key qd: unknown field `qd`, expected one of `dipole`, `qh`, `qv`",
        ),
        (
            "bpm_sigma_mm = 0.15",
            "bpm_sigma_mm = \"x\"",
            "6, key bpm_sigma_mm: invalid type: string \"x\", expected f64",
        ),
        (
            "\"fixed_momentum\"",
            "\"none\"",
            "9, key believed_rf: unknown variant `none`, expected one of `fixed_momentum`, `fixed_frequency`, `radial_loop`",
        ),
        (
            "\"fixed_momentum\"",
            "\"radial_loop\"",
            "1: missing field `radial_loop_monitors`, needed as believed_rf is radial_loop",
        ),
        (
            "note = ",
            "radial_loop_monitors = [\"a\", \"b\", \"c\"]\nnote = ",
            "12, key radial_loop_monitors: invalid length 3, expected two monitors",
        ),
        ("machine = \"toy\"", "format = 3\nmachine = \"toy\"", "1, key format: expected 1 or 2, found 3"),
    ]);
}

#[test]
fn header_values_must_be_positive_and_finite() {
    let keys = ["kinetic_energy_GeV = 0.05", "bpm_sigma_mm = 0.15", "kick_mrad_per_A = 0.00909091"];
    for assignment in keys.into_iter().chain(["dipole = 2400.0", "qh = 1800.0", "qv = 1790.0"]) {
        let (key, _) = assignment.split_once(" = ").expect("key = value");
        for bad in ["0.0", "-1.0", "nan", "inf"] {
            let error = header_error(assignment, &format!("{key} = {bad}"));
            assert!(error.contains(&format!(", key {key}: invalid value: ")), "{error}");
            assert!(error.ends_with(", expected a number from 1e-15 to 1e15"), "{error}");
        }
    }
}

#[test]
fn quad_transfer_must_have_a_value_at_nominal_current() {
    for (bad, sum) in [("[]", "0"), ("[1.0, -1.0]", "0"), ("[1.0, nan]", "NaN"), ("[inf]", "inf")] {
        let expected = "expected finite coefficients with a sum p(1) that is not 0";
        let expected = format!("line 11, key quad_transfer: invalid value: p(1) = {sum}, {expected}");
        assert_eq!(header_error("[0.0, 1.0]", bad), format!("toy/header.toml, {expected}"));
    }
}

#[test]
fn what_is_wrong_in_frames_is_said() {
    assert_frames_errors(&[
        ("x_A2_mm,", "", "1, column 14: expected x_A2_mm, found \"y_A1_mm\", so a column is missing"),
        (",qy_frac", "", "1, column 17: expected qy_frac, found the end of the line, so a column is missing"),
        ("x_A2_mm", "x_A4_mm", "1, column 14: expected x_A2_mm, found \"x_A4_mm\", which the machine does not have"),
        (
            "qy_frac",
            "qy_frac,i",
            "1, column 18: expected the end of the line, found \"i\", which the machine does not have",
        ),
        (
            "x_A2_mm,y_A1_mm",
            "y_A1_mm,x_A2_mm",
            "1, column 14: expected x_A2_mm, found \"y_A1_mm\", which is in the wrong place",
        ),
        ("y_A1_mm", "x_A2_mm", "1, column 15: expected y_A1_mm, found \"x_A2_mm\", which is there already"),
        ("x_A2_mm", "x_A2_m", "1, column 14: expected x_A2_mm, found \"x_A2_m\", which has the wrong unit"),
        ("time_s", "time_ms", "1, column 2: expected time_s, found \"time_ms\", which has the wrong unit"),
        ("1.9287,", "", "3: expected 17 cells, found 16"),
        ("0.80674,", "0.80674,,", "3: expected 17 cells, found 18"),
        ("\n2,", "\n\n2,", "3: expected 17 cells, found 1"),
        ("2400.314", "", "3, column i_dipole_A: expected a number from 1e-15 to 1e15, found an empty cell"),
        (",A2,22,", ",A3,22,", "3, column corrector: expected a corrector of the machine or nothing, found \"A3\""),
        (",A2,22,", ",,22,", "3, column setting_A: expected 0, as no corrector is named, found \"22\""),
        ("\n2,", "\n1,", "3, column seq: expected more than the 1 of the line before, found 1"),
        ("8.000", "4.000", "3, column time_s: expected more than the 4 of the line before, found 4"),
    ]);
}

/// The example's second row with one cell replaced.
fn cell(index: usize, content: &str) -> Result<Recording, String> {
    let (above, row) = block("csv").trim_end().rsplit_once('\n').expect("it has rows");
    let mut cells: Vec<&str> = row.split(',').collect();
    cells[index] = content;
    read(block("toml").as_bytes(), format!("{above}\n{}\n", cells.join(",")).as_bytes())
}

#[test]
fn every_cell_refuses_what_is_no_finite_number() {
    for (index, column) in columns().into_iter().enumerate() {
        for bad in ["NaN", "nan", "inf", "-inf", "1e999", "Z9", "1;5", " 1", "\"1\""] {
            let error = cell(index, bad).expect_err(bad);
            assert!(error.starts_with(&format!("toy/frames.csv, line 3, column {column}: expected ")), "{error}");
            assert!(error.ends_with(&format!(", found {bad:?}")), "{error}");
        }
    }
}

#[test]
fn only_monitors_and_tunes_may_be_empty() {
    for (index, column) in columns().into_iter().enumerate() {
        let result = cell(index, "").map(|_| ());
        let optional = column.ends_with("_mm") || column.ends_with("_frac");
        assert_eq!(result.is_ok(), optional, "{column}: {result:?}");
    }
}

#[test]
fn sequence_may_leave_gaps() {
    assert_eq!(with_frames("\n2,", "\n900,").map(|toy| toy.rows[1].sequence), Ok(900));
}

#[test]
fn recording_without_frames_is_refused() {
    let (columns, _) = block("csv").split_once('\n').expect("it has columns");
    let error = read(block("toml").as_bytes(), columns.as_bytes()).expect_err("it has no frames");
    assert_eq!(error, "toy/frames.csv, line 1: expected frames below the columns, found none");
}

#[test]
fn numbers_stay_within_their_ranges() {
    let current = (["0.001", "1e4"], ["0", "-2400"], "a number from 1e-15 to 1e15"); // one that divides a gradient
    for (index, (inside, outside, expected)) in [
        (5, (["-0.01", "1e-2"], ["-0.0101", "0.02"], "a relative offset from -0.01 to 0.01")),
        (6, current),
        (7, current),
        (8, current),
        (13, (["-100", "100"], ["-100.001", "250"], "a position from -100 to 100 mm")),
        (15, (["0", "0.99999"], ["-0.1", "1"], "a fractional tune from 0 to below 1")),
    ] {
        for content in inside {
            assert_eq!(cell(index, content).map(|_| ()), Ok(()));
        }
        for content in outside {
            let error = cell(index, content).expect_err(content);
            assert!(error.ends_with(&format!(": expected {expected}, found {content:?}")), "{error}");
        }
    }
}

#[test]
fn error_stays_on_one_line_whatever_the_files_hold() {
    let errors =
        [header_error("particle", "\"a\\nb\""), frames_error("seq", "s\"\re\tq"), frames_error("1.9287", "1\r2")];
    for error in errors {
        assert!(!error.contains(char::is_control), "{error}");
    }
}

#[test]
fn a_recording_of_another_machine_is_refused() {
    for (old, new, expected) in [
        ("machine = \"toy\"", "machine = \"ring\"", "1, key machine: expected \"toy\", found \"ring\""),
        ("\"toy.json\"", "\"ring.json\"", "2, key lattice: expected \"toy.json\", found \"ring.json\""),
        ("\"proton\"", "\"electron\"", "4, key particle: expected \"proton\", found \"electron\""),
        ("= 0.05", "= 0.06", "5, key kinetic_energy_GeV: expected 0.05, found 0.06"),
    ] {
        let expected = format!("toy/header.toml, line {expected}: the recording is of another machine");
        assert_eq!(header_error(old, new), expected);
    }
}

#[test]
fn format_1_may_be_stated() {
    let read = read(edited("toml", "machine =", "format = 1\nmachine =").as_bytes(), block("csv").as_bytes());
    assert_eq!(read, self::read(block("toml").as_bytes(), block("csv").as_bytes()));
}

#[test]
fn names_of_elements_are_columns_too() {
    let frames = block("csv").replace("ic_A2_A", "ic_DCH_A2_A").replace("x_A2_mm", "x_PUH_A2_mm");
    let frames = frames.replace("ic_A1_A", "ic_V_A1_A").replace(",A2,22", ",DCH_A2,22");
    assert_eq!(
        read(block("toml").as_bytes(), frames.as_bytes()),
        read(block("toml").as_bytes(), block("csv").as_bytes())
    );
}

fn read_second(header: &str, frames: &str) -> Result<Recording, String> {
    read(header.as_bytes(), frames.as_bytes())
}

#[test]
fn example_in_format_2_reads_in_si_units() {
    let toy = read_second(second("toml"), second("csv")).expect("the example is right");
    let header = &toy.header;
    assert_eq!((header.noise.as_slice(), header.nominal_dipole), ([0.15e-3, 0.3e-3].as_slice(), None));
    assert_eq!(header.kick_per_ampere, [0.00909091e-3, 0.01e-3]);
    assert_eq!((&header.nominal, &header.transfer[1]), (&vec![1800.0, 1790.0], &vec![0.0, 1.1, -0.1]));
    let [baseline, bump] = &toy.rows[..] else { panic!("two rows") };
    assert_eq!((bump.correctors.as_slice(), &baseline.correctors), ([(0, 22.0), (1, -11.0)].as_slice(), &vec![]));
    assert_eq!((bump.supply.as_slice(), bump.dipole, bump.rf_offset), ([1799.611, 1789.777].as_slice(), None, 0.0));
    assert_eq!((baseline.intensity, bump.intensity, bump.tune), (Some(2.1e11), None, [None; 2]));
    assert_eq!(
        (baseline.tune, toy.other.as_slice(), &bump.other),
        ([Some(0.10530), None], ["i_sextupole_A".to_owned()].as_slice(), &vec![0.1])
    );

    assert!((toy.nominal_kick() - 22.0 * 0.00909091e-3).abs() < 1e-12);
}

#[test]
fn what_is_wrong_in_format_2_is_said() {
    let header = |old: &str, new: &str| read_second(&second("toml").replace(old, new), second("csv")).unwrap_err();
    let frames = |old: &str, new: &str| read_second(second("toml"), &second("csv").replace(old, new)).unwrap_err();
    let cases = [
        (
            header("y_A1 = 0.3", "y_B1 = 0.3"),
            "header.toml, line 7, key bpm_sigma_mm: unknown field `y_B1`, the machine has no such instrument",
        ),
        (
            header("default = 0.00909091, ", ""),
            "header.toml, line 8, key kick_mrad_per_A: missing field `default`, as not every instrument is named",
        ),
        (
            header(", QD = 1790.0", ""),
            "header.toml, line 11, key nominal_A: missing field `QD`, a supply of the machine",
        ),
        (
            header("QD = 1790.0", "QD = 1790.0, QT = 1.0"),
            "header.toml, line 11, key nominal_A: unknown field `QT`, the machine has no such supply",
        ),
        (
            header("QF = [0.0, 1.0], ", ""),
            "header.toml, line 12, key quad_transfer: missing field `QF`, a supply of the machine",
        ),
        (
            header("{ default = 0.15, y_A1 = 0.3 }", "\"x\""),
            "header.toml, line 7, key bpm_sigma_mm: invalid type: string \"x\", expected a number, or a table of numbers by name",
        ),
        (
            frames("x_A2_mm,", "x_A3_mm,"),
            "frames.csv, line 1, column 3: expected a column of this format, found \"x_A3_mm\", which the machine does not have",
        ),
        (
            frames("x_A2_mm,", "x_A2_um,"),
            "frames.csv, line 1, column 3: expected x_A2_mm, found \"x_A2_um\", which has the wrong unit",
        ),
        (
            frames("i_QF_A", "i_QD_A"),
            "frames.csv, line 1, column 10: expected every column once, found \"i_QD_A\", which is there already",
        ),
        (
            frames("i_QF_A", "i_Q_A"),
            "frames.csv, line 1: expected i_QF_A, found no column of this name, so a column is missing",
        ),
        (
            frames("setting_A", "i_s_A"),
            "frames.csv, line 1: expected setting_A, found no column of this name, so a column is missing",
        ),
        (
            frames("A2;A1", "A2;A2"),
            "frames.csv, line 3, column corrector: expected correctors of the machine, each once and joined by `;`, or nothing, found \"A2;A2\"",
        ),
        (
            frames("22;-11", "22"),
            "frames.csv, line 3, column setting_A: expected 2 finite numbers joined by `;`, found \"22\"",
        ),
        (
            frames("2.1e11", "-1"),
            "frames.csv, line 2, column intensity: expected a number from 0 to 1e15, found \"-1\"",
        ),
    ];
    for (found, expected) in cases {
        assert_eq!(found, format!("toy/{expected}"));
    }
}

/// A ring whose quadrupoles are in series with the dipoles, or of a family of both signs, in format 1.
#[test]
fn format_1_powers_every_quadrupole_by_its_sign() {
    let one = |text: &str| {
        let ring = Ring::parse(text, "toy.json").expect("a ring");
        powered(&ring, Format::One).quadrupoles.iter().map(|q| q.supply).collect::<Vec<_>>()
    };
    let text = block_of(MACHINES, "json", 0);
    assert_eq!(one(text), [Some(0), Some(1)]);
    let without = text.replace("\"family\": \"QF\"", "\"k1\": 0.6");
    assert_eq!(one(&without), [Some(0), Some(1)]);
    assert_eq!(Ring::parse(&without, "toy.json").unwrap().quadrupoles[0].supply, None);
}

#[test]
fn what_is_written_reads_the_same() {
    let ring = Ring::booster();
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/paper-vars");
    let booster = Recording::read(&folder, &ring).expect("it is committed");
    let toy_two = read_second(second("toml"), second("csv")).expect("the example is right");
    for (recording, ring) in [(booster, ring), (toy_two, toy())] {
        let home = tempfile::tempdir().expect("a temporary folder can be made");
        let folder = home.path().join(&recording.name);
        recording.write(&folder, &ring).expect("it is writable");
        let again = Recording::read(&folder, &ring).unwrap_or_else(|error| panic!("{error}"));
        let header = Header { format: Format::Two, ..recording.header.clone() };
        assert_eq!((again.header, again.other), (header, recording.other));
        assert_eq!(again.rows, recording.rows);
    }
}

#[test]
fn an_empty_file_is_said_to_be_empty() {
    let error = read(block("toml").as_bytes(), b"\n").expect_err("there is nothing in it");
    assert_eq!(error, "toy/frames.csv, line 1: expected columns and frames, found an empty file");
}

#[test]
fn a_column_that_stands_twice_is_not_called_missing() {
    let named = columns().join(",").replacen("x_A2_mm", "y_A1_mm", 1);
    let twice = block("csv").replacen(&columns().join(","), &named, 1);
    let error = read(block("toml").as_bytes(), twice.as_bytes()).expect_err("y_A1_mm stands twice");
    assert!(error.ends_with(", found \"y_A1_mm\", which is there already"), "{error}");
}

#[test]
fn another_machine_is_named_before_what_it_lacks() {
    let other = block("toml").replace("machine = \"toy\"", "machine = \"other\"").replace("qh = ", "QH = ");
    let error = read(other.as_bytes(), block("csv").as_bytes()).expect_err("it is of another machine");
    assert!(
        error.contains("key machine: expected ") && error.ends_with("the recording is of another machine"),
        "{error}"
    );
}

/// The toy machine with a ramp from 50 to 100 ms, something of it changed; what a recording of it is refused with, or nothing.
fn ramped(change: impl Fn(&mut serde_json::Value), header: &str, frames: &str) -> Result<Recording, String> {
    let point = |time: f64, energy: f64, p: f64| {
        let supplies = serde_json::json!({"QF": p * 1800.0, "QD": p * 1790.0});
        serde_json::json!({"t_cycle_ms": time, "kinetic_energy_GeV": energy, "dipole_A": p * 2400.0, "supply_A": supplies})
    };
    let mut file: serde_json::Value = serde_json::from_str(block_of(MACHINES, "json", 0)).expect("it is JSON");
    // momentum of protons of 30 MeV over that at 50 MeV
    file["ramp"] = vec![point(50.0, 0.03, 0.7706), point(100.0, 0.05, 1.0)].into();
    change(&mut file);
    let ring = Ring::parse(&file.to_string(), "machines/toy.json").expect("the ramp is right");
    let home = tempfile::tempdir().expect("a temporary folder can be made");
    fs::write(home.path().join("header.toml"), header).expect("it is writable");
    fs::write(home.path().join("frames.csv"), frames).expect("it is writable");
    let strip = |error: RecordingError| error.to_string().replace(&format!("{}/", home.path().display()), "");
    Recording::read(home.path(), &ring).map_err(strip)
}

#[test]
fn a_ramp_is_resolved_by_the_header() {
    let read = ramped(|_| (), block("toml"), block("csv")).expect("the example is within the ramp");
    let at = read.header.ramp.at(0.092, 2).expect("it is within");
    let expected = 0.7706 + 0.84 * (1.0 - 0.7706);
    // the momentum is that of the energy, to four digits the one stated above
    assert!((at.momentum - expected).abs() < 1e-4 && (at.dipole - expected).abs() < 1e-12, "{at:?}");
    // p(r) = r
    assert!(at.gradient.iter().all(|gradient| (gradient - expected).abs() < 1e-12));
    // eta = alpha - 1/gamma^2, gamma = 1 + T/m
    let ring = toy();
    let optics = twin::Optics::of(&ring, twin::Hold::Momentum { delta: 0.0 }).expect("the toy is stable");
    let slip = |energy: f64| optics.momentum_compaction() - (1.0 + energy / 0.938_272_088_16).powi(-2);
    assert!((at.slip - (slip(0.03) / slip(0.05) * 0.16 + 0.84)).abs() < 1e-9, "{at:?}");
    assert_eq!(read.header.ramp.span(), Some([0.05, 0.1]));
    assert!((read.header.ramp.at(0.049, 2), read.header.ramp.at(0.101, 2)) == (None, None));
}

#[test]
fn what_does_not_go_with_a_ramp_is_refused() {
    let (header, frames) = (block("toml"), block("csv"));
    let late = ramped(|_| (), header, &frames.replace("8.000,92.0", "8.000,100.5")).unwrap_err();
    let words = "expected a time of the ramp, from 50 to 100 ms, found \"100.5\"";
    assert_eq!(late, format!("frames.csv, line 3, column t_cycle_ms: {words}"));
    let held = header.replace("fixed_momentum", "fixed_frequency");
    let words = "fixed_frequency is not modelled along the machine file's ramp";
    assert_eq!(ramped(|_| (), &held, frames).unwrap_err(), format!("header.toml, line 9, key believed_rf: {words}"));
    let no_dipole = |file: &mut serde_json::Value| {
        for point in file["ramp"].as_array_mut().expect("it is a list") {
            point.as_object_mut().expect("it is an object").remove("dipole_A");
        }
    };
    let said = ramped(no_dipole, header, frames).unwrap_err();
    assert_eq!(said, "header.toml, line 10, key nominal_A: has a dipole, the ramp at 50 ms has none");
    // format 2 may leave the time out, unless it is needed
    let said = ramped(|_| (), second("toml"), second("csv")).unwrap_err();
    assert!(said.contains("expected t_cycle_ms, found no column of this name"), "{said}");
}
