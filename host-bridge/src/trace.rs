//! Estimates as a CSV file, one row a frame: `seq`, mean and sigma of every var, `nis`, `rejected`.

use std::io::BufWriter;
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

use crate::output;
use crate::record::{EstimateRecord, VARS};

/// Why a trace was not written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TraceError {
    /// The file cannot be written.
    #[error("{path}: {reason}")]
    Write {
        /// The file.
        path: String,
        /// Why.
        reason: String,
    },
    /// There is not one name for each var.
    #[error("{path}: {found} names of vars; an estimate has {VARS}")]
    Names {
        /// The file.
        path: String,
        /// How many there are.
        found: usize,
    },
}

/// A trace in the making. The file appears whole with [`Trace::finish`], or not at all.
pub struct Trace {
    path: PathBuf,
    rows: csv::Writer<BufWriter<NamedTempFile>>,
}

impl Trace {
    /// Begin a trace with its header; the rows wait in a file beside the final one.
    ///
    /// # Errors
    /// [`TraceError`].
    pub fn create(path: &Path, var_names: &[String]) -> Result<Self, TraceError> {
        if var_names.len() != VARS {
            return Err(TraceError::Names { path: path.display().to_string(), found: var_names.len() });
        }
        let file = output::temporary(path).map_err(|e| wrong(path, &e))?;
        let mut trace = Self { path: path.to_owned(), rows: csv::Writer::from_writer(BufWriter::new(file)) };
        let vars = var_names.iter().flat_map(|name| [format!("{name}_mean"), format!("{name}_sigma")]);
        trace.row(core::iter::once("seq".to_owned()).chain(vars).chain(["nis".to_owned(), "rejected".to_owned()]))?;
        Ok(trace)
    }

    /// Add a row. A number is printed as briefly as reads back to the same `f32`.
    ///
    /// # Errors
    /// [`TraceError::Write`].
    pub fn add(&mut self, record: &EstimateRecord) -> Result<(), TraceError> {
        let vars =
            record.mean.iter().zip(&record.sigma).flat_map(|(mean, sigma)| [mean.to_string(), sigma.to_string()]);
        let last = [record.nis.to_string(), record.rejected.count_ones().to_string()];
        self.row(core::iter::once(record.sequence.to_string()).chain(vars).chain(last))
    }

    fn row(&mut self, fields: impl Iterator<Item = String>) -> Result<(), TraceError> {
        self.rows.write_record(fields.map(String::into_bytes)).map_err(|e| wrong(&self.path, &e))
    }

    /// Put the file in its place; one of that name is replaced.
    ///
    /// # Errors
    /// [`TraceError::Write`]; a file of that name is then as it was.
    pub fn finish(self) -> Result<(), TraceError> {
        let Self { path, rows } = self;
        let rows = rows.into_inner().map_err(|e| wrong(&path, e.error()))?;
        let file = rows.into_inner().map_err(|e| wrong(&path, e.error()))?;
        file.persist(&path).map_err(|e| wrong(&path, &e.error))?;
        Ok(())
    }
}

fn wrong(path: &Path, reason: &dyn core::fmt::Display) -> TraceError {
    TraceError::Write { path: path.display().to_string(), reason: reason.to_string() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names() -> Vec<String> {
        (0..VARS).map(|i| format!("V{i}")).collect()
    }

    #[test]
    fn numbers_read_back_to_the_same_bits() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("trace.csv");
        let mut record = EstimateRecord { sequence: 4, rejected: 0b101, nis: 33.3, ..EstimateRecord::ZERO };
        let mut bits = 0x3f80_0001_u32; // 1 + one step, then scattered over all exponents
        for value in record.mean.iter_mut().chain(&mut record.sigma) {
            *value = f32::from_bits(bits & 0x7f7f_ffff);
            bits = bits.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        }
        let mut trace = Trace::create(&path, &names()).unwrap();
        trace.add(&record).unwrap();
        trace.finish().unwrap();
        let mut reader = csv::Reader::from_path(&path).unwrap();
        assert_eq!(reader.headers().unwrap().iter().take(3).collect::<Vec<_>>(), ["seq", "V0_mean", "V0_sigma"]);
        let row: Vec<f32> = reader.records().next().unwrap().unwrap().iter().map(|f| f.parse().unwrap()).collect();
        assert_eq!((row.len(), row[0], row[97], row[98]), (99, 4.0, 33.3, 2.0));
        for i in 0..VARS {
            assert_eq!(
                [row[1 + 2 * i], row[2 + 2 * i]].map(f32::to_bits),
                [record.mean[i], record.sigma[i]].map(f32::to_bits)
            );
        }
    }

    #[test]
    fn an_unfinished_trace_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let mut trace = Trace::create(&folder.path().join("trace.csv"), &names()).unwrap();
        trace.add(&EstimateRecord::ZERO).unwrap();
        drop(trace);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn errors_name_the_file() {
        let error = Trace::create(Path::new("/nonexistent/a.csv"), &names()).err().unwrap().to_string();
        assert_eq!(error, "/nonexistent/a.csv: entity not found");
        let error = Trace::create(Path::new("a.csv"), &names()[..15]).err().unwrap().to_string();
        assert_eq!(error, "a.csv: 15 names of vars; an estimate has 48");
    }
}
