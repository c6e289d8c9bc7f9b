//! A response matrix of pyAML (Python Accelerator Middle Layer): its `OrbitResponseMatrixData`, saved as JSON or YAML.
//!
//! | field | holds |
//! |---|---|
//! | `matrix` | lists of numbers, one an observable [m/rad] |
//! | `observable_names`, `observable_planes` | names of the lines and their planes, `H` or `V` |
//! | `variable_names`, `variable_planes` | the same of the columns |
//! | `rf_response` | change of the orbit over that of the RF frequency [m/Hz], one an observable: `FILE:rf_response`, of a step of 1 Hz |
//!
//! Source: pyAML 0.3, `pyaml.tuning_tools.orbit_response_matrix_data`.

use serde_json::Value;

use super::fields::Fields;
use super::stated::{KickIs, OrbitUnit, Stated};
use super::table::Table;
use measured::MeasuredError;

/// The lines' names, by which such a file is known.
const LINES: &str = "observable_names";
/// The list that is a column of its own.
const RF: &str = "rf_response";

/// True of text that has its fields, JSON or YAML.
pub(super) fn is_one(text: &str) -> bool {
    text.contains(LINES)
}

/// The matrix of a document, or the column of a name.
///
/// # Errors
/// [`MeasuredError::Table`].
pub(super) fn read(file: &str, value: &Value, column: Option<&str>) -> Result<Table, MeasuredError> {
    let fields = Fields { file, name: "OrbitResponseMatrixData", value };
    let lines = names(&fields, LINES, "observable_planes")?;
    let Some(lines) = lines else { return Err(fields.wrong(format!("{LINES}: expected names"))) };
    let stated = Stated { unit: Some(OrbitUnit::Metres), ..Stated::default() };
    let (stated, head, rows) = match column {
        None => {
            let rows =
                list(&fields, "matrix")?.iter().map(|row| numbers(&fields, "matrix", row)).collect::<Result<_, _>>()?;
            let stated = Stated { kick: Some(1e3), kick_is: Some(KickIs::Full), ..stated };
            (stated, names(&fields, "variable_names", "variable_planes")?, rows)
        }
        Some(RF) => {
            let column = numbers(&fields, RF, value.get(RF).unwrap_or(&Value::Null))?;
            (stated, None, column.into_iter().map(|one| vec![one]).collect::<Vec<Vec<f64>>>())
        }
        Some(other) => return Err(fields.wrong(format!("no column {other}; expected {RF}, or none for the matrix"))),
    };
    if rows.len() != lines.len() {
        return Err(fields.wrong(format!("{} lines of numbers, {} {LINES}", rows.len(), lines.len())));
    }
    Table::named(file, stated, head, lines.into_iter().map(Some).zip(rows).collect())
}

/// Names with their planes in front, where the file has both.
fn names(fields: &Fields, names: &str, planes: &str) -> Result<Option<Vec<String>>, MeasuredError> {
    let is_there = |key: &str| fields.value.get(key).is_some_and(|value| !value.is_null());
    if !is_there(names) {
        return Ok(None);
    }
    let text = |key: &str| {
        let wrong = |value: &Value| fields.wrong(format!("{key}: expected text, found {value}"));
        list(fields, key)?.iter().map(|value| value.as_str().ok_or_else(|| wrong(value))).collect::<Result<Vec<_>, _>>()
    };
    let all = text(names)?;
    if !is_there(planes) {
        return Ok(Some(all.into_iter().map(str::to_owned).collect()));
    }
    let of = text(planes)?;
    if of.len() != all.len() {
        return Err(fields.wrong(format!("{} {names}, {} {planes}", all.len(), of.len())));
    }
    let named = all.iter().zip(of).map(|(name, plane)| match plane {
        "H" | "X" | "h" | "x" => Ok(format!("x:{name}")),
        "V" | "Y" | "v" | "y" => Ok(format!("y:{name}")),
        other => Err(fields.wrong(format!("{planes}: expected H or V, found {other}"))),
    });
    named.collect::<Result<_, _>>().map(Some)
}

fn list<'a>(fields: &Fields<'a>, key: &str) -> Result<&'a Vec<Value>, MeasuredError> {
    let value = fields.value.get(key).unwrap_or(&Value::Null);
    value.as_array().ok_or_else(|| fields.wrong(format!("{key}: expected a list")))
}

/// Numbers; null, which NaN becomes, was not measured.
fn numbers(fields: &Fields, key: &str, row: &Value) -> Result<Vec<f64>, MeasuredError> {
    let Some(row) = row.as_array() else { return Err(fields.wrong(format!("{key}: expected a list of numbers"))) };
    let number = |value: &Value| match value {
        Value::Null => Ok(f64::NAN),
        value => value.as_f64().ok_or_else(|| fields.wrong(format!("{key}: expected a number, found {value}"))),
    };
    row.iter().map(number).collect()
}
