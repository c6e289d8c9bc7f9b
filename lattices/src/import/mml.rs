//! A response matrix of the Matlab Middle Layer (`BPMRespMat`, `GoldenBPMResp`): a 2 x 2 struct array, lines the planes of the monitors, columns those of
//! the correctors.
//!
//! | field | holds |
//! |---|---|
//! | `Data` | change of the orbit over the change of the corrector's strength, rows monitors, columns correctors; empty where it was not measured |
//! | `UnitsString` | their units, `mm/Radian` or `mm/Ampere`; else those of `Monitor` and `Actuator` |
//!
//! `ActuatorDelta`, by how much a strength was changed, is divided out of `Data`: an element belongs to one unit of the strength.
//!
//! Source: `measrespmat.m` and `measbpmresp.m` of the Matlab Middle Layer.

use super::conventions::{KickIs, OrbitUnit, Stated};
use super::hdf5::Matrix;
use super::instruments::Order;
use super::mat::{Mat, Place};
use measured::MeasuredError;

/// Fields by which it is known.
const FIELDS: [&str; 3] = ["Data", "Monitor", "Actuator"];

/// True of such a struct array.
pub(super) fn is_one(value: &Mat) -> bool {
    let Mat::Structs(shape, names, _) = value else { return false };
    shape[..] == [2, 2] && FIELDS.iter().all(|field| names.iter().any(|name| name == field))
}

/// Its blocks as one matrix, x before y and H before V, and what it says of them.
pub(super) fn read(all: &Place) -> Result<(Matrix, Stated), MeasuredError> {
    let block = |row: usize, column: usize| row + 2 * column;
    let shape = |row: usize| {
        let data = all.need_of(block(row, row), "Data")?;
        data.shape().ok_or_else(|| data.expected("a matrix"))
    };
    let (x, y) = (shape(0)?, shape(1)?);
    let (rows, columns) = ([x[0], y[0]], [x[1], y[1]]);
    let mut matrix = Matrix { width: columns[0] + columns[1], values: Vec::new() };
    for (row, &lines) in rows.iter().enumerate() {
        let blocks = [0, 1].map(|column| {
            let expected = [lines, columns[column]];
            match all.field_of(block(row, column), "Data") {
                None => Ok(vec![f64::NAN; expected[0] * expected[1]]),
                Some(data) if data.shape() == Some(expected) => Ok(data.numbers()?.to_vec()),
                Some(data) => Err(data.expected(&format!("{}x{} numbers", expected[0], expected[1]))),
            }
        });
        let [of_h, of_v] = blocks;
        let (of_h, of_v) = (of_h?, of_v?);
        for line in 0..lines {
            [&of_h, &of_v].into_iter().for_each(|of| matrix.values.extend(of.iter().skip(line).step_by(lines)));
        }
    }
    Ok((matrix, stated(all)?))
}

/// The units, which all blocks must have.
fn stated(all: &Place) -> Result<Stated, MeasuredError> {
    let units = (0..4).map(|block| units(all, block)).collect::<Result<Vec<_>, _>>()?;
    if let Some(other) = units.iter().find(|one| **one != units[0]) {
        return Err(all.wrong(&format!("UnitsString: expected one in all blocks, found {} and {other}", units[0])));
    }
    let (orbit, kick) = units[0].split_once('/').unwrap_or((&units[0], ""));
    let unit = match orbit {
        "m" | "meter" | "meters" => OrbitUnit::Metres,
        "mm" | "millimeter" | "millimeters" => OrbitUnit::Millimetres,
        "um" | "micron" | "microns" | "micrometer" => OrbitUnit::Micrometres,
        _ => {
            return Err(
                all.wrong(&format!("UnitsString: expected m, mm or um over the unit of a kick, found {}", units[0]))
            );
        }
    };
    // what an ampere deflects by stands elsewhere
    let kick = match kick {
        "rad" | "radian" | "radians" => Some(1e3),
        "mrad" | "milliradian" | "milliradians" => Some(1.0),
        "urad" | "microradian" | "microradians" => Some(1e-3),
        _ => None,
    };
    Ok(Stated { unit: Some(unit), kick, kick_is: Some(KickIs::Full), order: Some(Order::Planes) })
}

/// `mm/radian`, in small letters.
fn units(all: &Place, block: usize) -> Result<String, MeasuredError> {
    let text = |place: Option<Place>| place.and_then(|one| one.text().map(str::to_lowercase));
    let of = |field| all.need_of(block, field).map(|one| text(one.field("UnitsString")).unwrap_or_default());
    match text(all.field_of(block, "UnitsString")) {
        Some(units) => Ok(units),
        None => Ok(format!("{}/{}", of("Monitor")?, of("Actuator")?)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::import::mat::MatFile;

    /// Two monitors of x and one of y, one corrector of H and two of V; x to V was not measured.
    fn file(units: &str) -> MatFile {
        let numbers = |shape: [usize; 2], values: &[f64]| Mat::Numbers(shape.to_vec(), values.to_vec());
        let of_units =
            |units: &str| Mat::Structs(vec![1, 1], vec!["UnitsString".into()], vec![vec![Mat::Text(units.into())]]);
        let block = |data: Mat| {
            vec![data, of_units("mm"), of_units("Ampere"), numbers([1, 1], &[1e-5]), Mat::Text(units.into())]
        };
        // column by column: (1,1), (2,1), (1,2), (2,2)
        let blocks = [
            numbers([2, 1], &[1.0, 2.0]),
            numbers([1, 1], &[f64::NAN]),
            numbers([0, 0], &[]),
            numbers([1, 2], &[5.0, 6.0]),
        ];
        let names = ["Data", "Monitor", "Actuator", "ActuatorDelta", "UnitsString"].map(str::to_owned).to_vec();
        let all = Mat::Structs(vec![2, 2], names, blocks.map(block).to_vec());
        MatFile {
            file: "resp.mat".into(),
            variables: vec![("DCCT".into(), numbers([1, 1], &[500.0])), ("Rmat".into(), all)],
        }
    }

    #[test]
    fn blocks_are_put_together_and_their_units_are_known() {
        for name in [Some("Rmat"), None] {
            let (matrix, stated) = file("mm/Radian").matrix(name).unwrap();
            assert_eq!(matrix.width, 3);
            let nan = f64::NAN;
            let expected = [1.0, nan, nan, 2.0, nan, nan, nan, 5.0, 6.0];
            assert!(matrix.values.iter().zip(expected).all(|(found, expected)| found.to_bits() == expected.to_bits()));
            assert_eq!(
                (stated.unit, stated.kick, stated.order),
                (Some(OrbitUnit::Millimetres), Some(1e3), Some(Order::Planes))
            );
        }
        // empty text is no text: those of monitor and actuator
        let (_, stated) = file("").matrix(None).unwrap();
        assert_eq!((stated.unit, stated.kick), (Some(OrbitUnit::Millimetres), None));
        let said = file("V/Ampere").matrix(None).unwrap_err().to_string();
        assert_eq!(said, "resp.mat: Rmat: UnitsString: expected m, mm or um over the unit of a kick, found v/ampere");
        let of_other = file("mm/Radian").matrix(Some("DCCT")).unwrap();
        assert_eq!((of_other.0.values, of_other.1), (vec![500.0], Stated::default()));
    }
}
