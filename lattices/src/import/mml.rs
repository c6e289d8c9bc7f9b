//! A response matrix of the Matlab Middle Layer (`BPMRespMat`, `GoldenBPMResp`): a struct array of up to 2 x 2, lines the planes of the monitors, columns
//! those of the correctors.
//!
//! | field | holds |
//! |---|---|
//! | `Data` | change of the orbit over the change of the corrector's strength, rows monitors, columns correctors; empty where it was not measured |
//! | `UnitsString` | their units, `mm/Radian` or `mm/Ampere`; else those of `Monitor` and `Actuator` |
//!
//! `ActuatorDelta`, by how much a strength was changed, is divided out of `Data`: an element belongs to one unit of the strength.
//!
//! Source: `measrespmat.m` and `measbpmresp.m` of the Matlab Middle Layer.

use super::hdf5::Matrix;
use super::instruments::Order;
use super::mat::{Mat, MatFile, Place};
use super::stated::{KickIs, Stated};
use measured::MeasuredError;
use twin::limits::MEMORY;

/// Fields by which it is known.
const FIELDS: [&str; 3] = ["Data", "Monitor", "Actuator"];

/// True of such a struct array.
fn is_one(value: &Mat) -> bool {
    let Mat::Structs(shape, names, values) = value else { return false };
    !values.is_empty()
        && shape.iter().all(|one| *one <= 2)
        && shape.len() == 2
        && FIELDS.iter().all(|field| names.iter().any(|name| name == field))
}

/// The numbers of a variable as a matrix, and what the file says of them; without a name those of the only response matrix of the Matlab Middle Layer.
pub(super) fn matrix(mat: &MatFile, name: Option<&str>) -> Result<(Matrix, Stated), MeasuredError> {
    let refuse = |problem: String| MeasuredError::Table { file: mat.file.clone(), problem };
    let mut responses = mat.variables.iter().filter(|(_, value)| is_one(value)).map(|(name, _)| name.as_str());
    let only = responses.next().filter(|_| responses.next().is_none());
    let Some(name) = name.or(only) else {
        return Err(refuse(format!("name a variable, {}:NAME; it has {}", mat.file, mat.words())));
    };
    let place = mat.variable(name).ok_or_else(|| refuse(format!("no variable {name}; it has {}", mat.words())))?;
    if is_one(place.value) {
        return read(&place);
    }
    let (Some([lines, width]), values) = (place.shape(), place.numbers()?) else {
        return Err(place.expected("a matrix"));
    };
    let line = |line: usize| values.iter().skip(line).step_by(lines);
    Ok((Matrix { width, values: (0..lines).flat_map(line).copied().collect() }, Stated::default()))
}

/// Its blocks as one matrix, x before y and H before V, and what it says of them.
fn read(all: &Place) -> Result<(Matrix, Stated), MeasuredError> {
    let Mat::Structs(shape, ..) = all.value else { return Err(all.expected("a struct")) };
    let block = |row: usize, column: usize| all.field_of(row + shape[0] * column, "Data");
    // of a plane that was not measured no block has a size
    let (mut rows, mut columns) = (vec![0; shape[0]], vec![0; shape[1]]);
    for (row, column) in (0..shape[0]).flat_map(|row| (0..shape[1]).map(move |column| (row, column))) {
        let Some(data) = block(row, column) else { continue };
        let [lines, width] = data.shape().ok_or_else(|| data.expected("a matrix"))?;
        (rows[row], columns[column]) = (lines.max(rows[row]), width.max(columns[column]));
    }
    let mut matrix = Matrix { width: columns.iter().sum(), values: Vec::new() };
    let bytes = (8 * matrix.width).saturating_mul(rows.iter().sum());
    MEMORY.check(bytes as u64).map_err(|exceeded| all.wrong(&exceeded.to_string()))?;
    for (row, &lines) in rows.iter().enumerate() {
        let blocks = columns.iter().enumerate().map(|(column, &width)| match block(row, column) {
            None => Ok(vec![f64::NAN; lines * width]),
            Some(data) if data.shape() == Some([lines, width]) => Ok(data.numbers()?.to_vec()),
            Some(data) => Err(data.expected(&format!("{lines}x{width} numbers"))),
        });
        let blocks = blocks.collect::<Result<Vec<_>, _>>()?;
        for line in 0..lines {
            blocks.iter().for_each(|of| matrix.values.extend(of.iter().skip(line).step_by(lines)));
        }
    }
    Ok((matrix, stated(all)?))
}

/// The units, which all blocks must have.
fn stated(all: &Place) -> Result<Stated, MeasuredError> {
    let count = all.elements()?.len();
    let measured = (0..count).filter(|&block| all.field_of(block, "Data").is_some());
    let units = measured.map(|block| units(all, block)).collect::<Result<Vec<_>, _>>()?;
    if units.is_empty() {
        return Err(all.wrong("Data: nothing in it"));
    }
    if let Some(other) = units.iter().find(|one| **one != units[0]) {
        return Err(all.wrong(&format!("UnitsString: expected one in all blocks, found {} and {other}", units[0])));
    }
    let stated = Stated::of_units(&units[0]);
    if stated.unit.is_none() {
        let problem = format!("UnitsString: expected m, mm or um over the unit of a kick, found {}", units[0]);
        return Err(all.wrong(&problem));
    }
    Ok(Stated { kick_is: Some(KickIs::Full), order: Some(Order::Planes), ..stated })
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
    use crate::import::OrbitUnit;

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
            let (matrix, stated) = matrix(&file("mm/Radian"), name).unwrap();
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
        let (_, stated) = matrix(&file(""), None).unwrap();
        assert_eq!((stated.unit, stated.kick), (Some(OrbitUnit::Millimetres), None));
        let said = matrix(&file("V/Ampere"), None).unwrap_err().to_string();
        assert_eq!(said, "resp.mat: Rmat: UnitsString: expected m, mm or um over the unit of a kick, found v/ampere");
        let of_other = matrix(&file("mm/Radian"), Some("DCCT")).unwrap();
        assert_eq!((of_other.0.values, of_other.1), (vec![500.0], Stated::default()));
    }

    /// A machine that measured one plane has empty blocks, or one block alone; a delta may be one number a corrector.
    #[test]
    fn one_plane_is_a_matrix_too() {
        let mut file = file("mm/Radian");
        let Mat::Structs(_, _, values) = &mut file.variables[1].1 else { panic!("a struct") };
        values[3][0] = Mat::Numbers(vec![0, 0], Vec::new());
        values[1][0] = Mat::Numbers(vec![0, 0], Vec::new());
        values[0][3] = Mat::Numbers(vec![1, 1], vec![1e-5]);
        values[3][4] = Mat::Text("mm/Ampere".into());
        let (blocks, stated) = matrix(&file, None).unwrap();
        assert_eq!((blocks.width, blocks.values, stated.kick), (1, vec![1.0, 2.0], Some(1e3)));
        let Mat::Structs(shape, _, values) = &mut file.variables[1].1 else { panic!("a struct") };
        values.truncate(1);
        *shape = vec![1, 1];
        let (alone, _) = matrix(&file, None).unwrap();
        assert_eq!(alone.values, [1.0, 2.0]);
    }
}
