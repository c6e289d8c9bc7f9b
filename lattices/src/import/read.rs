//! Files of lattices and of tables, read by the format that their content shows.

use std::path::Path;

use super::element::Lattice;
use super::hdf5::{self, Matrix};
use super::mat::MatFile;
use super::source::{Source, bytes};
use super::stated::Stated;
use super::table::Table;
use super::{at, at_mat, madx, mml, pals, pyaml, sdds, xsuite};
use measured::MeasuredError;
use twin::limits::{DEPTH, Document, ELEMENTS};

/// Nodes of YAML that an element has.
const NODES: usize = 10;

impl Lattice {
    /// Read a file of any of the formats; of a MAT-file with several lattices `FILE:VARIABLE`.
    ///
    /// # Errors
    /// [`MeasuredError::Table`]: the file is of no known format, or has an element that the twin of a measured ring cannot carry.
    pub fn read(path: &Path) -> Result<Self, MeasuredError> {
        let Source { path, name } = Source::of(path);
        let file = path.display().to_string();
        let bytes = bytes(&path)?;
        if MatFile::is_one(&bytes) {
            return at_mat::read(&MatFile::of(&file, bytes)?, name.as_deref());
        }
        let text = String::from_utf8(bytes).map_err(|_| unknown(&file, "bytes that are no text"))?;
        Self::parse(&file, &text)
    }

    /// Read the text of a file of any format that is text; `file` appears in errors.
    ///
    /// # Errors
    /// As [`Lattice::read`].
    pub fn parse(file: &str, text: &str) -> Result<Self, MeasuredError> {
        if text.trim_start().starts_with('@') {
            return madx::read(file, text);
        }
        if !text.trim_start().starts_with('{') && !text.contains("PALS:") {
            return Err(unknown(file, &first_line(text)));
        }
        let value = document(file, text)?;
        if value.get("atjson").is_some() {
            at::read(file, &value)
        } else if value.get("PALS").is_some() {
            pals::read(file, &value)
        } else if value.get("element_names").is_some() {
            xsuite::read(file, &value)
        } else {
            let keys = value.as_object().map(|map| map.keys().take(8).cloned().collect::<Vec<_>>().join(", "));
            let seen = keys.map_or_else(|| first_line(text), |keys| format!("the keys {keys}"));
            Err(unknown(file, &seen))
        }
    }
}

impl Table {
    /// Read a table of text, a dataset of an HDF5 file, `FILE.h5:/PATH` or `FILE.h5:/X,/Y` for one below the other, or a variable of a MAT-file, `FILE.mat:NAME`,
    /// whose lines and columns have no names. A response matrix of the Matlab Middle Layer needs no `NAME`. Matrices of pyAML and of SDDS have names, and say their
    /// units. An empty field or `nan` was not measured.
    ///
    /// # Errors
    /// [`MeasuredError`], with file and line.
    pub fn read(path: &Path) -> Result<Self, MeasuredError> {
        let source = Source::of(path);
        let file = source.path.display().to_string();
        let bytes = bytes(&source.path)?;
        if MatFile::is_one(&bytes) {
            let (matrix, stated) = mml::matrix(&MatFile::of(&file, bytes)?, source.name.as_deref())?;
            return Self::bare(path, matrix, stated);
        }
        if hdf5::is_one(&bytes) {
            return Self::bare(path, hdf5::matrix(&source, bytes)?, Stated::default());
        }
        if sdds::is_one(&bytes) {
            return sdds::read(&file, &bytes, source.name.as_deref());
        }
        match String::from_utf8(bytes) {
            Ok(text) if pyaml::is_one(&text) => pyaml::read(&file, &document(&file, &text)?, source.name.as_deref()),
            Ok(text) => Self::parse(&file, &text),
            Err(_) => {
                Err(MeasuredError::Table { file, problem: "expected a table of text, SDDS, HDF5 or a MAT-file".into() })
            }
        }
    }

    /// Numbers alone.
    fn bare(path: &Path, Matrix { width, values }: Matrix, stated: Stated) -> Result<Self, MeasuredError> {
        let lines = values.chunks(width.max(1)).map(|values| (None, values.to_vec())).collect();
        Self::named(&path.display().to_string(), stated, None, lines)
    }
}

/// JSON, in which Python may have written `NaN` and `Infinity` (null here), or YAML.
pub(super) fn document(file: &str, text: &str) -> Result<serde_json::Value, MeasuredError> {
    let refused = |problem: String| MeasuredError::Table { file: file.into(), problem };
    if text.trim_start().starts_with('{') {
        return json5::from_str(text).map(|Document(value)| value).map_err(|error| refused(error.to_string()));
    }
    // the library's own limits are for less than a large ring; its depth is ours
    let nodes = NODES * ELEMENTS.most as usize;
    let options = serde_saphyr::options! {
        budget: serde_saphyr::budget! {
            max_nodes: nodes, max_events: 2 * nodes, max_recorded_anchor_events: nodes / 10, max_depth: DEPTH.most as usize,
        },
        with_snippet: false,
        // null, as those of JSON
        non_finite_float_policy: serde_saphyr::options::NonFiniteFloatPolicy::PassThrough,
    };
    let document = serde_saphyr::from_str_with_options(text, options);
    document.map(|Document(value)| value).map_err(|error| refused(error.to_string()))
}

fn first_line(text: &str) -> String {
    format!("the line {:?}", text.lines().next().unwrap_or_default().chars().take(60).collect::<String>())
}

fn unknown(file: &str, seen: &str) -> MeasuredError {
    let problem = format!(
        "expected a lattice by pyAT (JSON with atjson, or a MAT-file), Xsuite (JSON with element_names), MAD-X (a table that begins with @) or in PALS, found {seen}"
    );
    MeasuredError::Table { file: file.into(), problem }
}
