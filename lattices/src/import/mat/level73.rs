//! A MAT-file of level 7.3 (`save -v7.3`): an HDF5 file whose groups are structs and whose references are cells.
//!
//! The attribute `MATLAB_class` says what a dataset is. Dimensions stand in reverse order, so that the first of Matlab's runs fastest in both. A struct
//! array is a group whose fields are datasets of references, one an element. The number of an empty array is that of its dimensions.
//!
//! Source: pyAT 0.9, `at.load.matfile`, and hdf5storage 0.2, "Storage of Various Types", which describe what Matlab writes.

use hdf5_pure::{AttrValue, DType, Dataset, File, Group, Object};

use super::{Mat, NUMBER, Shape, VALUE};
use crate::import::hdf5;
use twin::limits::{Budget, DEPTH, MEMORY};

/// True of such a file: Matlab's text, then an HDF5 file behind 512 bytes.
pub(super) fn is_one(bytes: &[u8]) -> bool {
    bytes.get(512..520) == Some(b"\x89HDF\r\n\x1a\n")
}

/// Variables by name.
pub(super) fn variables(bytes: Vec<u8>) -> Result<Vec<(String, Mat)>, String> {
    let file = File::from_bytes(bytes).map_err(|error| error.to_string())?;
    let reader = Reader { memory: Budget::new(MEMORY) };
    let root = file.root();
    let mut found = Vec::new();
    // names with # hold what others refer to
    for name in names(&root)?.into_iter().filter(|name| !name.starts_with('#')) {
        let value = reader.member(&root, &name, 0).map_err(|problem| format!("{name}: {problem}"))?;
        found.push((name, value));
    }
    Ok(found)
}

fn names(group: &Group) -> Result<Vec<String>, String> {
    let both = group.datasets().and_then(|datasets| Ok([datasets, group.groups()?].concat()));
    both.map_err(|error| error.to_string())
}

/// What reads the file, and the memory that its values may take: references may form circles.
struct Reader {
    memory: Budget,
}

impl Reader {
    fn count(&self, depth: u64) -> Result<(), String> {
        DEPTH.check(depth).and_then(|()| self.memory.take(VALUE)).map_err(|exceeded| exceeded.to_string())
    }

    fn numbers(&self, dataset: &Dataset) -> Result<Vec<f64>, String> {
        hdf5::numbers(dataset, &self.memory, NUMBER)
    }

    /// What a dataset refers to.
    fn objects(&self, dataset: &Dataset) -> Result<Vec<Object>, String> {
        hdf5::take(dataset, &self.memory, OBJECT)?;
        dataset.dereference().map_err(|error| error.to_string())
    }

    fn member(&self, group: &Group, name: &str, depth: u64) -> Result<Mat, String> {
        match group.dataset(name) {
            Ok(dataset) => self.dataset(&dataset, depth),
            Err(_) => self.group(&group.group(name).map_err(|error| error.to_string())?, depth),
        }
    }

    fn object(&self, object: &Object, depth: u64) -> Result<Mat, String> {
        match object {
            Object::Dataset(dataset) => self.dataset(dataset, depth),
            Object::Group(group) => self.group(group, depth),
            _ => Ok(Mat::Other("object")),
        }
    }

    fn dataset(&self, dataset: &Dataset, depth: u64) -> Result<Mat, String> {
        self.count(depth)?;
        let attributes = dataset.attrs().map_err(|error| error.to_string())?;
        let class = attributes.get("MATLAB_class").and_then(AttrValue::as_str).unwrap_or_default();
        if attributes.contains_key("MATLAB_empty") {
            return self.empty(class, dataset);
        }
        let shape: Shape = hdf5::shape(dataset)?.into_iter().rev().collect();
        match class {
            "cell" => {
                let objects = self.objects(dataset)?;
                let values = objects.iter().map(|one| self.object(one, depth + 1)).collect::<Result<_, _>>()?;
                Ok(Mat::Cells(shape, values))
            }
            "char" => {
                let codes = self.numbers(dataset)?;
                let rows = shape.first().copied().unwrap_or(1).max(1);
                let across = (0..rows.min(codes.len())).flat_map(|row| codes.iter().skip(row).step_by(rows));
                let text = char::decode_utf16(across.map(|one| *one as u16));
                Ok(Mat::Text(text.map(|one| one.unwrap_or(char::REPLACEMENT_CHARACTER)).collect()))
            }
            "double" | "single" | "logical" | "int8" | "uint8" | "int16" | "uint16" | "int32" | "uint32" | "int64"
            | "uint64" => match dataset.dtype() {
                Ok(DType::Compound(_)) => Ok(Mat::Other("complex matrix")),
                _ => Ok(Mat::Numbers(shape, self.numbers(dataset)?)),
            },
            _ => Ok(Mat::Other("object")),
        }
    }

    /// A struct, or a struct array where all fields are references without a class.
    fn group(&self, group: &Group, depth: u64) -> Result<Mat, String> {
        self.count(depth)?;
        let names = names(group)?;
        if let Some(array) = self.array(group, &names, depth)? {
            return Ok(array);
        }
        let fields = names
            .iter()
            .map(|name| self.member(group, name, depth + 1).map_err(|problem| format!("{name}: {problem}")));
        let fields = fields.collect::<Result<Vec<_>, _>>()?;
        Ok(Mat::Structs(vec![1, 1], names, vec![fields]))
    }

    fn array(&self, group: &Group, names: &[String], depth: u64) -> Result<Option<Mat>, String> {
        let mut shape = None;
        let mut columns = Vec::new();
        for name in names {
            let Ok(dataset) = group.dataset(name) else { return Ok(None) };
            let is_reference = matches!(dataset.dtype(), Ok(DType::ObjectReference));
            if !is_reference || dataset.attrs().is_ok_and(|all| all.contains_key("MATLAB_class")) {
                return Ok(None);
            }
            let own: Shape = hdf5::shape(&dataset)?.into_iter().rev().collect();
            if *shape.get_or_insert_with(|| own.clone()) != own {
                return Err(format!("{name}: {own:?} elements, other fields have another number"));
            }
            let objects = self.objects(&dataset).map_err(|error| format!("{name}: {error}"))?;
            let values = objects.iter().map(|one| self.object(one, depth + 1));
            columns.push(values.collect::<Result<Vec<_>, _>>().map_err(|problem| format!("{name}: {problem}"))?);
        }
        let Some(shape) = shape else { return Ok(None) };
        let element = |at: usize| columns.iter().map(|column| column[at].clone()).collect();
        let values = (0..columns[0].len()).map(element).collect();
        Ok(Some(Mat::Structs(shape, names.to_vec(), values)))
    }

    /// Of an empty array the dataset holds the dimensions.
    fn empty(&self, class: &str, dataset: &Dataset) -> Result<Mat, String> {
        let shape: Shape = self.numbers(dataset)?.into_iter().map(|one| one as usize).collect();
        Ok(match class {
            "cell" => Mat::Cells(shape, Vec::new()),
            "char" => Mat::Text(String::new()),
            "struct" => Mat::Structs(shape, Vec::new(), Vec::new()),
            _ => Mat::Numbers(shape, Vec::new()),
        })
    }
}

/// What a reference takes, with the object that it names [B]; one takes microseconds to read, too.
const OBJECT: u64 = 1024;
