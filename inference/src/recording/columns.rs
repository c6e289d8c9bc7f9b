//! The first line of `frames.csv`: which column holds what.

use std::path::Path;

use super::error::{Mismatch, Part, Place, RecordingError};
use super::header::{Format, Header};
use super::names::{FOCUSING, Names, feeds};
use twin::{Ring, Weights};

/// The columns of a file by their index.
#[derive(Debug)]
pub(super) struct Columns {
    /// As this ring's recordings write them, in the file's order.
    pub names: Vec<String>,
    pub sequence: usize,
    pub time: usize,
    pub cycle_time: Option<usize>,
    /// The correctors that were set, and their settings.
    pub set: Option<(usize, usize)>,
    pub rf_offset: Option<usize>,
    pub dipole: Option<usize>,
    /// Supplies [F]: columns and their weights.
    pub supply: Vec<Vec<(usize, f64)>>,
    /// Currents that drive nothing in the model.
    pub other: Vec<usize>,
    pub corrector_current: Vec<usize>,
    pub reading: Vec<usize>,
    pub intensity: Option<usize>,
    pub tune: [Option<usize>; 2],
}

/// What a row of format 1 begins and ends with.
const FIRST: [&str; 2] =
    ["seq,time_s,t_cycle_ms,corrector,setting_A,drf_rel,i_dipole_A,i_qh_A,i_qv_A,i_sh_A,i_sv_A", "qx_frac,qy_frac"];
/// Columns that a file of format 2 may have or not.
const OPTIONAL: [&str; 8] =
    ["t_cycle_ms", "corrector", "setting_A", "drf_rel", "intensity", "qx_frac", "qy_frac", "i_dipole_A"];

impl Columns {
    pub fn parse(file: &Path, line: &str, header: &Header, ring: &Ring, names: &Names) -> Result<Self, RecordingError> {
        let found: Vec<&str> = line.split(',').collect();
        let known: Vec<String> = found.iter().map(|column| names.canonical(column)).collect();
        match header.format {
            Format::One => check_order(file, &in_order(names), &known, &found)?,
            Format::Two => check_names(file, &required(header, ring, names, &known), &known, &found)?,
        }
        Ok(Self::by_name(known, header, ring, names))
    }

    /// All required columns are there.
    fn by_name(columns: Vec<String>, header: &Header, ring: &Ring, names: &Names) -> Self {
        let find = |name: &str| columns.iter().position(|column| column == name);
        let required = |name: &str| find(name).expect("the columns are checked");
        let supplies: Vec<String> = match header.format {
            Format::One => feeds(ring).into_iter().map(|feed| FOCUSING[feed].to_owned()).collect(),
            Format::Two => names.supplies.clone(),
        };
        let of_supply = |supply: &String| match summed(ring, supply, &columns) {
            Some(weights) => weights.0.iter().map(|(name, weight)| (required(&supply_column(name)), *weight)).collect(),
            None => vec![(required(&supply_column(supply)), 1.0)],
        };
        let supply: Vec<Vec<(usize, f64)>> = supplies.iter().map(of_supply).collect();
        let dipole = header.nominal_dipole.map(|_| required("i_dipole_A"));
        // a read-back of a sum is kept beside it
        let alone = |i: usize| supply.iter().any(|sum| *sum == [(i, 1.0)]);
        let drives = |&i: &usize| is_current(&columns[i]) && !alone(i) && Some(i) != dipole;
        Self {
            sequence: required("seq"),
            time: required("time_s"),
            cycle_time: find("t_cycle_ms"),
            set: find("corrector").zip(find("setting_A")),
            rf_offset: find("drf_rel"),
            other: (0..columns.len()).filter(drives).collect(),
            dipole,
            supply,
            corrector_current: (0..names.correctors.len()).map(|c| required(&names.corrector_column(c))).collect(),
            reading: (0..names.monitors.len()).map(|b| required(&names.monitor_column(b))).collect(),
            intensity: find("intensity"),
            tune: [find("qx_frac"), find("qy_frac")],
            names: columns,
        }
    }
}

/// Weights of the read-backs of a supply that has no column of its own, by the machine file's supply law.
fn summed<'r>(ring: &'r Ring, supply: &str, columns: &[String]) -> Option<&'r Weights> {
    let weights = &ring.currents.as_ref()?.quadrupoles.get(supply)?.current;
    (!columns.contains(&supply_column(supply))).then_some(weights)
}

/// Column of a supply's read-back.
pub(super) fn supply_column(supply: &str) -> String {
    format!("i_{supply}_A")
}

/// True for the read-back of a supply, of the machine or of anything else.
fn is_current(column: &str) -> bool {
    column.len() > "i__A".len() && column.starts_with("i_") && column.ends_with("_A")
}

/// The columns of format 1.
fn in_order(names: &Names) -> Vec<String> {
    let [before, after] = FIRST.map(|columns| columns.split(',').map(String::from));
    before.chain(instruments(names)).chain(after).collect()
}

fn instruments(names: &Names) -> impl Iterator<Item = String> {
    let correctors = (0..names.correctors.len()).map(|c| names.corrector_column(c));
    correctors.chain((0..names.monitors.len()).map(|b| names.monitor_column(b)))
}

/// The columns without which a file of format 2 is none.
fn required(header: &Header, ring: &Ring, names: &Names, columns: &[String]) -> Vec<String> {
    let dipole = header.nominal_dipole.map(|_| "i_dipole_A".to_owned());
    let of_supply = |supply: &String| match summed(ring, supply, columns) {
        Some(weights) => weights.0.keys().map(|name| supply_column(name)).collect(),
        None => vec![supply_column(supply)],
    };
    let supplies = names.supplies.iter().flat_map(of_supply);
    let fixed = ["seq", "time_s"].map(String::from).into_iter();
    let cycle_time = header.ramp.is_given().then(|| "t_cycle_ms".to_owned());
    fixed.chain(cycle_time).chain(dipole).chain(supplies).chain(instruments(names)).collect()
}

/// Reports the first column that differs from the expected one.
fn check_order(file: &Path, expected: &[String], known: &[String], found: &[&str]) -> Result<(), RecordingError> {
    let Some(i) = (0..expected.len().max(known.len())).find(|&i| expected.get(i) != known.get(i)) else {
        return Ok(());
    };
    let end = || "the end of the line".to_owned();
    let (wanted, stands) = (expected.get(i).cloned(), found.get(i).map(|name| format!("{name:?}")));
    let mismatch = column(file, i).mismatch(wanted.unwrap_or_else(end), stands.unwrap_or_else(end));
    Err(order_error(expected, known, i)(mismatch))
}

/// What is the matter at column `i`, the first whose name is not the expected one.
fn order_error(expected: &[String], known: &[String], i: usize) -> fn(Mismatch) -> RecordingError {
    let Some(found) = known.get(i) else { return RecordingError::MissingColumn };
    if known.iter().filter(|column| *column == found).count() > 1 {
        RecordingError::DuplicateColumn
    } else if expected.iter().any(|column| is_other_unit(column, found) && !known.contains(column)) {
        RecordingError::ColumnUnit
    } else if !expected.contains(found) {
        RecordingError::UnknownColumn
    } else if expected.get(i).is_some_and(|column| !known.contains(column)) {
        RecordingError::MissingColumn
    } else {
        RecordingError::MisplacedColumn
    }
}

/// Reports the first column that no recording of this machine has, or has twice, else the first that is missing.
fn check_names(file: &Path, required: &[String], known: &[String], found: &[&str]) -> Result<(), RecordingError> {
    for (i, name) in known.iter().enumerate() {
        let wrong = |expected: &str| column(file, i).mismatch(expected, format!("{:?}", found[i]));
        if known[..i].contains(name) {
            return Err(RecordingError::DuplicateColumn(wrong("every column once")));
        }
        if required.contains(name) || OPTIONAL.contains(&name.as_str()) || is_current(name) {
            continue;
        }
        let of_other_unit = |column: &&String| is_other_unit(column, name);
        return Err(match required.iter().find(of_other_unit) {
            Some(expected) => RecordingError::ColumnUnit(wrong(expected)),
            None => RecordingError::UnknownColumn(wrong("a column of this format")),
        });
    }
    let lacks = |name: &str| !known.iter().any(|column| column == name);
    let pair = ["corrector", "setting_A"];
    let half = pair.into_iter().find(|name| lacks(name)).filter(|_| !pair.iter().all(|name| lacks(name)));
    match required.iter().map(String::as_str).find(|name| lacks(name)).or(half) {
        Some(missing) => {
            let at = Place::new(file, 1, Part::Whole);
            Err(RecordingError::MissingColumn(at.mismatch(missing, "no column of this name")))
        }
        None => Ok(()),
    }
}

fn column(file: &Path, index: usize) -> Place {
    Place::new(file, 1, Part::Column((index + 1).to_string()))
}

fn is_other_unit(column: &str, other: &str) -> bool {
    column != other && quantity(column) == quantity(other)
}

/// A column's name without its unit.
fn quantity(column: &str) -> &str {
    column.rsplit_once('_').map_or(column, |(quantity, _)| quantity)
}
