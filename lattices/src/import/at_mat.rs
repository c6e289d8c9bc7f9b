//! A lattice of AT in a MAT-file: pyAT's `at.save_mat`, or the cell array `THERING` of Matlab.
//!
//! A cell is a struct with the fields of pyAT's JSON, and is read as that ([`super::at`]). An element without `Class` has that of its name, its pass
//! method or its fields, in this order. `RingParam` holds the properties of the ring; it stays as an element of no length, so that the numbers of the
//! elements are Matlab's.
//!
//! Source: pyAT 0.9, modules `at.load.matfile` and `at.load.utils`.

use serde_json::{Map, Value, json};

use super::at;
use super::element::{Format, Lattice};
use super::mat::{Mat, MatFile, Place};
use measured::MeasuredError;

/// Fields that are lists with one number too.
const LISTS: [&str; 3] = ["PolynomA", "PolynomB", "KickAngle"];
/// Classes by other words, in small letters.
const ALIASES: [(&str, &str); 7] = [
    ("bend", "Dipole"),
    ("rbend", "Dipole"),
    ("sbend", "Dipole"),
    ("quad", "Quadrupole"),
    ("sext", "Sextupole"),
    ("rf", "RFCavity"),
    ("bpm", "Monitor"),
];
/// Classes that are known by their own names.
const CLASSES: [&str; 16] = [
    "Drift",
    "Marker",
    "Monitor",
    "Aperture",
    "Corrector",
    "Dipole",
    "Quadrupole",
    "Sextupole",
    "Octupole",
    "Multipole",
    "ThinMultipole",
    "RFCavity",
    "RingParam",
    "M66",
    "Wiggler",
    "Solenoid",
];
/// Classes by pass methods.
const PASSES: [(&str, &str); 13] = [
    ("BendLinearPass", "Dipole"),
    ("BndMPoleSymplectic4RadPass", "Dipole"),
    ("BndMPoleSymplectic4Pass", "Dipole"),
    ("QuadLinearPass", "Quadrupole"),
    ("StrMPoleSymplectic4Pass", "Multipole"),
    ("StrMPoleSymplectic4RadPass", "Multipole"),
    ("CorrectorPass", "Corrector"),
    ("CavityPass", "RFCavity"),
    ("RFCavityPass", "RFCavity"),
    ("ThinMPolePass", "ThinMultipole"),
    ("AperturePass", "Aperture"),
    ("Matrix66Pass", "M66"),
    ("GWigSymplecticPass", "Wiggler"),
];

/// Read the variable of a name, or the one that is a lattice.
pub(super) fn read(file: &MatFile, name: Option<&str>) -> Result<Lattice, MeasuredError> {
    let refuse = |problem: String| Err(MeasuredError::Table { file: file.file.clone(), problem });
    let are: Vec<&str> =
        file.variables.iter().filter(|(_, value)| is_one(value)).map(|(name, _)| name.as_str()).collect();
    let name = match (name, are.as_slice()) {
        (Some(name), are) if are.contains(&name) => name,
        (Some(name), _) => return refuse(format!("{name} is no lattice of AT; found {}", file.words())),
        (None, [one]) => one,
        (None, []) => {
            return refuse(format!("expected a cell array of elements with FamName, found {}", file.words()));
        }
        (None, several) => {
            let problem = format!("several lattices: {}; name one, {}:{}", several.join(", "), file.file, several[0]);
            return refuse(problem);
        }
    };
    let variable = file.variable(name).expect("it was found there");
    lattice(&file.file, &document(&variable)?, Format::AtMat)
}

/// A cell array of structs with the name of a family, or a struct array of these.
fn is_one(value: &Mat) -> bool {
    let has_name = |one: &Mat| matches!(one, Mat::Structs(_, names, _) if names.iter().any(|name| name == "FamName"));
    match value {
        Mat::Cells(_, cells) => cells.first().is_some_and(has_name),
        Mat::Structs(_, _, values) => values.len() > 1 && has_name(value),
        _ => false,
    }
}

/// The lattice of a document.
pub(super) fn lattice(file: &str, document: &Value, format: Format) -> Result<Lattice, MeasuredError> {
    Ok(Lattice { format, ..at::read(file, document)? })
}

/// The cells as pyAT's JSON has them.
pub(super) fn document(cells: &Place) -> Result<Value, MeasuredError> {
    let mut properties = Map::new();
    let mut elements = Vec::new();
    for cell in cells.elements()? {
        let mut one = object(&cell)?;
        let class = class(&one);
        if class == "RingParam" {
            ring(&cell, &one, &mut properties)?;
        }
        one.insert("Class".into(), class.into());
        elements.push(Value::Object(one));
    }
    if !properties.contains_key("energy") {
        properties.extend(common_energy(&elements).map(|energy| ("energy".to_owned(), energy)));
    }
    Ok(json!({"atjson": 1, "properties": properties, "elements": elements}))
}

/// Fields of an element that are numbers or text.
fn object(cell: &Place) -> Result<Map<String, Value>, MeasuredError> {
    if !cell.is_struct() || cell.field("FamName").is_none() {
        return Err(cell.expected("an element, a struct with FamName"));
    }
    let fields = cell.names().iter().filter_map(|name| Some((name.clone(), json(name, cell.field(name)?.value)?)));
    Ok(fields.collect())
}

/// A number, a list, or a matrix by its lines.
fn json(name: &str, value: &Mat) -> Option<Value> {
    match value {
        Mat::Text(text) => Some(json!(text)),
        Mat::Numbers(_, values) if values.len() == 1 && !LISTS.contains(&name) => Some(json!(values[0])),
        Mat::Numbers(shape, values) => match shape.as_slice() {
            [1, _] | [_, 1] => Some(json!(values)),
            [lines, _] => {
                let line = |line: usize| values.iter().skip(line).step_by(*lines).collect::<Vec<_>>();
                Some(json!((0..*lines).map(line).collect::<Vec<_>>()))
            }
            _ => None,
        },
        _ => None,
    }
}

/// Class of an element, as pyAT finds it; that of its pass method's own name where nothing tells.
fn class(one: &Map<String, Value>) -> String {
    let word = |key: &str| one.get(key).and_then(Value::as_str).unwrap_or_default();
    let named = |word: &str| {
        let alias = ALIASES.iter().find(|(alias, _)| word.eq_ignore_ascii_case(alias)).map(|(_, class)| *class);
        alias.or_else(|| CLASSES.into_iter().find(|class| word.eq_ignore_ascii_case(class)))
    };
    let pass = word("PassMethod");
    let by_pass = || PASSES.iter().find(|(own, _)| *own == pass).map(|(_, class)| *class);
    let found = named(word("Class")).or_else(|| named(word("FamName"))).or_else(by_pass).or_else(|| by_fields(one));
    match (word("Class"), pass) {
        _ if found.is_some() => found.unwrap_or_default().into(),
        ("", pass) => pass.into(),
        (class, _) => class.into(),
    }
}

fn by_fields(one: &Map<String, Value>) -> Option<&'static str> {
    let has = |keys: &[&str]| keys.iter().any(|key| one.contains_key(*key));
    let does_nothing = one.get("PassMethod").and_then(Value::as_str) == Some("IdentityPass");
    let rules: [(&[&str], &str); 8] = [
        (&["FullGap", "FringeInt1", "FringeInt2", "gK", "EntranceAngle", "ExitAngle"], "Dipole"),
        (&["Voltage", "Frequency", "HarmNumber", "PhaseLag", "TimeLag"], "RFCavity"),
        (&["Periodicity"], "RingParam"),
        (&["Limits"], "Aperture"),
        (&["M66"], "M66"),
        (&["K"], "Quadrupole"),
        (&["PolynomA", "PolynomB"], "Multipole"),
        (&["KickAngle"], "Corrector"),
    ];
    let by_rule = rules.into_iter().find(|(keys, _)| has(keys)).map(|(_, class)| class);
    by_rule.or_else(|| match one.get("PassMethod").and_then(Value::as_str) {
        Some("DriftPass") => Some("Drift"),
        _ if has(&["GCR"]) => Some("Monitor"),
        _ => does_nothing.then_some("Marker"),
    })
}

/// Properties of the ring, in the words of pyAT's JSON.
fn ring(cell: &Place, one: &Map<String, Value>, properties: &mut Map<String, Value>) -> Result<(), MeasuredError> {
    for (own, word) in [("Energy", "energy"), ("Periodicity", "periodicity")] {
        properties.extend(one.get(own).map(|value| (word.to_owned(), value.clone())));
    }
    if let Some(particle) = cell.field("Particle") {
        let name = particle.field("name").or(particle.field("Name")).unwrap_or(particle);
        let Some(text) = name.text() else { return Err(name.expected("the name of a particle")) };
        properties.insert("particle".into(), json!({"name": text}));
    }
    Ok(())
}

/// The energy [eV] that elements state, where it is the same in all.
fn common_energy(elements: &[Value]) -> Option<Value> {
    let mut stated = elements.iter().filter_map(|one| one.get("Energy"));
    let first = stated.next()?;
    stated.all(|one| one == first).then(|| first.clone())
}

#[cfg(test)]
mod tests {
    use rand::rngs::StdRng;
    use rand::{RngExt, SeedableRng};

    use super::*;

    /// By pyAT, not compressed; by Octave, compressed.
    const FILES: [&[u8]; 2] = [
        include_bytes!("../../../recordings/measured/imports/twelve-cells.at.mat"),
        include_bytes!("../../../recordings/measured/imports/twelve-cells.octave.mat"),
    ];

    fn parse(bytes: &[u8]) -> Result<(), MeasuredError> {
        read(&MatFile::of("file", bytes.to_vec())?, None).map(drop)
    }

    #[test]
    fn a_file_that_is_cut_off_is_refused() {
        for bytes in FILES {
            assert!(parse(bytes).is_ok());
            for length in (0..bytes.len()).step_by(if bytes.len() > 10_000 { 101 } else { 1 }) {
                assert!(parse(&bytes[..length]).is_err(), "{length}");
            }
        }
    }

    #[test]
    fn no_byte_makes_it_panic() {
        let mut random = StdRng::seed_from_u64(5);
        for bytes in FILES {
            for _ in 0..3000 {
                let mut bytes = bytes.to_vec();
                for _ in 0..random.random_range(1..4) {
                    let at = random.random_range(116..bytes.len());
                    bytes[at] = if random.random() { 0xff } else { random.random() };
                }
                drop(parse(&bytes));
            }
        }
    }

    #[test]
    fn a_struct_of_more_elements_than_bytes_is_refused() {
        let bytes = FILES[0];
        // dimensions of the cell array: after the header and the tags of the variable, its flags and they themselves
        let at = 128 + 8 + 16 + 8;
        let mut bytes = bytes.to_vec();
        bytes[at..at + 8].copy_from_slice(&[0xff, 0xff, 0xff, 0x7f, 0xff, 0xff, 0xff, 0x7f]);
        assert!(parse(&bytes).unwrap_err().to_string().contains("cut off"));
    }
}
