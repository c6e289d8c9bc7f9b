//! `frames.csv`: one machine cycle a row. Lines are split by hand: a cell is a name or a number, never quoted, and a line
//! number in an error is then exactly that of the file.

use std::path::Path;

use twin::Ring;
use twin::limits::{Budget, MEMORY};

use super::columns::Columns;
use super::error::{Part, Place, RecordingError};
use super::header::{Format, Header};
use super::limit::{
    FINITE, Limit, NO_SETTING, NOT_NEGATIVE, POSITION, POSITIVE, RF_OFFSET, TUNE, from_milli, in_milli,
};
use super::names::Names;

/// Share of a frame's readings, and their number at least, that are alike without a beam: some monitors are stuck at another number.
const NEARLY: f64 = 0.8;
const FEWEST: usize = 4;

/// What a row, and a cell of it, take in memory [B].
const ROW: u64 = size_of::<Row>() as u64;
const CELL: u64 = size_of::<Option<f64>>() as u64;

/// One machine cycle.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// Cycle counter, rising; a gap is a lost cycle.
    pub sequence: u32,
    /// Time since the campaign began, rising [s].
    pub time: f64,
    /// Time in the cycle at which the orbit was read, 0 where it is not recorded [s].
    pub cycle_time: f64,
    /// The correctors that were set, by index, and their settings [A].
    pub correctors: Vec<(usize, f64)>,
    /// Relative RF frequency offset `df/f` [1].
    pub rf_offset: f64,
    /// Read-back of the main dipoles, positive; none where it is not recorded [A].
    pub dipole: Option<f64>,
    /// Read-backs of the quadrupole supplies, positive [F] [A].
    pub supply: Vec<f64>,
    /// Read-backs of what else is recorded, in the order of [`super::Recording::other`] [A].
    pub other: Vec<f64>,
    /// Corrector read-backs [C] [A].
    pub corrector_current: Vec<f64>,
    /// Beam positions, `None` where the monitor did not report [B] [m].
    pub reading: Vec<Option<f64>>,
    /// Intensity of the beam, `None` where it is not recorded, in a unit of the recording's own.
    pub intensity: Option<f64>,
    /// Fractional tunes x and y, `None` where the meter did not report [1].
    pub tune: [Option<f64>; 2],
}

impl Row {
    /// The setting of a corrector, if it was set [A].
    pub fn setting(&self, corrector: usize) -> Option<f64> {
        self.correctors.iter().find(|(c, _)| *c == corrector).map(|(_, setting)| *setting)
    }

    /// True where nearly all monitors read one and the same number, as their electronics do without a beam: readings of a beam differ.
    pub fn is_without_beam(&self) -> bool {
        let mut read: Vec<u64> = self.reading.iter().flatten().map(|position| position.to_bits()).collect();
        read.sort_unstable();
        let most = read.chunk_by(|one, other| one == other).map(<[u64]>::len).max().unwrap_or(0);
        most >= FEWEST && most as f64 > NEARLY * read.len() as f64
    }
}

/// All rows, and the columns of other currents.
pub(super) fn parse(
    file: &Path,
    text: &str,
    header: &Header,
    ring: &Ring,
    names: &Names,
) -> Result<(Vec<Row>, Vec<String>), RecordingError> {
    if text.trim().is_empty() {
        let at = Place::new(file, 1, Part::Whole);
        return Err(RecordingError::NoFrames(at.mismatch("columns and frames", "an empty file")));
    }
    let mut lines = text.lines();
    let columns = Columns::parse(file, lines.next().unwrap_or_default(), header, ring, names)?;
    let mut rows: Vec<Row> = Vec::new();
    let memory = Budget::new(MEMORY);
    for (index, line) in lines.enumerate() {
        let cells = Cells::split(file, 2 + index, &columns, line)?;
        memory
            .take(ROW + CELL * cells.cells.len() as u64)
            .map_err(|exceeded| RecordingError::TooLarge(Place::new(file, 2 + index, Part::Whole), exceeded))?;
        let row = cells.row(header, names, rows.last())?;
        rows.push(row);
    }
    if rows.is_empty() {
        let at = Place::new(file, 1, Part::Whole);
        return Err(RecordingError::NoFrames(at.mismatch("frames below the columns", "none")));
    }
    let other = columns.other.iter().map(|&column| columns.names[column].clone()).collect();
    Ok((rows, other))
}

/// The cells of one line.
struct Cells<'a> {
    file: &'a Path,
    line: usize,
    columns: &'a Columns,
    cells: Vec<&'a str>,
}

impl<'a> Cells<'a> {
    fn split(file: &'a Path, line: usize, columns: &'a Columns, text: &'a str) -> Result<Self, RecordingError> {
        let cells: Vec<&str> = text.split(',').collect();
        let (expected, found) = (columns.names.len(), cells.len());
        if found != expected {
            let at = Place::new(file, line, Part::Whole);
            return Err(RecordingError::CellCount(at.mismatch(format!("{expected} cells"), found)));
        }
        Ok(Self { file, line, columns, cells })
    }

    /// One row; the fields stand in the order of format 1's columns, so that its first fault is the one reported.
    fn row(&self, header: &Header, names: &Names, previous: Option<&Row>) -> Result<Row, RecordingError> {
        let (at, format) = (self.columns, header.format);
        let sequence = self.take(at.sequence, "a whole number from 0 to 4294967295", |cell| cell.parse().ok())?;
        self.rising(at.sequence, previous.map(|row| f64::from(row.sequence)), f64::from(sequence))?;
        let time = self.number(at.time, FINITE)?;
        self.rising(at.time, previous.map(|row| row.time), time)?;
        Ok(Row {
            sequence,
            time,
            cycle_time: at.cycle_time.map_or(Ok(0.0), |column| self.cycle_time(column, header))?,
            correctors: at.set.map_or(Ok(Vec::new()), |columns| self.set(columns, format, names))?,
            rf_offset: at.rf_offset.map_or(Ok(0.0), |column| self.number(column, RF_OFFSET))?,
            dipole: at.dipole.map(|column| self.number(column, POSITIVE)).transpose()?,
            supply: at.supply.iter().map(|sum| self.sum(sum)).collect::<Result<_, _>>()?,
            other: self.each(&at.other, |column| self.number(column, FINITE))?,
            corrector_current: self.each(&at.corrector_current, |column| self.number(column, FINITE))?,
            reading: self.each(&at.reading, |column| Ok(self.optional(column, POSITION)?.map(from_milli)))?,
            intensity: self.maybe(at.intensity, NOT_NEGATIVE)?,
            tune: [self.maybe(at.tune[0], TUNE)?, self.maybe(at.tune[1], TUNE)?],
        })
    }

    /// A time in the cycle, which a ramp has to know.
    fn cycle_time(&self, column: usize, header: &Header) -> Result<f64, RecordingError> {
        let Some([first, last]) = header.ramp.span() else { return self.number(column, FINITE).map(from_milli) };
        let words = format!("a time of the ramp, from {} to {} ms", in_milli(first), in_milli(last));
        let within = |cell: &str| FINITE.parse(cell).map(from_milli).filter(|time| (first..=last).contains(time));
        self.take(column, &words, within)
    }

    /// The correctors that were set and their settings; format 2 joins several by `;`.
    fn set(&self, columns: (usize, usize), format: Format, names: &Names) -> Result<Vec<(usize, f64)>, RecordingError> {
        let known = |cell: &str| match (cell, format) {
            ("", _) => Some(Vec::new()),
            (cell, Format::One) => names.corrector(cell).map(|c| vec![c]),
            (cell, Format::Two) => cell.split(';').map(|name| names.corrector(name)).collect(),
        };
        let once = |set: &Vec<usize>| set.iter().enumerate().all(|(i, c)| !set[..i].contains(c));
        let words = match format {
            Format::One => "a corrector of the machine or nothing",
            Format::Two => "correctors of the machine, each once and joined by `;`, or nothing",
        };
        let correctors = self.take(columns.0, words, |cell| known(cell).filter(once))?;
        if correctors.is_empty() {
            let empty = format == Format::Two && self.cells[columns.1].is_empty();
            return if empty { Ok(Vec::new()) } else { self.number(columns.1, NO_SETTING).map(|_| Vec::new()) };
        }
        let words = match correctors.len() {
            1 => FINITE.words.to_owned(),
            several => format!("{several} finite numbers joined by `;`"),
        };
        let settings = self.take(columns.1, &words, |cell| {
            let settings: Option<Vec<f64>> = cell.split(';').map(|number| FINITE.parse(number)).collect();
            settings.filter(|settings| settings.len() == correctors.len())
        })?;
        Ok(correctors.into_iter().zip(settings).collect())
    }

    fn each<T>(
        &self,
        columns: &[usize],
        read: impl Fn(usize) -> Result<T, RecordingError>,
    ) -> Result<Vec<T>, RecordingError> {
        columns.iter().map(|&column| read(column)).collect()
    }

    /// A current that is read back as a weighted sum, or by itself; a trim may be negative, the sum may not.
    fn sum(&self, columns: &[(usize, f64)]) -> Result<f64, RecordingError> {
        if let [(column, 1.0)] = columns {
            return self.number(*column, POSITIVE);
        }
        let shares = columns.iter().map(|(column, weight)| Ok(weight * self.number(*column, FINITE)?));
        let sum: f64 = shares.sum::<Result<_, RecordingError>>()?;
        let place = || self.place(columns[0].0);
        POSITIVE.check(sum).ok_or_else(|| RecordingError::Cell(place().mismatch("a sum of read-backs above 0 A", sum)))
    }

    fn number(&self, column: usize, limit: Limit) -> Result<f64, RecordingError> {
        self.take(column, limit.words, |cell| limit.parse(cell))
    }

    /// A number, or `None` for the empty cell of an instrument that did not report.
    fn optional(&self, column: usize, limit: Limit) -> Result<Option<f64>, RecordingError> {
        self.take(column, limit.words, |cell| match cell {
            "" => Some(None),
            cell => limit.parse(cell).map(Some),
        })
    }

    /// The same of a column that need not be there.
    fn maybe(&self, column: Option<usize>, limit: Limit) -> Result<Option<f64>, RecordingError> {
        column.map_or(Ok(None), |column| self.optional(column, limit))
    }

    /// A cell's value, where `parse` accepts its text.
    fn take<T>(
        &self,
        column: usize,
        expected: &str,
        parse: impl FnOnce(&str) -> Option<T>,
    ) -> Result<T, RecordingError> {
        let cell = self.cells[column];
        parse(cell).ok_or_else(|| {
            let found = if cell.is_empty() { "an empty cell".into() } else { format!("{cell:?}") };
            RecordingError::Cell(self.place(column).mismatch(expected, found))
        })
    }

    /// Refuses a value that is not above that of the line before.
    fn rising(&self, column: usize, previous: Option<f64>, found: f64) -> Result<(), RecordingError> {
        match previous.filter(|previous| found <= *previous) {
            Some(previous) => {
                let expected = format!("more than the {previous} of the line before");
                Err(RecordingError::Order(self.place(column).mismatch(expected, found)))
            }
            None => Ok(()),
        }
    }

    fn place(&self, column: usize) -> Place {
        Place::new(self.file, self.line, Part::Column(self.columns.names[column].clone()))
    }
}
