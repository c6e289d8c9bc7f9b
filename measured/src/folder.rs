//! A measurement as a folder of tables, docs/real-rings.md.
//!
//! `lattice.csv` has one row an element, `bpms.csv` and `correctors.csv` one row a monitor or corrector and plane, `orm_measured_mm.csv` the
//! change of the orbit [mm] from minus to plus half a corrector's kick, `meta.json` what else was written down.

use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::Path;

use nalgebra::{DMatrix, DVector};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};
use twin::Plane;
use twin::limits::{self, Budget, FILE, FINITE, MEMORY, POSITIVE};

use crate::error::MeasuredError;

/// One measured response matrix and what it was measured on.
#[derive(Debug, Clone)]
pub struct Folder {
    /// Name of the folder.
    pub name: String,
    /// What was written down beside the tables.
    pub meta: Meta,
    /// Elements in beam order.
    pub lattice: Vec<Row>,
    /// Monitors, one row a plane, in the order of the matrix's rows.
    pub monitors: Vec<MonitorRow>,
    /// Correctors, one row a plane, in the order of the matrix's columns.
    pub correctors: Vec<CorrectorRow>,
    /// Orbit at plus half the kick less that at minus half [mm], rows monitors, columns correctors; NaN: not measured.
    pub matrix: DMatrix<f64>,
    /// Change of the orbit [mm] with `meta.delta_rf`, if it was measured.
    pub dispersion: Option<DVector<f64>>,
}

/// `meta.json`.
#[derive(Debug, Clone, Deserialize)]
pub struct Meta {
    /// Length of the reference orbit [m].
    #[serde(rename = "circumference_m")]
    pub circumference: f64,
    /// Total energy of a particle [GeV]; where none is stated they count as ultra-relativistic.
    #[serde(rename = "energy_GeV")]
    pub energy: Option<f64>,
    /// `electron`, which it is where none is stated, or `proton`.
    #[serde(default)]
    pub particle: Particle,
    /// RF frequency [Hz].
    #[serde(rename = "rf_Hz")]
    pub rf: f64,
    /// Step of the RF frequency for the dispersion [Hz].
    #[serde(rename = "delta_rf_Hz")]
    pub delta_rf: f64,
    /// What the reference fit had free, if there was one.
    pub reference_fit: Option<ReferenceFit>,
}

/// What is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Particle {
    /// Electrons or positrons.
    #[default]
    Electron,
    /// Protons or antiprotons.
    Proton,
}

impl Particle {
    /// Its word in a file.
    pub fn word(self) -> &'static str {
        match self {
            Self::Electron => "electron",
            Self::Proton => "proton",
        }
    }

    /// Rest energy [GeV].
    pub fn rest_energy(self) -> f64 {
        twin::Particle::rest_energy_of(self.word()).expect("a machine file may name it")
    }

    /// The particle of a rest energy [GeV], which other codes state to a thousandth or better.
    pub fn of_rest_energy(energy: f64) -> Option<Self> {
        [Self::Electron, Self::Proton].into_iter().find(|one| (energy / one.rest_energy() - 1.0).abs() < 1e-3)
    }
}

impl Meta {
    /// Frequency and circumference are those of a ring, and groups of the reference fit are of elements of the lattice, which has so many.
    fn check(&self, elements: usize) -> Result<(), String> {
        for (name, value) in [("circumference_m", self.circumference), ("rf_Hz", self.rf)] {
            if !(value > 0.0 && value.is_finite()) {
                return Err(format!("{name} {value}, expected above 0"));
            }
        }
        let groups = self.reference_fit.iter().flat_map(|fit| &fit.fit_parameters);
        let mut fitted = BTreeMap::new();
        for (number, group) in groups.enumerate() {
            let place = format!("reference_fit, fit_parameters {number}");
            if !["K", "PolynomA"].contains(&group.field.as_str()) {
                let field = &group.field;
                return Err(format!("{place}: field {field}, expected K (gradients) or PolynomA (skew gradients)"));
            }
            match group.elements.iter().find(|row| **row >= elements) {
                Some(row) => return Err(format!("{place}: element {row}, lattice.csv has rows 0 to {}", elements - 1)),
                None if group.elements.is_empty() => return Err(format!("{place}: expected elements, found none")),
                None => {}
            }
            for row in &group.elements {
                if let Some(other) = fitted.insert((&group.field, row), number).filter(|other| *other != number) {
                    return Err(format!(
                        "{place}: element {row} with {} is in fit_parameters {other} too",
                        group.field
                    ));
                }
            }
        }
        Ok(())
    }
}

/// The parameters of another fit to the same matrix.
#[derive(Debug, Clone, Deserialize, Serialize)]
pub struct ReferenceFit {
    /// Magnets that were fitted together, one group each.
    pub fit_parameters: Vec<Group>,
    /// Its options.
    pub flags: Flags,
    /// What it found, which nothing here uses.
    #[serde(flatten)]
    pub rest: Map<String, Value>,
}

/// Elements that share one parameter.
#[derive(Debug, Clone, Deserialize, Serialize)]
pub struct Group {
    /// Rows of the lattice.
    pub elements: Vec<usize>,
    /// `K`: a gradient; `PolynomA`: a skew gradient.
    pub field: String,
}

/// Options of the reference fit.
#[derive(Debug, Clone, Deserialize, Serialize)]
#[serde(rename_all = "PascalCase")]
pub struct Flags {
    /// `Yes` where the coupling blocks were used.
    pub coupling: String,
    /// `Yes` where the dispersion was used.
    pub dispersion: String,
    /// Others, which nothing here uses.
    #[serde(flatten)]
    pub rest: Map<String, Value>,
}

/// A row of `lattice.csv`.
#[derive(Debug, Clone, Deserialize)]
pub struct Row {
    /// Name of the family or of the element; several rows may share it.
    pub name: String,
    /// Entrance [m].
    #[serde(rename = "s_entrance_m")]
    pub s: f64,
    /// Length along the reference orbit [m].
    #[serde(rename = "length_m")]
    pub length: f64,
    /// Angle of a dipole [rad].
    #[serde(rename = "bend_rad")]
    pub bend: f64,
    /// Edge angles [rad].
    #[serde(rename = "edge_in_rad")]
    pub edge_in: f64,
    /// The same at the exit.
    #[serde(rename = "edge_out_rad")]
    pub edge_out: f64,
    /// Soft edges of a dipole: fringe integral times full gap [m]; 0 where the table has no such column.
    #[serde(rename = "edge_fringe_m", default)]
    pub fringe: f64,
    /// Gradient at the start of the fit [1/m^2].
    #[serde(rename = "k1_start_1_m2")]
    pub k1: f64,
    /// Half the sextupole [1/m^3].
    #[serde(rename = "k2_half_1_m3")]
    pub half_k2: f64,
}

/// A row of `bpms.csv`.
#[derive(Debug, Clone, Deserialize)]
pub struct MonitorRow {
    /// What it reads.
    #[serde(deserialize_with = "plane")]
    pub plane: Plane,
    /// Row of the lattice.
    #[serde(rename = "lattice_index")]
    pub at: usize,
    /// Noise of an element of the matrix, as stated [mm].
    #[serde(rename = "sigma_mm")]
    pub sigma: f64,
    /// 0 where it is known to be dead.
    #[serde(rename = "used_by_reference_fit", deserialize_with = "yes")]
    pub is_used: bool,
}

/// A row of `correctors.csv`.
#[derive(Debug, Clone, Deserialize)]
pub struct CorrectorRow {
    /// Where it kicks.
    #[serde(deserialize_with = "plane")]
    pub plane: Plane,
    /// Row of the lattice.
    #[serde(rename = "lattice_index")]
    pub at: usize,
    /// Kick from minus to plus half [mrad], as believed.
    #[serde(rename = "nominal_kick_mrad")]
    pub kick: f64,
    /// 0 where it is known to be dead.
    #[serde(rename = "used_by_reference_fit", deserialize_with = "yes")]
    pub is_used: bool,
}

fn plane<'de, D: serde::Deserializer<'de>>(from: D) -> Result<Plane, D::Error> {
    match String::deserialize(from)?.as_str() {
        "x" => Ok(Plane::X),
        "y" => Ok(Plane::Y),
        other => Err(serde::de::Error::custom(format!("a plane is x or y, found {other}"))),
    }
}

fn yes<'de, D: serde::Deserializer<'de>>(from: D) -> Result<bool, D::Error> {
    Ok(u8::deserialize(from)? != 0)
}

/// What an element of a matrix takes in memory, a model's beside it [B].
const NUMBER: u64 = 2 * size_of::<f64>() as u64;

impl Folder {
    /// True of a folder that holds a measured matrix.
    pub fn is_one(path: &Path) -> bool {
        path.join("orm_measured_mm.csv").is_file()
    }

    /// Read a folder.
    ///
    /// # Errors
    /// [`MeasuredError`], with file and line.
    pub fn read(path: &Path) -> Result<Self, MeasuredError> {
        let name = path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
        let (lattice, monitors, correctors): (Vec<Row>, Vec<MonitorRow>, Vec<CorrectorRow>) =
            (rows(&path.join("lattice.csv"))?, rows(&path.join("bpms.csv"))?, rows(&path.join("correctors.csv"))?);
        let file = path.join("meta.json");
        let meta = limits::json(&text(&file)?).map_err(|e| table(&file, e.to_string()))?;
        let file = path.join("orm_measured_mm.csv");
        let matrix = matrix(&file, monitors.len(), correctors.len())?;
        let file = path.join("dispersion_orbit_mm.csv");
        let dispersion = file.is_file().then(|| self::matrix(&file, monitors.len(), 1)).transpose()?;
        let folder = Self {
            name,
            meta,
            lattice,
            monitors,
            correctors,
            matrix,
            dispersion: dispersion.map(|one| one.column(0).into_owned()),
        };
        folder.check(path)?;
        folder.expect_names(&path.join("orm_measured_mm.csv"))?;
        Ok(folder)
    }

    /// Where the names of all rows or all columns of the matrix are those of the instruments, such as `x12`, they stand in the same order.
    fn expect_names(&self, file: &Path) -> Result<(), MeasuredError> {
        let text = text(file)?;
        let mut reader = csv::Reader::from_reader(text.as_bytes());
        let refused = |error: csv::Error| table(file, error.to_string());
        let columns: Vec<String> = reader.headers().map_err(refused)?.iter().skip(1).map(str::to_owned).collect();
        let rows: Result<Vec<String>, _> = reader.records().map(|record| Ok(record?[0].to_owned())).collect();
        let of_columns: Vec<String> = self.correctors.iter().map(|one| label(one.plane, one.at)).collect();
        let of_rows: Vec<String> = self.monitors.iter().map(|one| label(one.plane, one.at)).collect();
        for (what, found, expected) in [("column", columns, of_columns), ("line", rows.map_err(refused)?, of_rows)] {
            let found: Vec<&str> = found.iter().map(|name| name.trim()).collect();
            let names: BTreeSet<&str> = expected.iter().map(String::as_str).collect();
            let wrong = found.iter().zip(&expected).position(|(found, expected)| found != expected);
            if let Some(at) = wrong.filter(|_| found.iter().all(|name| names.contains(name))) {
                let (found, expected) = (found[at], &expected[at]);
                let problem =
                    format!("{what} {} is named {found}, expected {expected} as in the table of instruments", at + 2);
                return Err(table(file, problem));
            }
        }
        Ok(())
    }

    /// Places that are named exist and have one instrument each, noise is above zero, and correctors kick. Elements of a matrix
    /// have no limit: they are as large as the kick that they are counted for, 10 m for a kick of 1 rad.
    fn check(&self, path: &Path) -> Result<(), MeasuredError> {
        let last = self.lattice.len();
        if last == 0 {
            return Err(table(&path.join("lattice.csv"), "expected elements, found none".into()));
        }
        for (row, one) in self.lattice.iter().enumerate() {
            let numbers = [one.s, one.length, one.bend, one.edge_in, one.edge_out, one.fringe, one.k1, one.half_k2];
            let wrong = |problem| table(&path.join("lattice.csv"), format!("row {row}: {problem}"));
            numbers.iter().try_for_each(|number| FINITE.check(*number).map(drop)).map_err(wrong)?;
        }
        self.meta.check(last).map_err(|problem| table(&path.join("meta.json"), problem))?;
        let mut places = (self.monitors.iter().map(|one| ("bpms.csv", one.at)))
            .chain(self.correctors.iter().map(|one| ("correctors.csv", one.at)));
        if let Some((file, at)) = places.find(|(_, at)| *at >= last) {
            return Err(table(&path.join(file), format!("lattice_index {at}, lattice.csv has rows 0 to {}", last - 1)));
        }
        for (row, one) in self.monitors.iter().enumerate().filter(|(_, one)| one.is_used) {
            if POSITIVE.check(one.sigma).is_err() {
                let problem = format!("row {row}: sigma_mm {}, expected above 0 where the monitor is used", one.sigma);
                return Err(table(&path.join("bpms.csv"), problem));
            }
        }
        for (row, one) in self.correctors.iter().enumerate().filter(|(_, one)| one.is_used) {
            if POSITIVE.check(one.kick.abs()).is_err() {
                let problem =
                    format!("row {row}: nominal_kick_mrad {}, expected one where the corrector is used", one.kick);
                return Err(table(&path.join("correctors.csv"), problem));
            }
        }
        let twice = |file: &str, places: Vec<(Plane, usize)>| {
            let mut first = HashMap::new();
            let mut each = places.iter().enumerate();
            let pair = each.find_map(|(j, (plane, at))| first.insert((plane.index(), *at), j).map(|i| (i, j)));
            pair.map(|(i, j)| {
                let plane = if places[i].0 == Plane::X { "x" } else { "y" };
                let problem =
                    format!("rows {i} and {j} are both {plane} at lattice_index {}, expected one", places[i].1);
                table(&path.join(file), problem)
            })
        };
        let monitors = twice("bpms.csv", self.monitors.iter().map(|one| (one.plane, one.at)).collect());
        let correctors = || twice("correctors.csv", self.correctors.iter().map(|one| (one.plane, one.at)).collect());
        if let Some(error) = monitors.or_else(correctors) {
            return Err(error);
        }
        if self.dispersion.is_some() && self.meta.delta_rf == 0.0 {
            let problem = "the orbit of a step of 0 Hz (delta_rf_Hz of meta.json)".into();
            return Err(table(&path.join("dispersion_orbit_mm.csv"), problem));
        }
        Ok(())
    }

    /// Name of a row of the lattice: that of its family and its number.
    pub fn element(&self, row: usize) -> String {
        format!("{}.{row}", self.lattice[row].name)
    }

    /// Name of a monitor's row: `x_BPM.3`.
    pub fn monitor(&self, row: usize) -> String {
        let one = &self.monitors[row];
        format!("{}_{}", if one.plane == Plane::X { "x" } else { "y" }, self.element(one.at))
    }

    /// Name of a corrector's column: `H_COR.8`.
    pub fn corrector(&self, column: usize) -> String {
        let one = &self.correctors[column];
        format!("{}_{}", if one.plane == Plane::X { "H" } else { "V" }, self.element(one.at))
    }
}

pub(crate) fn table(file: &Path, problem: String) -> MeasuredError {
    MeasuredError::Table { file: file.display().to_string(), problem }
}

pub(crate) fn text(file: &Path) -> Result<String, MeasuredError> {
    FILE.text(file).map_err(|source| MeasuredError::Read { file: file.display().to_string(), source })
}

fn rows<T: DeserializeOwned>(file: &Path) -> Result<Vec<T>, MeasuredError> {
    let text = text(file)?;
    let mut reader = csv::Reader::from_reader(text.as_bytes());
    let memory = Budget::new(MEMORY);
    let row = |row: Result<T, csv::Error>| {
        let row = row.map_err(|error| table(file, error.to_string()))?;
        memory.take(size_of::<T>() as u64).map_err(|exceeded| table(file, exceeded.to_string()))?;
        Ok(row)
    };
    reader.deserialize().map(row).collect()
}

/// What an instrument is called in a table: its plane and its row of the lattice.
fn label(plane: Plane, at: usize) -> String {
    format!("{}{at}", if plane == Plane::X { "x" } else { "y" })
}

/// A field of a table; NaN where nothing was measured, none where it is no number whose square, over that of its noise, can be summed.
pub(crate) fn number(field: &str) -> Option<f64> {
    match field.trim() {
        "" => Some(f64::NAN),
        text => text.parse().ok().filter(|number: &f64| !number.powi(4).is_infinite()),
    }
}

/// Numbers below a line of names, each row with its own name first; an empty field was not measured.
fn matrix(file: &Path, rows: usize, columns: usize) -> Result<DMatrix<f64>, MeasuredError> {
    let text = text(file)?;
    let mut reader = csv::Reader::from_reader(text.as_bytes());
    let numbers = (rows as u64).saturating_mul(columns as u64);
    MEMORY
        .check(numbers.saturating_mul(NUMBER))
        .map_err(|exceeded| table(file, format!("{rows} monitors x {columns} correctors: {exceeded}")))?;
    let mut matrix = DMatrix::from_element(rows, columns, f64::NAN);
    let mut found = 0;
    for (i, record) in reader.records().enumerate() {
        let record = record.map_err(|error| table(file, error.to_string()))?;
        if i >= rows || record.len() != columns + 1 {
            let problem = format!(
                "line {}: expected {rows} lines of a name and {columns} numbers, found line {} with {}",
                i + 2,
                i + 1,
                record.len() - 1
            );
            return Err(table(file, problem));
        }
        for (j, field) in record.iter().skip(1).enumerate() {
            let refused = || table(file, format!("line {}, column {}: expected a number, found {field}", i + 2, j + 2));
            matrix[(i, j)] = number(field).ok_or_else(refused)?;
        }
        found = i + 1;
    }
    if found != rows {
        return Err(table(file, format!("expected {rows} rows, one a monitor of bpms.csv, found {found}")));
    }
    Ok(matrix)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    const LATTICE: &str = "index,name,s_entrance_m,length_m,bend_rad,edge_in_rad,edge_out_rad,k1_start_1_m2,k2_half_1_m3\n\
                           0,BPM,0,0,0,0,0,0,0\n1,COR,0,0.1,0,0,0,0,0\n";
    const MONITORS: &str = "row,plane,lattice_index,sigma_mm,used_by_reference_fit\n0,x,0,0.01,1\n1,y,0,0.01,0\n";
    const CORRECTORS: &str = "col,plane,lattice_index,nominal_kick_mrad,used_by_reference_fit\n0,x,1,0.1,1\n";
    const META: &str = r#"{"circumference_m": 10.0, "energy_GeV": null, "rf_Hz": 5e8, "delta_rf_Hz": 1000.0}"#;
    const MATRIX: &str = ",x1\nx0,0.25\ny0,\n";

    /// Tables with one of them changed.
    fn read(name: &str, text: &str) -> Result<Folder, MeasuredError> {
        let folder = tempfile::tempdir().unwrap();
        let files = [
            ("lattice.csv", LATTICE),
            ("bpms.csv", MONITORS),
            ("correctors.csv", CORRECTORS),
            ("meta.json", META),
            ("orm_measured_mm.csv", MATRIX),
        ];
        for (file, own) in files {
            fs::write(folder.path().join(file), if file == name { text } else { own }).unwrap();
        }
        assert!(Folder::is_one(folder.path()));
        Folder::read(folder.path())
    }

    fn refused(name: &str, text: &str) -> String {
        let message = read(name, text).unwrap_err().to_string();
        message[message.find(name).expect("the file is named")..].to_owned()
    }

    #[test]
    fn a_folder_is_read_and_named() {
        let folder = read("", "").unwrap();
        assert_eq!((folder.monitor(1), folder.corrector(0)), ("y_BPM.0".into(), "H_COR.1".into()));
        assert_eq!(folder.matrix[(0, 0)], 0.25);
        assert!(folder.matrix[(1, 0)].is_nan() && folder.dispersion.is_none() && folder.meta.energy.is_none());
    }

    #[test]
    fn what_is_wrong_is_said_with_its_place() {
        assert!(refused("bpms.csv", &MONITORS.replace(",y,", ",z,")).contains("a plane is x or y, found z"));
        assert_eq!(
            refused("bpms.csv", &MONITORS.replace("x,0,", "x,7,")),
            "bpms.csv: lattice_index 7, lattice.csv has rows 0 to 1"
        );
        assert!(
            refused("bpms.csv", &MONITORS.replacen("0.01", "0", 1)).contains("row 0: sigma_mm 0, expected above 0")
        );
        assert_eq!(
            refused("orm_measured_mm.csv", ",x1\nx0,a\ny0,1\n"),
            "orm_measured_mm.csv: line 2, column 2: expected a number, found a"
        );
        assert_eq!(
            refused("orm_measured_mm.csv", ",x1\nx0,1\n"),
            "orm_measured_mm.csv: expected 2 rows, one a monitor of bpms.csv, found 1"
        );
        assert!(refused("meta.json", "{}").contains("circumference_m"));
        assert_eq!(refused("meta.json", &META.replace("5e8", "0")), "meta.json: rf_Hz 0, expected above 0");
        let header = LATTICE.lines().next().unwrap();
        assert_eq!(refused("lattice.csv", header), "lattice.csv: expected elements, found none");
        let flags = r#""flags": {"Coupling": "Yes", "Dispersion": "No"}"#;
        for (group, problem) in [
            (r#"{"elements": [7], "field": "K"}"#, "element 7, lattice.csv has rows 0 to 1"),
            (r#"{"elements": [], "field": "K"}"#, "expected elements, found none"),
            (
                r#"{"elements": [1], "field": "PolynomB"}"#,
                "field PolynomB, expected K (gradients) or PolynomA (skew gradients)",
            ),
        ] {
            let fit = format!(r#", "reference_fit": {{"fit_parameters": [{group}], {flags}}}}}"#);
            assert_eq!(
                refused("meta.json", &META.replace('}', &fit)),
                format!("meta.json: reference_fit, fit_parameters 0: {problem}")
            );
        }
        let twice = r#", "reference_fit": {"fit_parameters": [{"elements": [1], "field": "K"}, {"elements": [1], "field": "K"}], "flags": {"Coupling": "Yes", "Dispersion": "No"}}}"#;
        assert_eq!(
            refused("meta.json", &META.replace('}', twice)),
            "meta.json: reference_fit, fit_parameters 1: element 1 with K is in fit_parameters 0 too"
        );
        assert_eq!(
            refused("orm_measured_mm.csv", ",x1\ny0,0.25\nx0,\n"),
            "orm_measured_mm.csv: line 2 is named y0, expected x0 as in the table of instruments"
        );
        // metres for a kick of 1 rad are no orbit
        assert_eq!(read("orm_measured_mm.csv", &MATRIX.replace("0.25", "-10225")).unwrap().matrix[(0, 0)], -10225.0);
        // names of another sort say nothing
        assert!(read("orm_measured_mm.csv", ",H1\n1,0.25\n2,\n").is_ok());
        assert_eq!(
            refused("correctors.csv", &CORRECTORS.replace("0.1", "0")),
            "correctors.csv: row 0: nominal_kick_mrad 0, expected one where the corrector is used"
        );
        assert_eq!(
            refused("bpms.csv", &MONITORS.replace(",y,", ",x,")),
            "bpms.csv: rows 0 and 1 are both x at lattice_index 0, expected one"
        );
        assert_eq!(
            refused("orm_measured_mm.csv", &MATRIX.replace("0.25", "1e300")),
            "orm_measured_mm.csv: line 2, column 2: expected a number, found 1e300"
        );
    }
}
