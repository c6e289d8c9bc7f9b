//! Campaigns on disk: `header.toml` and `frames.csv` become SI values, or one line that says what is wrong.
//!
//! The format, with a worked example, is `docs/recording.md`. Nothing is repaired or guessed: past
//! [`Recording::read`] every number is finite, in its range and in its column. Lines are split by hand: a cell is a
//! name or a number, never quoted, and a line number in an error is then exactly that of the file.

use core::fmt;
use core::ops::Range;
use serde::de::{Error as _, Unexpected};
use serde::{Deserialize, Deserializer};
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// The fixed columns, before and after those of the machine's correctors and monitors.
const FIXED: [&str; 2] =
    ["seq,time_s,t_cycle_ms,corrector,setting_A,drf_rel,i_dipole_A,i_qh_A,i_qv_A,i_sh_A,i_sv_A", "qx_frac,qy_frac"];

/// The names a recording's columns carry, in their order; they come from the machine.
#[derive(Debug, Clone, PartialEq)]
pub struct Layout {
    /// Monitors with their plane, `x_A6` [B].
    pub monitors: Vec<String>,
    /// Correctors by half-cell, `A2` [C].
    pub correctors: Vec<String>,
}

/// One campaign: what it was taken with, and one row a machine cycle.
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    /// Name of the folder.
    pub name: String,
    /// What holds for every row.
    pub header: Header,
    /// Machine cycles in the order of time; at least one.
    pub rows: Vec<Row>,
}

/// What `header.toml` says about the whole campaign.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Header {
    /// The machine's name.
    pub machine: String,
    /// File name of the machine's lattice.
    pub lattice: String,
    /// The front end or code that wrote the frames.
    pub recorded_with: String,
    /// Particle species.
    pub particle: String,
    /// Kinetic energy when the orbit is read [GeV].
    #[serde(rename = "kinetic_energy_GeV", deserialize_with = "positive")]
    pub kinetic_energy_gev: f64,
    /// Expected sigma of one reading [m].
    #[serde(rename = "bpm_sigma_mm", deserialize_with = "positive_milli")]
    pub bpm_sigma: f64,
    /// Corrector kick per current [rad/A].
    #[serde(rename = "kick_mrad_per_A", deserialize_with = "positive_milli")]
    pub kick_per_ampere: f64,
    /// How settings follow each other, in words.
    pub kick_convention: String,
    /// What the operators believe held the beam.
    pub believed_rf: BelievedRf,
    /// Supply currents at which the lattice has its design strengths.
    #[serde(rename = "nominal_A")]
    pub nominal: Nominal,
    /// Coefficients `c_n` of the quadrupole transfer function `p(r) = Σ c_n·rⁿ`, from `n = 0`, `p(1) ≠ 0` [1].
    ///
    /// `k1 = var · k1_design · p(I/I_nominal) / p(1) / (I_dipole/I_dipole_nominal)`
    #[serde(deserialize_with = "transfer")]
    pub quad_transfer: Vec<f64>,
    /// The two monitors whose mean a radial loop holds; always present where one is believed on.
    #[serde(default, deserialize_with = "pair")]
    pub radial_loop_monitors: Option<[String; 2]>,
    /// Remarks.
    #[serde(default)]
    pub note: String,
}

/// What is believed to stay constant while the correctors move.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BelievedRf {
    /// The momentum.
    FixedMomentum,
    /// The RF frequency, hence the path length.
    FixedFrequency,
    /// The mean of two horizontal monitors.
    RadialLoop,
}

/// Nominal supply currents, all positive.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Nominal {
    /// Main dipoles [A].
    #[serde(deserialize_with = "positive")]
    pub dipole: f64,
    /// Horizontally focusing quadrupoles [A].
    #[serde(deserialize_with = "positive")]
    pub qh: f64,
    /// Vertically focusing quadrupoles [A].
    #[serde(deserialize_with = "positive")]
    pub qv: f64,
}

/// Read-backs of the supplies of one cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Currents {
    /// Main dipoles, positive [A].
    pub dipole: f64,
    /// Horizontally focusing quadrupoles, positive [A].
    pub qh: f64,
    /// Vertically focusing quadrupoles, positive [A].
    pub qv: f64,
    /// Horizontal sextupoles [A].
    pub sh: f64,
    /// Vertical sextupoles [A].
    pub sv: f64,
}

/// One machine cycle.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// Cycle counter, rising; a gap is a lost cycle.
    pub sequence: u32,
    /// Time since the campaign began, rising [s].
    pub time: f64,
    /// Time in the cycle at which the orbit was read [s].
    pub cycle_time: f64,
    /// The corrector that was set, one of the layout's.
    pub corrector: Option<String>,
    /// Its setting, 0 where none is named [A].
    pub setting: f64,
    /// Relative RF frequency offset `Δf/f` [1].
    pub rf_offset: f64,
    /// Supply read-backs.
    pub currents: Currents,
    /// Corrector read-backs [C] [A].
    pub corrector_current: Vec<f64>,
    /// Beam positions, `None` where the monitor did not report [B] [m].
    pub reading: Vec<Option<f64>>,
    /// Fractional tunes x and y, `None` where the meter did not report [1].
    pub tune: [Option<f64>; 2],
}

/// Why a folder is not a recording; prints as one line.
#[non_exhaustive]
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RecordingError {
    /// The file is absent, closed to us or not text.
    #[error("{}: cannot be read as UTF-8 text: {}", .0.display(), .1)]
    Unreadable(PathBuf, ErrorKind),
    /// The header is not TOML, lacks a key, has one too many, or a value cannot be; with what TOML expected and found.
    #[error("{0}: {1}")]
    Header(Place, String),
    /// A column is nowhere in the line.
    #[error("{0}, so a column is missing")]
    MissingColumn(Mismatch),
    /// A column stood further left already.
    #[error("{0}, which is there already")]
    DuplicateColumn(Mismatch),
    /// A column belongs to another place.
    #[error("{0}, which is in the wrong place")]
    MisplacedColumn(Mismatch),
    /// A column's quantity is right, its unit is not.
    #[error("{0}, which has the wrong unit")]
    ColumnUnit(Mismatch),
    /// The machine has no such column.
    #[error("{0}, which the machine does not have")]
    UnknownColumn(Mismatch),
    /// A line has too many or too few cells.
    #[error("{0}")]
    CellCount(Mismatch),
    /// A cell is empty, not a number, out of range, or names what the machine does not have.
    #[error("{0}")]
    Cell(Mismatch),
    /// Sequence or time does not rise from one row to the next.
    #[error("{0}")]
    Order(Mismatch),
    /// There is nothing below the line of columns.
    #[error("{0}")]
    NoFrames(Mismatch),
}

/// What should stand at a place, and what does.
#[derive(Debug, Clone, PartialEq)]
pub struct Mismatch {
    /// The place.
    pub at: Place,
    /// What may stand there.
    pub expected: String,
    /// What does; text of the file is quoted, so that it stays on one line.
    pub found: String,
}

/// Where in a recording something is wrong.
#[derive(Debug, Clone, PartialEq)]
pub struct Place {
    /// Path of the file.
    pub file: PathBuf,
    /// Line in the file, from 1.
    pub line: usize,
    /// Part of that line.
    pub part: Part,
}

/// A part of a line.
#[derive(Debug, Clone, PartialEq)]
pub enum Part {
    /// All of it.
    Whole,
    /// A header key.
    Key(String),
    /// A column, by name; by number where the names disagree.
    Column(String),
}

impl Place {
    fn new(file: &Path, line: usize, part: Part) -> Self {
        Self { file: file.into(), line, part }
    }

    /// Every disagreement between a file and the format is put into words here.
    fn mismatch(self, expected: impl fmt::Display, found: impl fmt::Display) -> Mismatch {
        Mismatch { at: self, expected: expected.to_string(), found: found.to_string() }
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}, line {}", self.file.display(), self.line)?;
        match &self.part {
            Part::Whole => Ok(()),
            Part::Key(key) => write!(f, ", key {key}"),
            Part::Column(column) => write!(f, ", column {column}"),
        }
    }
}

impl fmt::Display for Mismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: expected {}, found {}", self.at, self.expected, self.found)
    }
}

impl Recording {
    /// Time of each frame within the campaign, from -1 for the first to 1 for the last.
    pub fn times(&self) -> Vec<f64> {
        let (start, end) = (self.rows.first().map_or(0.0, |r| r.time), self.rows.last().map_or(0.0, |r| r.time));
        let within = |row: &Row| if end > start { 2.0 * (row.time - start) / (end - start) - 1.0 } else { 0.0 };
        self.rows.iter().map(within).collect()
    }

    /// Kick of a corrector at the campaign's largest setting [rad]; 1 where none was set.
    pub fn nominal_kick(&self) -> f64 {
        let largest = self.rows.iter().map(|row| row.setting.abs()).fold(0.0, f64::max);
        if largest > 0.0 { largest * self.header.kick_per_ampere } else { 1.0 }
    }

    /// Reads `header.toml` and `frames.csv` of a campaign's folder.
    ///
    /// # Errors
    /// The first fault met, the header's before the frames'.
    pub fn read(folder: &Path, layout: &Layout) -> Result<Self, RecordingError> {
        Ok(Self {
            header: header(&folder.join("header.toml"))?,
            rows: rows(&folder.join("frames.csv"), layout)?,
            name: name(folder),
        })
    }
}

/// The folder's own name, also where it was given as `.` or `..`.
fn name(folder: &Path) -> String {
    let full = folder.canonicalize().unwrap_or_else(|_| folder.into());
    full.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// The file's text without the byte order mark that some spreadsheets put before it.
fn text(file: &Path) -> Result<String, RecordingError> {
    let text = fs::read_to_string(file).map_err(|error| RecordingError::Unreadable(file.into(), error.kind()))?;
    Ok(text.strip_prefix('\u{feff}').map(str::to_owned).unwrap_or(text))
}

fn header(file: &Path) -> Result<Header, RecordingError> {
    let text = text(file)?;
    let refuse = |span, message: &str| {
        let message = message.replace(['\n', '\r'], " "); // a quoted key may hold a line break
        RecordingError::Header(header_place(file, &text, span), message)
    };
    let refuse_toml = |error: toml::de::Error| refuse(error.span().unwrap_or_default(), error.message());
    let header: Header = toml::from_str(&text).map_err(refuse_toml)?;
    if header.believed_rf == BelievedRf::RadialLoop && header.radial_loop_monitors.is_none() {
        return Err(refuse(0..0, "missing field `radial_loop_monitors`, needed as believed_rf is radial_loop"));
    }
    Ok(header)
}

/// Line of a span of the header, and the key that the span is or is the value of.
fn header_place(file: &Path, text: &str, span: Range<usize>) -> Place {
    let is_key = text[span.end..].trim_start().starts_with('=');
    let before = &text[..if is_key { span.end } else { span.start }];
    let line = before.rsplit('\n').next().unwrap_or_default();
    let left = if is_key { Some(line) } else { line.rsplit_once('=').map(|(left, _)| left) };
    let part = left.and_then(last_word).map_or(Part::Whole, |key| Part::Key(key.into()));
    Place::new(file, 1 + before.matches('\n').count(), part)
}

fn last_word(text: &str) -> Option<&str> {
    let in_key = |c: char| c.is_alphanumeric() || c == '_' || c == '-';
    text.trim_end().rsplit(|c| !in_key(c)).next().filter(|word| !word.is_empty())
}

fn positive<'de, D: Deserializer<'de>>(value: D) -> Result<f64, D::Error> {
    let value = f64::deserialize(value)?;
    let refuse = || D::Error::invalid_value(Unexpected::Float(value), &POSITIVE.words);
    POSITIVE.check(value).ok_or_else(refuse)
}

fn positive_milli<'de, D: Deserializer<'de>>(value: D) -> Result<f64, D::Error> {
    positive(value).map(from_milli)
}

fn transfer<'de, D: Deserializer<'de>>(value: D) -> Result<Vec<f64>, D::Error> {
    let transfer = Vec::<f64>::deserialize(value)?;
    let nominal = 0.0 + transfer.iter().sum::<f64>(); // p(1); an empty list sums to -0, which would puzzle a reader
    if nominal == 0.0 || !nominal.is_finite() {
        let words = &"finite coefficients with a sum p(1) that is not 0";
        return Err(D::Error::invalid_value(Unexpected::Other(&format!("p(1) = {nominal}")), words));
    }
    Ok(transfer)
}

/// Exactly two names: serde's own `[String; 2]` would let the header's reader drop a third in silence.
fn pair<'de, D: Deserializer<'de>>(value: D) -> Result<Option<[String; 2]>, D::Error> {
    let names = Vec::<String>::deserialize(value)?;
    let refuse = |names: Vec<String>| D::Error::invalid_length(names.len(), &"two monitors");
    names.try_into().map(Some).map_err(refuse)
}

/// A division, as `x · 0.001` would round twice: decimal values stay correct to 1 ulp.
fn from_milli(value: f64) -> f64 {
    value / 1000.0
}

fn rows(file: &Path, layout: &Layout) -> Result<Vec<Row>, RecordingError> {
    let (text, columns) = (text(file)?, columns(layout));
    let mut lines = text.lines();
    check_columns(file, &columns, lines.next().unwrap_or_default())?;
    let mut rows: Vec<Row> = Vec::new();
    for (index, line) in lines.enumerate() {
        let mut cells = Cells::split(file, 2 + index, &columns, line)?;
        let row = cells.row(layout, rows.last())?;
        rows.push(row);
    }
    if rows.is_empty() {
        let at = Place::new(file, 1, Part::Whole);
        return Err(RecordingError::NoFrames(at.mismatch("frames below the columns", "none")));
    }
    Ok(rows)
}

fn columns(layout: &Layout) -> Vec<String> {
    let [before, after] = FIXED.map(|columns| columns.split(',').map(String::from));
    let correctors = layout.correctors.iter().map(|name| format!("ic_{name}_A"));
    let monitors = layout.monitors.iter().map(|name| format!("{name}_mm"));
    before.chain(correctors).chain(monitors).chain(after).collect()
}

/// Reports the first column that differs from the expected one.
fn check_columns(file: &Path, columns: &[String], line: &str) -> Result<(), RecordingError> {
    let names: Vec<&str> = line.split(',').collect();
    let column = |i: usize| columns.get(i).map(String::as_str);
    let Some(i) = (0..columns.len().max(names.len())).find(|&i| column(i) != names.get(i).copied()) else {
        return Ok(());
    };
    let end = || "the end of the line".to_owned();
    let found = names.get(i).map_or_else(end, |name| format!("{name:?}"));
    let at = Place::new(file, 1, Part::Column((i + 1).to_string()));
    Err(column_error(columns, &names, i)(at.mismatch(column(i).map_or_else(end, str::to_owned), found)))
}

/// What is the matter at column `i`, the first whose name is not the expected one.
fn column_error(columns: &[String], names: &[&str], i: usize) -> fn(Mismatch) -> RecordingError {
    let Some(&found) = names.get(i) else {
        return RecordingError::MissingColumn;
    };
    let absent = |column: &String| !names.contains(&column.as_str());
    let other_unit = |column: &String| absent(column) && quantity(column) == quantity(found);
    if names[..i].contains(&found) {
        RecordingError::DuplicateColumn
    } else if columns.iter().any(other_unit) {
        RecordingError::ColumnUnit
    } else if !columns.iter().any(|column| column == found) {
        RecordingError::UnknownColumn
    } else if columns.get(i).is_some_and(absent) {
        RecordingError::MissingColumn
    } else {
        RecordingError::MisplacedColumn
    }
}

/// A column's name without its unit.
fn quantity(column: &str) -> &str {
    column.rsplit_once('_').map_or(column, |(quantity, _)| quantity)
}

/// What a number may be, in words and as a check of finite values.
struct Limit {
    words: &'static str,
    accepts: fn(f64) -> bool,
}

const FINITE: Limit = Limit { words: "a finite number", accepts: |_| true };
const POSITIVE: Limit = Limit { words: "a positive finite number", accepts: |x| x > 0.0 };
const NO_SETTING: Limit = Limit { words: "0, as no corrector is named", accepts: |x| x == 0.0 };
const POSITION: Limit = Limit { words: "a position from -100 to 100 mm", accepts: |x| x.abs() <= 100.0 };
const RF_OFFSET: Limit = Limit { words: "a relative offset from -0.01 to 0.01", accepts: |x| x.abs() <= 0.01 };
const TUNE: Limit = Limit { words: "a fractional tune from 0 to below 1", accepts: |x| (0.0..1.0).contains(&x) };

impl Limit {
    fn check(&self, value: f64) -> Option<f64> {
        (value.is_finite() && (self.accepts)(value)).then_some(value)
    }

    /// Rust reads `NaN` and `inf` as numbers; `check` turns them away.
    fn parse(&self, cell: &str) -> Option<f64> {
        cell.parse().ok().and_then(|value| self.check(value))
    }
}

/// The cells of one line, taken from left to right.
struct Cells<'a> {
    file: &'a Path,
    line: usize,
    columns: &'a [String],
    cells: Vec<&'a str>,
    taken: usize,
}

impl<'a> Cells<'a> {
    fn split(file: &'a Path, line: usize, columns: &'a [String], text: &'a str) -> Result<Self, RecordingError> {
        let cells: Vec<&str> = text.split(',').collect();
        let (expected, found) = (columns.len(), cells.len());
        if found != expected {
            let at = Place::new(file, line, Part::Whole);
            return Err(RecordingError::CellCount(at.mismatch(format!("{expected} cells"), found)));
        }
        Ok(Self { file, line, columns, cells, taken: 0 })
    }

    /// One row; the fields stand in the order of the columns.
    fn row(&mut self, layout: &Layout, previous: Option<&Row>) -> Result<Row, RecordingError> {
        let sequence = self.sequence()?;
        self.rising(previous.map(|row| row.sequence.into()), sequence.into())?;
        let time = self.number(FINITE)?;
        self.rising(previous.map(|row| row.time), time)?;
        let cycle_time = self.number(FINITE).map(from_milli)?;
        let corrector = self.corrector(&layout.correctors)?;
        Ok(Row {
            sequence,
            time,
            cycle_time,
            setting: self.number(if corrector.is_some() { FINITE } else { NO_SETTING })?,
            corrector,
            rf_offset: self.number(RF_OFFSET)?,
            currents: self.currents()?,
            corrector_current: layout.correctors.iter().map(|_| self.number(FINITE)).collect::<Result<_, _>>()?,
            reading: layout.monitors.iter().map(|_| self.reading()).collect::<Result<_, _>>()?,
            tune: [self.optional(TUNE)?, self.optional(TUNE)?],
        })
    }

    fn sequence(&mut self) -> Result<u32, RecordingError> {
        self.take("a whole number from 0 to 4294967295", |cell| cell.parse().ok())
    }

    fn corrector(&mut self, names: &[String]) -> Result<Option<String>, RecordingError> {
        self.take("a corrector of the machine or nothing", |cell| {
            let known = names.iter().find(|name| *name == cell).cloned();
            (cell.is_empty() || known.is_some()).then_some(known)
        })
    }

    fn currents(&mut self) -> Result<Currents, RecordingError> {
        Ok(Currents {
            dipole: self.number(POSITIVE)?,
            qh: self.number(POSITIVE)?,
            qv: self.number(POSITIVE)?,
            sh: self.number(FINITE)?,
            sv: self.number(FINITE)?,
        })
    }

    fn reading(&mut self) -> Result<Option<f64>, RecordingError> {
        Ok(self.optional(POSITION)?.map(from_milli))
    }

    fn number(&mut self, limit: Limit) -> Result<f64, RecordingError> {
        self.take(limit.words, |cell| limit.parse(cell))
    }

    /// A number, or `None` for the empty cell of an instrument that did not report.
    fn optional(&mut self, limit: Limit) -> Result<Option<f64>, RecordingError> {
        self.take(limit.words, |cell| match cell {
            "" => Some(None),
            cell => limit.parse(cell).map(Some),
        })
    }

    /// The next cell's value, where `parse` accepts its text.
    fn take<T>(&mut self, expected: &str, parse: impl FnOnce(&str) -> Option<T>) -> Result<T, RecordingError> {
        let cell = self.cells[self.taken];
        self.taken += 1;
        parse(cell).ok_or_else(|| {
            let found = if cell.is_empty() { "an empty cell".into() } else { format!("{cell:?}") };
            RecordingError::Cell(self.place().mismatch(expected, found))
        })
    }

    /// Refuses a value, just taken, that is not above that of the line before.
    fn rising(&self, previous: Option<f64>, found: f64) -> Result<(), RecordingError> {
        match previous.filter(|previous| found <= *previous) {
            Some(previous) => {
                let expected = format!("more than the {previous} of the line before");
                Err(RecordingError::Order(self.place().mismatch(expected, found)))
            }
            None => Ok(()),
        }
    }

    /// The cell taken last.
    fn place(&self) -> Place {
        Place::new(self.file, self.line, Part::Column(self.columns[self.taken - 1].clone()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The document's example is what these tests read, so that neither can drift from the other.
    const DOCUMENT: &str = include_str!("../../docs/recording.md");

    fn block(language: &str) -> &'static str {
        let (_, rest) = DOCUMENT.split_once(&format!("```{language}\n")).expect("the document has this block");
        rest.split_once("```").expect("the block ends").0
    }

    fn layout() -> Layout {
        let names = |names: [&str; 2]| names.map(String::from).to_vec();
        Layout { monitors: names(["x_A2", "y_A1"]), correctors: names(["A2", "A1"]) }
    }

    /// Reads a campaign `toy`; a file without content is left out. The error's path starts at the campaign's folder.
    fn read(header: &[u8], frames: &[u8]) -> Result<Recording, String> {
        let home = tempfile::tempdir().expect("a temporary folder can be made");
        let folder = home.path().join("toy");
        fs::create_dir(&folder).expect("it is writable");
        for (file, content) in [("header.toml", header), ("frames.csv", frames)] {
            if !content.is_empty() {
                fs::write(folder.join(file), content).expect("it is writable");
            }
        }
        let strip = |error: RecordingError| error.to_string().replace(&format!("{}/", home.path().display()), "");
        Recording::read(&folder, &layout()).map_err(strip)
    }

    /// The document's text with its one `old` changed to `new`.
    fn edited(language: &str, old: &str, new: &str) -> String {
        assert_eq!(block(language).matches(old).count(), 1, "{old} stands once in the example");
        block(language).replace(old, new)
    }

    fn with_frames(old: &str, new: &str) -> Result<Recording, String> {
        read(block("toml").as_bytes(), edited("csv", old, new).as_bytes())
    }

    fn frames_error(old: &str, new: &str) -> String {
        with_frames(old, new).expect_err(new)
    }

    fn header_error(old: &str, new: &str) -> String {
        read(edited("toml", old, new).as_bytes(), block("csv").as_bytes()).expect_err(new)
    }

    fn assert_frames_error(old: &str, new: &str, expected: &str) {
        assert_eq!(frames_error(old, new), format!("toy/frames.csv, {expected}"));
    }

    fn assert_header_error(old: &str, new: &str, expected: &str) {
        assert_eq!(header_error(old, new), format!("toy/header.toml, {expected}"));
    }

    #[test]
    fn example_of_the_document_reads_in_si_units() {
        let toy = read(block("toml").as_bytes(), block("csv").as_bytes()).expect("the example is right");
        assert_eq!((toy.name.as_str(), toy.rows.len()), ("toy", 2));
        assert_eq!((toy.header.bpm_sigma, toy.header.kick_per_ampere), (0.15e-3, 0.00909091e-3));
        assert_eq!((toy.header.believed_rf, toy.header.nominal.qv), (BelievedRf::FixedMomentum, 1790.0));
        assert_eq!(toy.header.radial_loop_monitors, None);
        let row = &toy.rows[1];
        assert_eq!((row.sequence, row.time, row.cycle_time, row.rf_offset), (2, 8.0, 0.092, -0.0002));
        assert_eq!((row.corrector.as_deref(), row.setting), (Some("A2"), 22.0));
        assert_eq!((row.currents.dipole, row.currents.sv), (2400.314, 0.045576));
        assert_eq!(row.corrector_current, [21.9987, -0.0121]);
        assert_eq!(row.reading, [Some(1.9287e-3), None]);
        assert_eq!(row.tune, [Some(0.80674), None]);
    }

    #[test]
    fn example_errors_of_the_document_are_verbatim() {
        let errors = [
            header_error("bpm_sigma_mm = 0.15", "bpm_sigma_mm = -0.15"),
            header_error("lattice = \"toy.json\"\n", ""),
            frames_error("x_A2_mm", "x_A2_um"),
            frames_error("1.9287", "NaN"),
            frames_error("\n2,", "\n0,"),
        ];
        assert_eq!(block("text").lines().collect::<Vec<_>>(), errors);
    }

    #[test]
    fn missing_files_are_named() {
        let (header, frames) = (block("toml").as_bytes(), block("csv").as_bytes());
        let absent = "cannot be read as UTF-8 text: entity not found";
        assert_eq!(read(b"", frames), Err(format!("toy/header.toml: {absent}")));
        assert_eq!(read(header, b""), Err(format!("toy/frames.csv: {absent}")));
    }

    #[test]
    fn bytes_that_are_no_text_are_refused() {
        let error = read(block("toml").as_bytes(), b"seq,\xff").expect_err("0xff is not UTF-8");
        assert_eq!(error, "toy/frames.csv: cannot be read as UTF-8 text: invalid data");
    }

    #[test]
    fn byte_order_mark_and_crlf_are_accepted() {
        let [header, frames] =
            ["toml", "csv"].map(|language| format!("\u{feff}{}", block(language).replace('\n', "\r\n")));
        assert_eq!(read(header.as_bytes(), frames.as_bytes()), read(block("toml").as_bytes(), block("csv").as_bytes()));
        let error = read(header.as_bytes(), frames.replace("1.9287", "x").as_bytes()).expect_err("x is no number");
        assert!(error.contains(", line 3, "), "{error}");
    }

    #[test]
    fn header_that_is_not_toml_is_refused() {
        let expected = "line 5, key kinetic_energy_GeV: string values must be quoted, expected literal string";
        assert_header_error("kinetic_energy_GeV = 1.5", "kinetic_energy_GeV =", expected);
        assert_header_error("recorded_with", "lattice", "line 3, key lattice: duplicate key");
    }

    #[test]
    fn missing_header_key_is_named() {
        assert_header_error("lattice = \"toy.json\"\n", "", "line 1: missing field `lattice`");
        assert_header_error(", qv = 1790.0", "", "line 10, key nominal_A: missing field `qv`");
    }

    #[test]
    fn unknown_header_key_is_named() {
        let expected = "line 10, key qd: unknown field `qd`, expected one of `dipole`, `qh`, `qv`";
        assert_header_error("qv = 1790.0", "qv = 1790.0, qd = 1.0", expected);
    }

    #[test]
    fn header_value_of_wrong_type_is_refused() {
        let expected = "line 6, key bpm_sigma_mm: invalid type: string \"x\", expected f64";
        assert_header_error("bpm_sigma_mm = 0.15", "bpm_sigma_mm = \"x\"", expected);
        let expected = "`fixed_momentum`, `fixed_frequency`, `radial_loop`";
        let expected = format!("line 9, key believed_rf: unknown variant `none`, expected one of {expected}");
        assert_header_error("\"fixed_momentum\"", "\"none\"", &expected);
    }

    #[test]
    fn header_values_must_be_positive_and_finite() {
        let keys = ["kinetic_energy_GeV = 1.5", "bpm_sigma_mm = 0.15", "kick_mrad_per_A = 0.00909091"];
        for assignment in keys.into_iter().chain(["dipole = 2400.0", "qh = 1800.0", "qv = 1790.0"]) {
            let (key, _) = assignment.split_once(" = ").expect("key = value");
            for bad in ["0.0", "-1.0", "nan", "inf"] {
                let error = header_error(assignment, &format!("{key} = {bad}"));
                assert!(error.contains(&format!(", key {key}: invalid value: ")), "{error}");
                assert!(error.ends_with(", expected a positive finite number"), "{error}");
            }
        }
    }

    #[test]
    fn quad_transfer_must_have_a_value_at_nominal_current() {
        for (bad, sum) in [("[]", "0"), ("[1.0, -1.0]", "0"), ("[1.0, nan]", "NaN"), ("[inf]", "inf")] {
            let expected = "expected finite coefficients with a sum p(1) that is not 0";
            let expected = format!("line 11, key quad_transfer: invalid value: p(1) = {sum}, {expected}");
            assert_header_error("[0.0, 1.0]", bad, &expected);
        }
    }

    #[test]
    fn radial_loop_holds_exactly_two_monitors() {
        let expected = "line 1: missing field `radial_loop_monitors`, needed as believed_rf is radial_loop";
        assert_header_error("\"fixed_momentum\"", "\"radial_loop\"", expected);
        let expected = "line 12, key radial_loop_monitors: invalid length 3, expected two monitors";
        assert_header_error("note = ", "radial_loop_monitors = [\"a\", \"b\", \"c\"]\nnote = ", expected);
    }

    #[test]
    fn missing_column_is_named() {
        let expected = "line 1, column 14: expected x_A2_mm, found \"y_A1_mm\", so a column is missing";
        assert_frames_error("x_A2_mm,", "", expected);
        let expected = "line 1, column 17: expected qy_frac, found the end of the line, so a column is missing";
        assert_frames_error(",qy_frac", "", expected);
    }

    #[test]
    fn unknown_column_is_named() {
        let fault = "which the machine does not have";
        let expected = format!("line 1, column 14: expected x_A2_mm, found \"x_A4_mm\", {fault}");
        assert_frames_error("x_A2_mm", "x_A4_mm", &expected);
        let expected = format!("line 1, column 18: expected the end of the line, found \"i\", {fault}");
        assert_frames_error("qy_frac", "qy_frac,i", &expected);
    }

    #[test]
    fn misplaced_column_is_named() {
        let expected = "line 1, column 14: expected x_A2_mm, found \"y_A1_mm\", which is in the wrong place";
        assert_frames_error("x_A2_mm,y_A1_mm", "y_A1_mm,x_A2_mm", expected);
    }

    #[test]
    fn duplicate_column_is_named() {
        let expected = "line 1, column 15: expected y_A1_mm, found \"x_A2_mm\", which is there already";
        assert_frames_error("y_A1_mm", "x_A2_mm", expected);
    }

    #[test]
    fn wrong_unit_is_named() {
        for (good, bad, column) in [("x_A2_mm", "x_A2_um", 14), ("x_A2_mm", "x_A2_m", 14), ("time_s", "time_ms", 2)] {
            let expected = format!("expected {good}, found \"{bad}\", which has the wrong unit");
            assert_frames_error(good, bad, &format!("line 1, column {column}: {expected}"));
        }
    }

    #[test]
    fn cells_are_counted() {
        for (old, new, found) in [("1.9287,", "", 16), ("0.80674,", "0.80674,,", 18), ("\n2,", "\n\n2,", 1)] {
            assert_frames_error(old, new, &format!("line 3: expected 17 cells, found {found}"));
        }
    }

    /// The example's second row with one cell replaced.
    fn cell(index: usize, content: &str) -> Result<Recording, String> {
        let (above, row) = block("csv").trim_end().rsplit_once('\n').expect("it has rows");
        let mut cells: Vec<&str> = row.split(',').collect();
        cells[index] = content;
        read(block("toml").as_bytes(), format!("{above}\n{}\n", cells.join(",")).as_bytes())
    }

    #[test]
    fn every_cell_refuses_what_is_no_finite_number() {
        for (index, column) in columns(&layout()).into_iter().enumerate() {
            for bad in ["NaN", "nan", "inf", "-inf", "1e999", "Z9", "1;5", " 1", "\"1\""] {
                let error = cell(index, bad).expect_err(bad);
                assert!(error.starts_with(&format!("toy/frames.csv, line 3, column {column}: expected ")), "{error}");
                assert!(error.ends_with(&format!(", found {bad:?}")), "{error}");
            }
        }
    }

    #[test]
    fn only_monitors_and_tunes_may_be_empty() {
        for (index, column) in columns(&layout()).into_iter().enumerate() {
            let result = cell(index, "").map(|_| ());
            let optional = column.ends_with("_mm") || column.ends_with("_frac");
            assert_eq!(result.is_ok(), optional, "{column}: {result:?}");
        }
        let expected = "line 3, column i_dipole_A: expected a positive finite number, found an empty cell";
        assert_frames_error("2400.314", "", expected);
    }

    #[test]
    fn corrector_must_be_one_of_the_machine() {
        let expected = "line 3, column corrector: expected a corrector of the machine or nothing, found \"A3\"";
        assert_frames_error(",A2,22,", ",A3,22,", expected);
    }

    #[test]
    fn setting_needs_a_corrector() {
        let expected = "line 3, column setting_A: expected 0, as no corrector is named, found \"22\"";
        assert_frames_error(",A2,22,", ",,22,", expected);
    }

    #[test]
    fn sequence_does_not_repeat() {
        let expected = "line 3, column seq: expected more than the 1 of the line before, found 1";
        assert_frames_error("\n2,", "\n1,", expected);
    }

    #[test]
    fn sequence_does_not_go_backward() {
        let expected = "line 3, column seq: expected more than the 1 of the line before, found 0";
        assert_frames_error("\n2,", "\n0,", expected);
    }

    #[test]
    fn sequence_may_leave_gaps() {
        assert_eq!(with_frames("\n2,", "\n900,").map(|toy| toy.rows[1].sequence), Ok(900));
    }

    #[test]
    fn time_rises() {
        let expected = "line 3, column time_s: expected more than the 4 of the line before, found 4";
        assert_frames_error("8.000", "4.000", expected);
    }

    #[test]
    fn recording_without_frames_is_refused() {
        let (columns, _) = block("csv").split_once('\n').expect("it has columns");
        let error = read(block("toml").as_bytes(), columns.as_bytes()).expect_err("it has no frames");
        assert_eq!(error, "toy/frames.csv, line 1: expected frames below the columns, found none");
    }

    fn assert_range(index: usize, inside: [&str; 2], outside: [&str; 2], expected: &str) {
        for content in inside {
            assert_eq!(cell(index, content).map(|_| ()), Ok(()));
        }
        for content in outside {
            let error = cell(index, content).expect_err(content);
            assert!(error.ends_with(&format!(": expected {expected}, found {content:?}")), "{error}");
        }
    }

    #[test]
    fn readings_stay_within_100_mm() {
        assert_range(13, ["-100", "100"], ["-100.001", "250"], "a position from -100 to 100 mm");
    }

    #[test]
    fn rf_offset_stays_within_one_percent() {
        assert_range(5, ["-0.01", "1e-2"], ["-0.0101", "0.02"], "a relative offset from -0.01 to 0.01");
    }

    #[test]
    fn tune_is_a_fraction() {
        assert_range(15, ["0", "0.99999"], ["-0.1", "1"], "a fractional tune from 0 to below 1");
    }

    #[test]
    fn currents_that_divide_a_gradient_are_positive() {
        for index in 6..9 {
            assert_range(index, ["0.001", "1e4"], ["0", "-2400"], "a positive finite number");
        }
    }

    #[test]
    fn decimal_millimetres_stay_correct_to_one_ulp() {
        for tenth_micron in -200_000..=200_000_i32 {
            let cell = format!("{:.4}", f64::from(tenth_micron) / 1e4);
            let exact: f64 = format!("{cell}e-3").parse().expect("a decimal");
            let metres = from_milli(cell.parse().expect("a decimal"));
            assert!(metres.to_bits().abs_diff(exact.to_bits()) <= 1, "{cell} mm became {metres} m");
        }
    }

    #[test]
    fn error_stays_on_one_line_whatever_the_files_hold() {
        let errors =
            [header_error("particle", "\"a\\nb\""), frames_error("seq", "s\"\re\tq"), frames_error("1.9287", "1\r2")];
        for error in errors {
            assert!(!error.contains(char::is_control), "{error}");
        }
    }
}
