//! A recording as its two files, in format 2.

use std::fs;
use std::path::Path;

use csv::Writer;
use twin::Ring;

use super::columns::supply_column;
use super::error::RecordingError;
use super::limit::in_milli;
use super::names::Names;
use super::{FRAMES, HEADER, Recording, Row};

impl Recording {
    /// Write `header.toml` and `frames.csv` of a campaign of this ring into a folder, which is made where there is none.
    ///
    /// # Errors
    /// [`RecordingError::Unwritable`].
    ///
    /// # Panics
    /// If the recording is not of this ring.
    pub fn write(&self, folder: &Path, ring: &Ring) -> Result<(), RecordingError> {
        let [header, frames] = self.texts(ring);
        let write = |file: &Path, content: &[u8]| {
            fs::write(file, content).map_err(|error| RecordingError::Unwritable(file.into(), error.kind()))
        };
        fs::create_dir_all(folder).map_err(|error| RecordingError::Unwritable(folder.into(), error.kind()))?;
        write(&folder.join(HEADER), header.as_bytes())?;
        write(&folder.join(FRAMES), frames.as_bytes())
    }

    /// The texts of `header.toml` and `frames.csv`.
    ///
    /// # Panics
    /// If the recording is not of this ring.
    pub fn texts(&self, ring: &Ring) -> [String; 2] {
        let names = Names::from_ring(&self.powered(ring));
        let frames = String::from_utf8(self.frames(&names)).expect("names and numbers are text");
        [self.header.text(&names), frames]
    }

    fn frames(&self, names: &Names) -> Vec<u8> {
        let mut rows = Writer::from_writer(Vec::new());
        let in_memory = "memory takes all that is written";
        rows.write_record(self.columns(names)).expect(in_memory);
        self.rows.iter().for_each(|row| rows.write_record(self.cells(row, names)).expect(in_memory));
        rows.into_inner().expect(in_memory)
    }

    fn columns(&self, names: &Names) -> Vec<String> {
        let mut columns: Vec<String> =
            ["seq", "time_s", "t_cycle_ms", "corrector", "setting_A", "drf_rel"].map(String::from).into();
        columns.extend(self.header.nominal_dipole.map(|_| "i_dipole_A".into()));
        columns.extend(names.supplies.iter().map(|supply| supply_column(supply)));
        columns.extend(self.other.iter().cloned());
        columns.extend((0..names.correctors.len()).map(|c| names.corrector_column(c)));
        columns.extend((0..names.monitors.len()).map(|b| names.monitor_column(b)));
        columns.extend(["intensity", "qx_frac", "qy_frac"].map(String::from));
        columns
    }

    /// The cells of a row, in the order of the columns.
    fn cells(&self, row: &Row, names: &Names) -> Vec<String> {
        let joined = |parts: Vec<String>| parts.join(";");
        let number = |value: &f64| value.to_string();
        let optional = |value: Option<f64>| value.map_or(String::new(), |value| value.to_string());
        let mut cells = vec![
            row.sequence.to_string(),
            row.time.to_string(),
            in_milli(row.cycle_time).to_string(),
            joined(row.correctors.iter().map(|(c, _)| names.correctors[*c].clone()).collect()),
            joined(row.correctors.iter().map(|(_, setting)| setting.to_string()).collect()),
            row.rf_offset.to_string(),
        ];
        cells.extend(row.dipole.iter().map(number));
        cells.extend(row.supply.iter().map(number));
        cells.extend(row.other.iter().map(number));
        cells.extend(row.corrector_current.iter().map(number));
        cells.extend(row.reading.iter().map(|reading| optional(reading.map(in_milli))));
        cells.extend([row.intensity, row.tune[0], row.tune[1]].map(optional));
        cells
    }
}
