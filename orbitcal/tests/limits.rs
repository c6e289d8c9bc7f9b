//! Hostile input of every format ends with a line that says what was expected and found, with exit status 2 and little memory; docs/limits.md.

use std::fs;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Output};

use flate2::Compression;
use flate2::write::ZlibEncoder;
use hdf5_pure::FileBuilder;

/// Address space of the program: 300 MB and what is never touched, such as the stacks of its threads [kB].
const MEMORY: u32 = 700_000;

/// Ends what does not end, far beyond the second that it takes [s].
const PATIENCE: u32 = 120;

/// The program in a folder, within the memory and the time.
fn orbitcal(folder: &Path, arguments: &str) -> Output {
    let program = env!("CARGO_BIN_EXE_orbitcal");
    let script = format!("ulimit -v {MEMORY}; exec timeout {PATIENCE} '{program}' {arguments}");
    Command::new("sh").current_dir(folder).env("RUST_BACKTRACE", "0").args(["-c", &script]).output().unwrap()
}

/// A file, the command that reads it, and what is said.
type Case = (&'static str, Vec<u8>, &'static str, &'static str);

fn text(text: impl Into<String>) -> Vec<u8> {
    text.into().into_bytes()
}

fn expect(cases: &[Case]) {
    let recordings = concat!(env!("CARGO_MANIFEST_DIR"), "/../recordings");
    for (file, bytes, arguments, words) in cases {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join(file), bytes).unwrap();
        let output = orbitcal(folder.path(), &arguments.replace("recordings/", &format!("{recordings}/")));
        let said = String::from_utf8_lossy(&output.stderr);
        let shown: String = said.chars().take(600).collect();
        assert!(said.contains(words), "{file}: {arguments}: expected {words:?}, found {:?}: {shown}", output.status);
        assert_eq!(output.status.code(), Some(2), "{file}: {arguments}: {shown}");
    }
}

fn facility(lines: &str) -> Vec<u8> {
    text(format!("PALS:\n  facility:\n    - R: {{kind: Lattice, branches: [L0]}}\n{lines}    - use: R\n"))
}

/// Lines that hold so many of the next each, the last of them what `end` is.
fn repeated(levels: usize, times: &str, end: &str) -> Vec<u8> {
    let line = |i| format!("    - L{i}: {{kind: BeamLine, line: [{{L{}: {{repeat: {times}}}}}]}}\n", i + 1);
    facility(&((0..levels).map(line).collect::<String>() + &format!("    - L{levels}: {end}\n")))
}

fn elements(one: &str, count: usize) -> Vec<u8> {
    text(format!("{{\"atjson\": 1, \"elements\": [{}{one}]}}", format!("{one},").repeat(count - 1)))
}

#[test]
fn lattices_are_read_within_the_limits() {
    let replicas: Vec<String> = (0..100)
        .map(|i| format!("\"r{i}\": {{\"__class__\": \"Replica\", \"parent_name\": \"r{}\"}}", i + 1))
        .collect();
    let replicas = format!("{{\"element_names\": [\"r0\"], \"elements\": {{{}}}}}", replicas.join(", "));
    let periods = "{\"atjson\": 1, \"properties\": {\"periodicity\": 1000}, \"elements\": [";
    let laughs: String =
        (1..12).map(|i| format!("  a{i}: &a{i} [{}]\n", vec![format!("*a{}", i - 1); 9].join(", "))).collect();
    let table = "@ NAME %05s \"TWISS\"\n* NAME KEYWORD S L ANGLE K0L K1L K1SL K2L K3L E1 E2 FINT FINTX HGAP TILT KSI\n";
    let import = "import lattice";
    expect(&[
        (
            "lattice",
            text("{\"a\": ".to_owned() + &"[".repeat(100_000)),
            import,
            "expected at most 64 levels within each other, found 65",
        ),
        ("lattice", elements("{\"a\": 0}", 500_000), import, "expected at most 201326592 bytes in memory"),
        (
            "lattice",
            elements(&format!("\"{}\"", "n".repeat(2_000_000)), 1),
            import,
            "expected at most 1048576 bytes in a name or a line, found 2000000",
        ),
        (
            "lattice",
            text(periods.to_owned() + &"{},".repeat(200) + "{}]}"),
            import,
            "201 elements x periodicity 1000: expected at most 100000 elements and lines",
        ),
        (
            "lattice",
            elements("{\"Class\": \"Drift\", \"Length\": 1e300}", 1),
            import,
            "Length: expected a number from -1e15 to 1e15, found 1e300",
        ),
        (
            "lattice",
            text(replicas),
            import,
            "element r0, a replica: expected at most 64 levels within each other, found 65",
        ),
        (
            "lattice",
            repeated(8, "10000", "{kind: Drift, length: 1}"),
            import,
            "expected at most 100000 elements and lines in a ring",
        ),
        (
            "lattice",
            repeated(8, "10000", "{kind: BeamLine, line: []}"),
            import,
            "expected at most 100000 elements and lines in a ring",
        ),
        ("lattice", repeated(1, "1.0e+30", "{kind: Drift}"), import, "expected to repeat a whole number of times"),
        ("lattice", repeated(100, "1", "{kind: Drift}"), import, "expected at most 64 levels within each other"),
        ("lattice", text("PALS:\n  a0: &a0 [x]\n".to_owned() + &laughs), import, "budget breached"),
        ("lattice", text("PALS: ".to_owned() + &"[".repeat(10_000)), import, "lattice: "),
        (
            "lattice",
            text(table.to_owned() + &"0 ".repeat(1_000_000)),
            import,
            "line 3: expected at most 1048576 bytes in a name or a line",
        ),
        (
            "lattice",
            text(table.to_owned() + "D DRIFT inf 0 0 0 0 0 0 0 0 0 0 0 0 0 0\n"),
            import,
            "S: expected a number from -1e15 to 1e15, found inf",
        ),
        (
            "lattice",
            text(table.to_owned() + &"D DRIFT 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0\n".repeat(100_001)),
            import,
            "expected at most 100000 elements and lines in a ring, repeats counted, found 100001",
        ),
        ("none", Vec::new(), "import /dev/zero", "expected at most 67108864 bytes in a file, found 67108865"),
    ]);
}

/// A data element of a MAT-file of level 5.
fn element(kind: u32, bytes: &[u8]) -> Vec<u8> {
    let padding = vec![0; bytes.len().wrapping_neg() % 8];
    [&kind.to_le_bytes()[..], &(bytes.len() as u32).to_le_bytes(), bytes, &padding].concat()
}

/// A matrix with one element of its own.
fn matrix(class: u32, shape: [i32; 2], name: &str, contents: &[u8]) -> Vec<u8> {
    let flags = [class.to_le_bytes(), [0; 4]].concat();
    let parts = [element(6, &flags), element(5, &shape.map(i32::to_le_bytes).concat()), element(1, name.as_bytes())];
    element(14, &[&parts.concat(), contents].concat())
}

fn mat(variable: &[u8]) -> Vec<u8> {
    let mut bytes = format!("{:<124}", "MATLAB 5.0 MAT-file").into_bytes();
    bytes.extend(b"\x00\x01IM");
    bytes.extend(variable);
    bytes
}

fn compressed(variable: &[u8]) -> Vec<u8> {
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::best());
    encoder.write_all(variable).unwrap();
    let bytes = encoder.finish().unwrap();
    [&15_u32.to_le_bytes()[..], &(bytes.len() as u32).to_le_bytes(), &bytes].concat()
}

#[test]
fn mat_files_are_read_within_the_limits() {
    let nested = |levels: usize| {
        (0..levels).fold(matrix(6, [1, 1], "", &element(9, &[0; 8])), |inner, _| matrix(1, [1, 1], "R", &inner))
    };
    let bytes = 20_000_000;
    let numbers = matrix(9, [1, bytes], "R", &element(2, &vec![1; bytes as usize]));
    let cells = 1_000_000;
    let empty = [14_u32.to_le_bytes(), [0; 4]].concat().repeat(cells as usize);
    let names = [element(5, &1_i32.to_le_bytes()), element(1, &vec![b'a'; 10_000_000])].concat();
    let memory = "expected at most 201326592 bytes in memory";
    expect(&[
        ("a.mat", mat(&nested(100)), "import a.mat", "expected at most 64 levels within each other, found 65"),
        ("a.mat", mat(&compressed(&numbers)), "import a.mat", memory),
        ("a.mat", mat(&compressed(&matrix(1, [1, cells], "R", &empty))), "import a.mat", memory),
        ("a.mat", mat(&matrix(2, [1, 100_000], "R", &names)), "import a.mat", memory),
        ("a.mat", mat(&compressed(&vec![0; 300_000_000])), "import a.mat", memory),
    ]);
}

/// What a matrix needs besides.
macro_rules! matrix_of {
    ($file:literal) => {
        concat!(
            "import recordings/measured/imports/twelve-cells.at.json --orbit-unit mm --kick 0.2 --kick-is full --kick-sign x+y+ ",
            "--noise 0.002 --out o --order planes --matrix ",
            $file
        )
    };
}

#[test]
fn tables_are_read_within_the_limits() {
    let mut file = FileBuilder::new();
    file.create_dataset("zeros")
        .with_f64_data(&vec![0.0; 9_000_000])
        .with_shape(&[3_000, 3_000])
        .with_chunks(&[3_000, 3_000])
        .with_deflate(9);
    let zeros = file.finish().unwrap();
    let memory = "expected at most 201326592 bytes in memory";
    let long = "expected at most 1048576 bytes in a name or a line";
    expect(&[
        ("m.h5", zeros.clone(), matrix_of!("m.h5:/zeros"), memory),
        ("m.csv", text("0,".repeat(1_000_000)), matrix_of!("m.csv"), long),
        ("m.csv", text((",".repeat(1_000) + "\n").repeat(10_000)), matrix_of!("m.csv"), memory),
        ("m.txt", text("0 ".repeat(1_000_000)), matrix_of!("m.txt"), long),
        ("m.txt", text("0\n".repeat(2_000_000)), matrix_of!("m.txt"), memory),
        (
            "m.csv",
            text("1,2\n3,-inf\n"),
            matrix_of!("m.csv"),
            "line 2: expected a number from -1e15 to 1e15, found -inf",
        ),
    ]);
}

#[test]
fn numbers_of_options_plans_and_machines_are_in_their_ranges() {
    let plan = include_str!("../../config/measure-booster.toml");
    let changed = |from: &str, to: &str| {
        assert!(plan.contains(from), "{from}");
        let header = concat!("header = \"", env!("CARGO_MANIFEST_DIR"), "/../config/booster-header.toml\"");
        text(plan.replace("header = \"booster-header.toml\"", header).replace(from, to))
    };
    let measure = "measure p.toml --dry-run --epics /bin/false";
    let fit = "fit recordings/ten-cells/plain --machine recordings/ten-cells/ring.json";
    let of_fit = |option: &str| -> &'static str { format!("{fit} {option}").leak() };
    let whole_day = "expected a number from 0.001 to 86400 s, found";
    expect(&[
        (
            "p.toml",
            changed("timeout_s = 60.0", "timeout_s = 1e300"),
            measure,
            "timing.timeout_s: expected a number from 0.001 to 86400 s, found 1e300",
        ),
        (
            "p.toml",
            changed("settle_s = 4.0", "settle_s = nan"),
            measure,
            "timing.settle_s: expected a number from 0.001 to 86400 s, found NaN",
        ),
        (
            "p.toml",
            changed("repeats = 3", "repeats = 9223372036854775807"),
            measure,
            "frames.repeats: expected at most 1000000 frames of a measurement",
        ),
        (
            "p.toml",
            changed("amplitude_A = 22.0", "amplitude_A = 5e-324"),
            measure,
            "correctors.amplitude_A: expected a number from 1e-6 to 1000000 A, found 5e-324",
        ),
        (
            "p.toml",
            text("# ".to_owned() + &"x".repeat(1 << 20)),
            measure,
            "expected at most 1048576 bytes in a TOML file",
        ),
        ("p.toml", text("a = ".to_owned() + &"[".repeat(100_000)), measure, "p.toml, line 1: "),
        (
            "v.json",
            text("{\"D8\": 1e300}"),
            "response --vars v.json",
            "D8: expected a number from -1e15 to 1e15, found 1e300",
        ),
        (
            "v.json",
            text("{\"D8\": ".to_owned() + &"[".repeat(100_000)),
            "response --vars v.json",
            "expected at most 64 levels",
        ),
        ("none", Vec::new(), "response --machine /dev/zero", "expected at most 67108864 bytes in a file"),
        ("none", Vec::new(), "serve /dev/zero --check", "expected at most 1048576 bytes in a TOML file"),
        (
            "none",
            Vec::new(),
            "response --effect quad_roll@D8=1e300",
            "quad_roll: amplitude: expected a number from -1e15 to 1e15, found 1e300",
        ),
        ("none", Vec::new(), "watch --idle 1e300", whole_day),
        (
            "none",
            Vec::new(),
            "replay recordings/paper-vars --rate 1e-300",
            "expected a number from 1e-5 to 1000000 Hz or max, found 1e-300",
        ),
        ("none", Vec::new(), of_fit("--prior-width 5e-324"), "expected a number from 1e-6 to 1, found 5e-324"),
        ("none", Vec::new(), of_fit("--method nuts --draws 4294967295"), "4294967295 is not in 4..=1000000"),
        ("none", Vec::new(), of_fit("--method nuts --draws 1000000"), "expected at most 16777216 numbers in all draws"),
        (
            "none",
            Vec::new(),
            "surrogate check --samples 18446744073709551615",
            "18446744073709551615 is not in 1..=1000000",
        ),
        (
            "none",
            Vec::new(),
            "frames a --lattice b --monitors 18446744073709551615,1 --correctors 1,1 --out o",
            "expected two whole numbers up to 100000 such as 122,122, found",
        ),
    ]);
}

/// A process that speaks EPICS without end, or of nothing.
#[test]
fn replies_of_a_control_system_are_read_within_the_limits() {
    use std::os::unix::fs::PermissionsExt;
    let plan = concat!(env!("CARGO_MANIFEST_DIR"), "/../config/measure-booster.toml");
    let cases = [
        ("cat /dev/zero | tr '\\0' x", "expected at most 1048576 bytes in a name or a line, found 1048577"),
        ("yes '{\"id\": 0}'", "expected a reply to request 1, found one to 0"),
        ("echo '{\"id\": 2}'; cat", "expected a reply to request 1, found one to 2"),
        ("yes [[[[[[ | tr -d '\\n' | head -c 1000000; echo; cat", "expected u64 at line 1 column 1"),
    ];
    for (script, words) in cases {
        let folder = tempfile::tempdir().unwrap();
        let program = folder.path().join("epics");
        fs::write(&program, format!("#!/bin/sh\n{script}\n")).unwrap();
        fs::set_permissions(&program, fs::Permissions::from_mode(0o755)).unwrap();
        let output = orbitcal(folder.path(), &format!("measure {plan} --dry-run --epics ./epics"));
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(said.contains(words) && said.len() < 2_000, "{script}: expected {words:?}, found {said}");
        assert_eq!(output.status.code(), Some(1), "{script}");
    }
}
