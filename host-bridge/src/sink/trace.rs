//! Estimates as a CSV file, one row a frame: `seq`, mean and sigma of every var, `nis`, `rejected` readings, and the remarks on the
//! frame: 1 where they are made, the name of the var that has stepped.

use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use estimator::Remarks;
use results::output::{self, OutputError};
use results::{EstimateRecord, Names, ReadingUse};
use tempfile::NamedTempFile;

use super::{Sink, SinkError};

/// Why a trace was not written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TraceError {
    /// The file cannot be written.
    #[error(transparent)]
    Write(#[from] OutputError),
    /// An estimate is not of the vars whose columns the trace has.
    #[error("{path}: an estimate of {found}; the columns are those of {columns}")]
    Ring {
        /// The file.
        path: String,
        /// The machine that the trace began with.
        columns: String,
        /// The machine of the estimate.
        found: String,
    },
}

/// Columns after those of the vars.
const LAST: [&str; 6] = ["nis", "rejected", "put_aside", "baselines_moved", "unsolved", "stepped"];

/// A trace in the making. The file appears whole with [`Sink::finish`], or not at all.
pub struct Trace {
    path: PathBuf,
    rows: csv::Writer<BufWriter<NamedTempFile>>,
    /// What the columns are of; the first estimate says so.
    names: Option<Arc<Names>>,
}

impl Trace {
    /// Begin a trace; the rows wait in a file beside the final one.
    ///
    /// # Errors
    /// [`TraceError::Write`].
    pub fn create(path: &Path) -> Result<Self, TraceError> {
        let file = output::temporary(path)?;
        Ok(Self { path: path.to_owned(), rows: csv::Writer::from_writer(BufWriter::new(file)), names: None })
    }

    /// Write the line of columns.
    fn begin(&mut self, vars: &[String]) -> Result<(), TraceError> {
        let vars = vars.iter().flat_map(|name| [format!("{name}_mean"), format!("{name}_sigma")]);
        self.row(core::iter::once("seq".to_owned()).chain(vars).chain(LAST.map(str::to_owned)))
    }

    /// Write the line of columns before the first row, and see that the others are of the same vars.
    fn check(&mut self, names: &Arc<Names>) -> Result<(), TraceError> {
        match &self.names {
            None => {
                self.names = Some(names.clone());
                self.begin(&names.vars)
            }
            Some(columns) if columns.vars != names.vars => Err(TraceError::Ring {
                path: self.path.display().to_string(),
                columns: columns.machine.clone(),
                found: names.machine.clone(),
            }),
            Some(_) => Ok(()),
        }
    }

    /// Add a row. A number is printed as briefly as reads back to the same `f32`.
    ///
    /// # Errors
    /// [`TraceError`].
    pub fn add(&mut self, record: &EstimateRecord) -> Result<(), TraceError> {
        self.check(&record.names)?;
        let vars =
            record.mean.iter().zip(&record.sigma).flat_map(|(mean, sigma)| [mean.to_string(), sigma.to_string()]);
        let Remarks { put_aside, baselines_moved, unsolved, let_loose, slices: _ } = record.remarks;
        let remarks = [put_aside, baselines_moved, unsolved].map(|said| u8::from(said).to_string());
        let stepped =
            let_loose.and_then(|param| record.names.vars.get(usize::from(param))).cloned().unwrap_or_default();
        let last = [record.nis.to_string(), record.readings(ReadingUse::Rejected).to_string()];
        self.row(core::iter::once(record.sequence.to_string()).chain(vars).chain(last).chain(remarks).chain([stepped]))
    }

    fn row(&mut self, fields: impl Iterator<Item = String>) -> Result<(), TraceError> {
        self.rows.write_record(fields.map(String::into_bytes)).map_err(|e| wrong(&self.path, &e))
    }

    /// Put the file in its place; one of that name is replaced. Without an estimate it has the columns of no var.
    ///
    /// # Errors
    /// [`TraceError::Write`]; a file of that name is then as it was.
    pub fn save(mut self) -> Result<(), TraceError> {
        if self.names.is_none() {
            self.begin(&[])?;
        }
        let Self { path, rows, .. } = self;
        let rows = rows.into_inner().map_err(|e| wrong(&path, e.error()))?;
        let file = rows.into_inner().map_err(|e| wrong(&path, e.error()))?;
        file.persist(&path).map_err(|e| wrong(&path, &e.error))?;
        Ok(())
    }
}

impl Sink for Trace {
    fn take(&mut self, record: &EstimateRecord) -> Result<(), SinkError> {
        Ok(self.add(record)?)
    }

    fn finish(self: Box<Self>) -> Result<(), SinkError> {
        Ok(self.save()?)
    }
}

fn wrong(path: &Path, reason: &dyn core::fmt::Display) -> TraceError {
    OutputError::of(path, reason).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_read_back_to_the_same_bits() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("trace.csv");
        let mut record = EstimateRecord { sequence: 4, nis: 33.3, ..EstimateRecord::example(48, 3) };
        record.reading = vec![ReadingUse::Rejected, ReadingUse::Used, ReadingUse::Rejected];
        record.remarks.put_aside = true;
        let mut bits = 0x3f80_0001_u32; // 1 + one step, then scattered over all exponents
        for value in record.mean.iter_mut().chain(&mut record.sigma) {
            *value = f32::from_bits(bits & 0x7f7f_ffff);
            bits = bits.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        }
        let mut trace = Trace::create(&path).unwrap();
        trace.add(&record).unwrap();
        trace.save().unwrap();
        let mut reader = csv::Reader::from_path(&path).unwrap();
        assert_eq!(reader.headers().unwrap().iter().take(3).collect::<Vec<_>>(), ["seq", "V0_mean", "V0_sigma"]);
        let row = reader.records().next().unwrap().unwrap();
        assert_eq!(row.iter().next_back(), Some(""), "no var has stepped");
        let row: Vec<f32> = row.iter().take(row.len() - 1).map(|f| f.parse().unwrap()).collect();
        assert_eq!((row.len(), row[0], row[97], row[98]), (102, 4.0, 33.3, 2.0));
        assert_eq!(row[99..], [1.0, 0.0, 0.0]);
        for i in 0..48 {
            assert_eq!(
                [row[1 + 2 * i], row[2 + 2 * i]].map(f32::to_bits),
                [record.mean[i], record.sigma[i]].map(f32::to_bits)
            );
        }
    }

    #[test]
    fn an_unfinished_trace_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let mut trace = Trace::create(&folder.path().join("trace.csv")).unwrap();
        trace.add(&EstimateRecord::example(2, 1)).unwrap();
        drop(trace);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn a_trace_of_nothing_has_its_columns() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("trace.csv");
        Trace::create(&path).unwrap().save().unwrap();
        assert_eq!(
            std::fs::read_to_string(path).unwrap(),
            "seq,nis,rejected,put_aside,baselines_moved,unsolved,stepped\n"
        );
    }

    #[test]
    fn errors_name_the_file() {
        let error = Trace::create(Path::new("/nonexistent/a.csv")).err().unwrap().to_string();
        assert_eq!(error, "/nonexistent/a.csv: folder not found");
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.csv");
        let mut trace = Trace::create(&path).unwrap();
        trace.add(&EstimateRecord::example(2, 1)).unwrap();
        let error = trace.add(&EstimateRecord::example(3, 1)).unwrap_err().to_string();
        let expected = ": an estimate of test ring; the columns are those of test ring";
        assert_eq!(error, format!("{}{expected}", path.display()));
    }
}
