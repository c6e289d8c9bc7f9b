//! A plain table of numbers: separated by commas, semicolons, tabs or spaces, with names in the first line and in the first column or without; or a
//! dataset of an HDF5 file, `FILE.h5:/PATH` or `FILE.h5:/X,/Y` for one below the other, or a variable of a MAT-file, `FILE.mat:NAME`, whose lines and columns have no names.
//! A response matrix of the Matlab Middle Layer needs no `NAME`.

use std::path::Path;

use super::conventions::Stated;
use super::hdf5::{self, Matrix};
use super::instruments::{Channel, Instrument, Order, channel, in_order, label};
use super::mat::MatFile;
use super::source::{Source, bytes};
use measured::MeasuredError;
use twin::limits::{Budget, Exceeded, FINITE, MEMORY, TEXT};

/// A table as it was read.
#[derive(Debug, Clone)]
pub struct Table {
    /// Name of the file.
    pub file: String,
    /// What the file says of its numbers.
    pub stated: Stated,
    columns: Option<Vec<String>>,
    rows: Vec<Line>,
}

/// A line of numbers.
#[derive(Debug, Clone)]
struct Line {
    number: usize,
    name: Option<String>,
    values: Vec<f64>,
}

impl Table {
    /// Read it; an empty field or `nan` was not measured.
    ///
    /// # Errors
    /// [`MeasuredError`], with file and line.
    pub fn read(path: &Path) -> Result<Self, MeasuredError> {
        let source = Source::of(path);
        let file = source.path.display().to_string();
        let bytes = bytes(&source.path)?;
        if MatFile::is_one(&bytes) {
            let (matrix, stated) = MatFile::of(&file, bytes)?.matrix(source.name.as_deref())?;
            return Self::of(path, matrix, stated);
        }
        if hdf5::is_one(&bytes) {
            return Self::of(path, hdf5::matrix(&source, bytes)?, Stated::default());
        }
        match String::from_utf8(bytes) {
            Ok(text) => Self::parse(&file, &text),
            Err(_) => {
                Err(MeasuredError::Table { file, problem: "expected a table of text, HDF5 or a MAT-file".into() })
            }
        }
    }

    /// Numbers alone.
    fn of(path: &Path, Matrix { width, values }: Matrix, stated: Stated) -> Result<Self, MeasuredError> {
        let lines = values.chunks(width.max(1)).enumerate();
        let rows = lines.map(|(at, values)| Line { number: at + 1, name: None, values: values.to_vec() }).collect();
        let mut table = Self { file: path.display().to_string(), stated, columns: None, rows };
        table.check()?;
        let mut numbers = values.iter().enumerate().filter(|(_, one)| !one.is_nan());
        match numbers.find_map(|(at, one)| Some((at, FINITE.check(*one).err()?))) {
            Some((at, problem)) => table.refuse(format!("line {}: {problem}", at / width + 1)),
            None => Ok(table),
        }
    }

    /// Read the text of a table; `file` appears in errors.
    ///
    /// # Errors
    /// As [`Table::read`].
    pub fn parse(file: &str, text: &str) -> Result<Self, MeasuredError> {
        let mut table = Self { file: file.into(), stated: Stated::default(), columns: None, rows: Vec::new() };
        for (number, cells) in cells(file, text)? {
            let is_head = table.rows.is_empty() && table.columns.is_none();
            if is_head && cells.iter().skip(1).any(|cell| !is_number(cell)) {
                table.columns = Some(cells);
                continue;
            }
            let line = table.line(number, cells)?;
            table.rows.push(line);
        }
        table.check()?;
        Ok(table)
    }

    /// With other names of lines and columns: pairs of the name that stands there and that which shall; the rest stay.
    #[must_use]
    pub fn renamed(mut self, lines: &[(String, String)], columns: &[(String, String)]) -> Self {
        let of = |all: &[(String, String)], name: &String| {
            all.iter().find(|(from, _)| from == name).map(|(_, to)| to.clone())
        };
        for row in &mut self.rows {
            row.name = row.name.take().map(|name| of(lines, &name).unwrap_or(name));
        }
        for name in self.columns.iter_mut().flatten() {
            *name = of(columns, name).unwrap_or_else(|| name.clone());
        }
        self
    }

    fn line(&self, number: usize, mut cells: Vec<String>) -> Result<Line, MeasuredError> {
        let name = (!is_number(&cells[0])).then(|| cells.remove(0));
        let values = cells.iter().map(|cell| match cell.as_str() {
            "" => Ok(f64::NAN),
            cell if cell.parse().is_ok_and(f64::is_nan) => Ok(f64::NAN),
            cell => FINITE.parse(cell).or_else(|problem| self.refuse(format!("line {number}: {problem}"))),
        });
        Ok(Line { number, name, values: values.collect::<Result<_, _>>()? })
    }

    /// All lines alike; the first cell of the names of the columns stands above the names of the lines.
    fn check(&mut self) -> Result<(), MeasuredError> {
        let Some(first) = self.rows.first() else { return self.refuse("no line of numbers".into()) };
        let (width, is_named) = (first.values.len(), first.name.is_some());
        if let Some(odd) = self.rows.iter().find(|one| one.values.len() != width || one.name.is_some() != is_named) {
            let problem = format!(
                "line {}: {} numbers{}, line {} has {width}",
                odd.number,
                odd.values.len(),
                if odd.name.is_some() == is_named { "" } else { ", with or without a name unlike the first" },
                first.number
            );
            return self.refuse(problem);
        }
        let spare = usize::from(is_named);
        if let Some(columns) = &mut self.columns {
            match columns.len() {
                length if length == width => {}
                length if length == width + spare => drop(columns.remove(0)),
                length => return self.refuse(format!("{length} names above columns, {width} numbers in a line")),
            }
        }
        Ok(())
    }

    /// Channels of the lines.
    pub(super) fn lines(
        &self,
        of: &[Instrument],
        names: &[String],
        order: Option<Order>,
    ) -> Result<Vec<Channel>, MeasuredError> {
        let own: Option<Vec<&str>> = self.rows.iter().map(|one| one.name.as_deref()).collect();
        self.channels("lines", own, self.rows.len(), of, names, order)
    }

    /// Channels of the columns.
    pub(super) fn columns(
        &self,
        of: &[Instrument],
        names: &[String],
        order: Option<Order>,
    ) -> Result<Vec<Channel>, MeasuredError> {
        let own = self.columns.as_ref().map(|all| all.iter().map(String::as_str).collect());
        self.channels("columns", own, self.width(), of, names, order)
    }

    fn channels(
        &self,
        what: &str,
        own: Option<Vec<&str>>,
        count: usize,
        of: &[Instrument],
        names: &[String],
        order: Option<Order>,
    ) -> Result<Vec<Channel>, MeasuredError> {
        let channels = match (own, order.or(self.stated.order)) {
            (Some(own), _) => {
                let found = own.iter().map(|name| channel(name, of, names)).collect::<Result<Vec<_>, _>>();
                found.or_else(|problem| self.refuse(format!("{what}: {problem}")))?
            }
            (None, Some(order)) => in_order(of, order),
            (None, None) => {
                return self.refuse(format!(
                    "{what} have no names; say their order with --order: planes (all of x in beam order, then all of y) or pairs (x and y of each in turn)"
                ));
            }
        };
        if channels.len() != count {
            return self.refuse(format!("{count} {what}, the lattice has {} channels in that order", channels.len()));
        }
        let twice = channels.iter().enumerate().find(|(place, one)| channels[..*place].contains(one));
        match twice {
            Some((_, twice)) => self.refuse(format!("{what}: {} stands there twice", label(*twice, names))),
            None => Ok(channels),
        }
    }

    /// Number of columns.
    pub(super) fn width(&self) -> usize {
        self.rows[0].values.len()
    }

    /// A number; NaN where it was not measured.
    pub(super) fn value(&self, line: usize, column: usize) -> f64 {
        self.rows[line].values[column]
    }

    pub(super) fn refuse<T>(&self, problem: String) -> Result<T, MeasuredError> {
        Err(MeasuredError::Table { file: self.file.clone(), problem })
    }
}

fn is_number(cell: &str) -> bool {
    cell.is_empty() || cell.parse::<f64>().is_ok()
}

/// Cells of each line that has some, with the number of the line; `#` begins a comment, whatever stands in it.
fn cells(file: &str, text: &str) -> Result<Vec<(usize, Vec<String>)>, MeasuredError> {
    let refused = |problem: String| MeasuredError::Table { file: file.into(), problem };
    if let Some((number, exceeded)) = long(text) {
        return Err(refused(format!("line {number}: {exceeded}")));
    }
    let memory = Budget::new(MEMORY);
    let whole = |number: usize, cells: Vec<&str>| {
        let bytes = LINE + cells.iter().map(|cell| CELL + cell.len()).sum::<usize>();
        memory.take(bytes as u64).map_err(|exceeded| refused(format!("line {number}: {exceeded}")))?;
        Ok((number, cells.into_iter().map(str::to_owned).collect()))
    };
    let is_comment = |line: &str| line.trim_start().starts_with('#');
    let text: String =
        text.lines().map(|line| if is_comment(line) { "\n".into() } else { format!("{line}\n") }).collect();
    let Some(delimiter) = [',', ';', '\t'].into_iter().find(|one| text.contains(*one)) else {
        let lines = text.lines().enumerate();
        let words = lines.map(|(number, line)| (number + 1, line.split_whitespace().collect::<Vec<_>>()));
        return words.filter(|(_, words)| !words.is_empty()).map(|(number, words)| whole(number, words)).collect();
    };
    let mut reader = csv::ReaderBuilder::new()
        .has_headers(false)
        .flexible(true)
        .trim(csv::Trim::All)
        .delimiter(delimiter as u8)
        .from_reader(text.as_bytes());
    let lines = reader.records().map(|record| {
        let record = record.map_err(|error| refused(error.to_string()))?;
        whole(record.position().map_or(0, |position| position.line() as usize), record.iter().collect())
    });
    lines.collect()
}

/// What a line takes before and after its cells are numbers [B].
const LINE: usize = 2 * size_of::<Line>();
/// What a cell takes beside its text, and its number after that [B].
const CELL: usize = size_of::<String>() + size_of::<f64>();

/// A line that is too long.
fn long(text: &str) -> Option<(usize, Exceeded)> {
    text.lines().enumerate().find_map(|(index, line)| Some((index + 1, TEXT.check(line.len() as u64).err()?)))
}
