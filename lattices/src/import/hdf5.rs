//! Numbers of an HDF5 file, by the path of their dataset.

use hdf5_pure::{Dataset, File, Group};

use super::source::Source;
use measured::MeasuredError;
use twin::limits::{Budget, MEMORY};

/// What a number of a matrix takes in all datasets together, and in a table after that [B].
const NUMBER: u64 = 3 * size_of::<f64>() as u64;

/// A matrix by its lines.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Matrix {
    /// Numbers in a line.
    pub width: usize,
    /// All of them.
    pub values: Vec<f64>,
}

/// True where the bytes are those of such a file.
pub(super) fn is_one(bytes: &[u8]) -> bool {
    hdf5_pure::is_hdf5_bytes(bytes)
}

/// The matrix of a dataset, or of several with commas between their paths, one below the other; a list is a column.
///
/// # Errors
/// [`MeasuredError::Table`], with the datasets that there are where none is named.
pub(super) fn matrix(source: &Source, bytes: Vec<u8>) -> Result<Matrix, MeasuredError> {
    let name = source.path.display().to_string();
    let refused = |problem: String| MeasuredError::Table { file: name.clone(), problem };
    let file = File::from_bytes(bytes).map_err(|error| refused(error.to_string()))?;
    let have = || {
        let mut found = Vec::new();
        list(&file.root(), "", &mut found);
        found.join(", ")
    };
    let Some(path) = &source.name else {
        return Err(refused(format!("name a dataset, {name}:PATH; it has {}", have())));
    };
    let memory = Budget::new(MEMORY);
    let mut matrix = Matrix { width: 0, values: Vec::new() };
    for path in path.split(',') {
        let dataset =
            file.dataset(path).map_err(|error| refused(format!("{path}: {error}; the file has {}", have())))?;
        let width = match shape(&dataset).map_err(&refused)?.as_slice() {
            [_, width] => *width,
            [_] => 1,
            _ => {
                let problem = format!("{path}: expected a matrix or a list of numbers, found {}", words(&dataset));
                return Err(refused(problem));
            }
        };
        if !matrix.values.is_empty() && matrix.width != width {
            let problem = format!("{path}: {width} numbers in a line, {} in the dataset before it", matrix.width);
            return Err(refused(problem));
        }
        matrix.width = width;
        matrix
            .values
            .extend(numbers(&dataset, &memory, NUMBER).map_err(|problem| refused(format!("{path}: {problem}")))?);
    }
    Ok(matrix)
}

/// Dimensions; the last runs fastest.
pub(super) fn shape(dataset: &Dataset) -> Result<Vec<usize>, String> {
    let shape = dataset.shape().map_err(|error| error.to_string())?;
    match count(&shape) {
        u64::MAX => Err(format!("dimensions {shape:?}, whose product cannot be counted")),
        _ => Ok(shape.into_iter().map(|one| one as usize).collect()),
    }
}

fn count(shape: &[u64]) -> u64 {
    shape.iter().fold(1, |all, one| all.saturating_mul(*one))
}

/// Take the memory of a dataset, `each` an element and a chunk as it is stored: a file states both without having them.
pub(super) fn take(dataset: &Dataset, memory: &Budget, each: u64) -> Result<(), String> {
    let said = |error: hdf5_pure::Error| error.to_string();
    let stored = dataset.element_size().map_err(said)?;
    let chunk = dataset.chunk_shape().map_err(said)?.map_or(0, |chunk| count(&chunk));
    let all = count(&dataset.shape().map_err(said)?).saturating_mul(each + stored);
    memory.take(all.saturating_add(chunk.saturating_mul(stored))).map_err(|exceeded| exceeded.to_string())
}

/// All numbers of a dataset, which take `each` bytes of memory.
pub(super) fn numbers(dataset: &Dataset, memory: &Budget, each: u64) -> Result<Vec<f64>, String> {
    let count = count(&dataset.shape().map_err(|error| error.to_string())?);
    take(dataset, memory, each)?;
    let values = dataset.read_f64().map_err(|error| format!("expected numbers, found {} ({error})", words(dataset)))?;
    match values.len() as u64 {
        found if found == count => Ok(values),
        found => Err(format!("{count} numbers by its dimensions, {found} by its bytes")),
    }
}

fn words(dataset: &Dataset) -> String {
    let shape = dataset.shape().unwrap_or_default().iter().map(u64::to_string).collect::<Vec<_>>().join("x");
    let kind = dataset.dtype().map_or("data of an unknown type".into(), |kind| kind.to_string());
    if shape.is_empty() { kind } else { format!("{shape} {kind}") }
}

/// Datasets that an error lists.
const LISTED: usize = 12;

/// Paths of the first datasets, with their dimensions.
fn list(group: &Group, path: &str, found: &mut Vec<String>) {
    for name in group.datasets().unwrap_or_default().into_iter().take(LISTED - found.len()) {
        let words = group.dataset(&name).map_or_else(|error| error.to_string(), |one| words(&one));
        found.push(format!("{path}/{name} ({words})"));
    }
    if path.matches('/').count() < 4 {
        for name in group.groups().unwrap_or_default().into_iter().take(LISTED) {
            if let Ok(inner) = group.group(&name) {
                list(&inner, &format!("{path}/{name}"), found);
            }
        }
    }
}
