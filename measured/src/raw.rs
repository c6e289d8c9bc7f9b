//! Raw orbits: what every monitor read at minus and at plus half of each corrector's kick, one pair of frames a corrector.

use std::path::Path;

use nalgebra::DMatrix;
use serde::Deserialize;
use twin::limits::{self, Budget, MEMORY};
use twin::median;

use crate::error::MeasuredError;
use crate::folder::{Folder, number, table, text};
use crate::wiring::Wiring;

/// Pairs of orbits, as they were read.
#[derive(Debug, Clone, PartialEq)]
pub struct RawOrbits {
    /// Orbit at plus half the kick less that at minus half [mm], rows monitors, columns correctors: what a response matrix holds.
    pub change: DMatrix<f64>,
    /// The mean of both [mm]: the orbit without the kick, and what it drifts from one pair to the next.
    pub middle: DMatrix<f64>,
    /// Current from minus to plus half the kick, by corrector [A].
    pub amperes: Vec<f64>,
}

/// No beam pipe is wider: an orbit stays within it [mm].
const WIDEST: f64 = 1e3;

const MINUS: &str = "raw_orbit_minus_mm.csv";
const PLUS: &str = "raw_orbit_plus_mm.csv";

/// What a folder with raw orbits alone, or `raw_orbit_meta.json` beside a matrix, says of the currents.
#[derive(Deserialize)]
struct Currents {
    #[serde(rename = "actuator_delta_A")]
    amperes: Vec<f64>,
}

impl RawOrbits {
    /// True of a folder that holds raw orbits.
    pub fn are_in(path: &Path) -> bool {
        path.join(MINUS).is_file() && path.join(PLUS).is_file()
    }

    /// Read them: two tables without names, rows monitors, columns correctors, and the currents in `raw_orbit_meta.json` or `meta.json`.
    ///
    /// # Errors
    /// [`MeasuredError`], with file and line.
    pub fn read(path: &Path) -> Result<Self, MeasuredError> {
        let file = ["raw_orbit_meta.json", "meta.json"].map(|name| path.join(name));
        let file = if file[0].is_file() { &file[0] } else { &file[1] };
        let Currents { amperes } = limits::json(&text(file)?).map_err(|e| table(file, e.to_string()))?;
        if let Some(wrong) = amperes.iter().position(|one| !(one.is_finite() && *one != 0.0)) {
            let problem = format!("actuator_delta_A, entry {}: expected a current other than 0", wrong + 1);
            return Err(table(file, problem));
        }
        let [minus, plus] = [MINUS, PLUS].map(|name| numbers(&path.join(name), amperes.len()));
        let (minus, plus) = (minus?, plus?);
        if minus.nrows() != plus.nrows() {
            let problem = format!("{} rows, {MINUS} has {}", plus.nrows(), minus.nrows());
            return Err(table(&path.join(PLUS), problem));
        }
        Ok(Self { change: &plus - &minus, middle: (plus + minus) / 2.0, amperes })
    }

    /// The orbits of a folder's instruments.
    ///
    /// # Errors
    /// [`MeasuredError::Unlike`]: there are more or fewer instruments in the folder's tables.
    pub fn of(path: &Path, folder: &Folder) -> Result<Self, MeasuredError> {
        let raw = Self::read(path)?;
        let (found, expected) = (raw.change.shape(), folder.matrix.shape());
        if found == expected {
            return Ok(raw);
        }
        Err(MeasuredError::Unlike(format!(
            "{}: raw orbits of {} readings and {} correctors, bpms.csv and correctors.csv have {} and {}",
            path.display(),
            found.0,
            found.1,
            expected.0,
            expected.1
        )))
    }

    /// The same with cables that were found wrong put right.
    pub fn with_cables(mut self, folder: &Folder, cables: &[Wiring]) -> Self {
        let mut apart = Folder { matrix: self.change, ..folder.clone() };
        // a supply keeps its current as it keeps its kick
        apart.correctors.iter_mut().zip(&self.amperes).for_each(|(one, amperes)| one.kick = *amperes);
        cables.iter().for_each(|one| one.put_right(&mut apart));
        self.amperes = apart.correctors.iter().map(|one| one.kick).collect();
        self.change = core::mem::replace(&mut apart.matrix, self.middle);
        // the sign of a kick does not turn the orbit without it
        let of_orbit = |one: &&Wiring| !matches!(one, Wiring::CorrectorReversed(_) | Wiring::PlaneReversed(_));
        cables.iter().filter(of_orbit).for_each(|one| one.put_right(&mut apart));
        self.middle = apart.matrix;
        self
    }

    /// What the orbit drifts from one pair to the next [mm]: rms of a monitor, the median over some; none where no monitor read two of them.
    pub fn drift(&self, monitors: &[usize]) -> Option<f64> {
        let steps = |row: usize| {
            let read: Vec<f64> = self.middle.row(row).iter().copied().filter(|one| one.is_finite()).collect();
            let squares: f64 = read.windows(2).map(|pair| (pair[1] - pair[0]).powi(2)).sum();
            (read.len() > 1).then(|| (squares / (read.len() - 1) as f64).sqrt())
        };
        median(monitors.iter().filter_map(|&row| steps(row)))
    }
}

/// What a number takes in memory: in its list and in its matrix, of both files, and in the change and the middle [B].
const NUMBER: u64 = 6 * size_of::<f64>() as u64;

/// A table of numbers alone; an empty field was not read.
fn numbers(file: &Path, columns: usize) -> Result<DMatrix<f64>, MeasuredError> {
    let text = text(file)?;
    let mut reader = csv::ReaderBuilder::new().has_headers(false).flexible(true).from_reader(text.as_bytes());
    let (mut rows, mut all, memory) = (0, Vec::new(), Budget::new(MEMORY));
    for record in reader.records() {
        let record = record.map_err(|error| table(file, error.to_string()))?;
        rows += 1;
        if record.len() != columns {
            let problem = format!(
                "line {rows}: expected {columns} numbers, one a current of actuator_delta_A, found {}",
                record.len()
            );
            return Err(table(file, problem));
        }
        memory.take(NUMBER * columns as u64).map_err(|exceeded| table(file, format!("line {rows}: {exceeded}")))?;
        for (column, field) in record.iter().enumerate() {
            let place = format!("line {rows}, column {}", column + 1);
            match number(field) {
                Some(orbit) if orbit.abs() > WIDEST => {
                    return Err(table(file, format!("{place}: {orbit} mm, expected {WIDEST} mm at most")));
                }
                Some(orbit) => all.push(orbit),
                None => return Err(table(file, format!("{place}: expected a number, found {field}"))),
            }
        }
    }
    Ok(DMatrix::from_row_slice(rows, columns, &all))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn read(minus: &str, plus: &str, meta: &str) -> Result<RawOrbits, String> {
        let folder = tempfile::tempdir().unwrap();
        for (name, text) in [(MINUS, minus), (PLUS, plus), ("meta.json", meta)] {
            fs::write(folder.path().join(name), text).unwrap();
        }
        assert!(RawOrbits::are_in(folder.path()));
        let said = |error: MeasuredError| error.to_string().rsplit('/').next().unwrap_or_default().to_owned();
        RawOrbits::read(folder.path()).map_err(said)
    }

    const META: &str = r#"{"actuator_delta_A": [0.5, 2.0]}"#;

    #[test]
    fn pairs_of_orbits_are_a_change_and_a_middle() {
        let raw = read("1,2\n3,\n", "2,4\n4,5\n", META).unwrap();
        assert_eq!(raw.change.as_slice()[..3], [1.0, 1.0, 2.0]);
        assert_eq!(raw.middle.as_slice()[..3], [1.5, 3.5, 3.0]);
        assert!(raw.change[(1, 1)].is_nan() && raw.amperes == [0.5, 2.0]);
        assert_eq!((raw.drift(&[0]), raw.drift(&[])), (Some(1.5), None));
    }

    #[test]
    fn what_is_wrong_is_said_with_its_place() {
        assert_eq!(
            read("1,2\n3\n", "1,2\n3,4\n", META).unwrap_err(),
            "raw_orbit_minus_mm.csv: line 2: expected 2 numbers, one a current of actuator_delta_A, found 1"
        );
        assert_eq!(
            read("1,2\n", "1,a\n", META).unwrap_err(),
            "raw_orbit_plus_mm.csv: line 1, column 2: expected a number, found a"
        );
        assert_eq!(
            read("1,2\n", "1,-2e3\n", META).unwrap_err(),
            "raw_orbit_plus_mm.csv: line 1, column 2: -2000 mm, expected 1000 mm at most"
        );
        assert_eq!(
            read("1,2\n", "1,2\n3,4\n", META).unwrap_err(),
            "raw_orbit_plus_mm.csv: 2 rows, raw_orbit_minus_mm.csv has 1"
        );
        assert!(read("1,2\n", "1,2\n", r#"{"actuator_delta_A": [0.5, 0]}"#).unwrap_err().contains("entry 2"));
        assert!(read("1,2\n", "1,2\n", "{}").unwrap_err().contains("actuator_delta_A"));
    }
}
