//! A CSV row for each estimate; the file appears whole or not at all.

use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

use crate::output;
use crate::record::EstimateRecord;

/// Why a trace was not written.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {reason}")]
pub struct TraceError {
    path: String,
    reason: String,
}

/// A trace being written.
#[derive(Debug)]
pub struct Trace {
    path: PathBuf,
    rows: csv::Writer<NamedTempFile>,
}

impl Trace {
    /// Start one beside its final place. Columns: `seq`, mean and sigma of every var, `nis`, `rejected`.
    ///
    /// # Errors
    /// [`TraceError`].
    pub fn create(path: &Path, vars: &[String]) -> Result<Self, TraceError> {
        let file = output::temporary(path).map_err(|error| wrong(path, &error))?;
        let mut rows = csv::Writer::from_writer(file);
        let columns = vars.iter().flat_map(|var| [format!("{var}_mean"), format!("{var}_sigma")]);
        let header = core::iter::once("seq".into()).chain(columns).chain(["nis".into(), "rejected".into()]);
        rows.write_record(header.collect::<Vec<String>>()).map_err(|error| wrong(path, &error))?;
        Ok(Self { path: path.into(), rows })
    }

    /// Add an estimate. Numbers are as short as they can be and still read back the same.
    ///
    /// # Errors
    /// [`TraceError`].
    pub fn add(&mut self, record: &EstimateRecord) -> Result<(), TraceError> {
        let vars =
            record.mean.iter().zip(&record.sigma).flat_map(|(mean, sigma)| [mean.to_string(), sigma.to_string()]);
        let rest = [record.nis.to_string(), record.rejected.count_ones().to_string()];
        let row = core::iter::once(record.sequence.to_string()).chain(vars).chain(rest);
        self.rows.write_record(row.collect::<Vec<String>>()).map_err(|error| wrong(&self.path, &error))
    }

    /// Put the file in its place.
    ///
    /// # Errors
    /// [`TraceError`].
    pub fn finish(self) -> Result<(), TraceError> {
        let file = self.rows.into_inner().map_err(|error| wrong(&self.path, error.error()))?;
        file.persist(&self.path).map_err(|error| wrong(&self.path, &error))?;
        Ok(())
    }
}

fn wrong(path: &Path, error: &dyn core::fmt::Display) -> TraceError {
    TraceError { path: path.display().to_string(), reason: error.to_string() }
}
