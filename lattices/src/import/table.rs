//! A table of numbers with names of its lines and columns, or without; in text they are separated by commas, semicolons, tabs or spaces.

use std::collections::HashMap;

use super::instruments::{Channel, Instrument, Order, channel, in_order, label};
use super::stated::Stated;
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
    /// Of names of columns, and lines with their names; a number that is NaN was not measured.
    pub(super) fn named(
        file: &str,
        stated: Stated,
        columns: Option<Vec<String>>,
        lines: Vec<(Option<String>, Vec<f64>)>,
    ) -> Result<Self, MeasuredError> {
        let lines = lines.into_iter().enumerate();
        let rows = lines.map(|(at, (name, values))| Line { number: at + 1, name, values }).collect();
        let mut table = Self { file: file.into(), stated, columns, rows };
        table.check()?;
        let wrong = |row: &Line| {
            let mut numbers = row.values.iter().filter(|one| !one.is_nan());
            numbers.find_map(|one| Some(format!("line {}: {}", row.number, FINITE.check(*one).err()?)))
        };
        match table.rows.iter().find_map(wrong) {
            Some(problem) => table.refuse(problem),
            None => Ok(table),
        }
    }

    /// One table of several with names of lines and columns: blocks of a matrix, as of each plane. What no table has was not measured.
    ///
    /// # Errors
    /// [`MeasuredError::Table`]: a table without names, of other units, or with an element that another has too.
    pub fn joined(self, other: Self) -> Result<Self, MeasuredError> {
        if self.stated != other.stated {
            return other.refuse(format!("{} states other units", self.file));
        }
        let is_named = |one: &Self| one.columns.is_some() && one.rows.iter().all(|row| row.name.is_some());
        if let Some(bare) = [&self, &other].into_iter().find(|one| !is_named(one)) {
            return bare.refuse("lines or columns have no names, by which several tables are put together".into());
        }
        let mut whole = self;
        let mut head = whole.columns.take().unwrap_or_default();
        let bytes = (8 * (head.len() + other.columns.iter().flatten().count()))
            .saturating_mul(whole.rows.len() + other.rows.len());
        if let Err(exceeded) = MEMORY.check(bytes as u64) {
            return other.refuse(format!("beside {}: {exceeded}", whole.file));
        }
        // of equal names the first counts
        let mut place: HashMap<String, usize> = (0..head.len()).rev().map(|at| (head[at].clone(), at)).collect();
        let mut column = |name: &String| {
            *place.entry(name.clone()).or_insert_with(|| {
                head.push(name.clone());
                head.len() - 1
            })
        };
        let columns: Vec<usize> = other.columns.iter().flatten().map(&mut column).collect();
        whole.rows.iter_mut().for_each(|row| row.values.resize(head.len(), f64::NAN));
        let mut lines: HashMap<Option<String>, usize> =
            (0..whole.rows.len()).rev().map(|at| (whole.rows[at].name.clone(), at)).collect();
        for Line { number, name, values } in &other.rows {
            let at = *lines.entry(name.clone()).or_insert_with(|| {
                whole.rows.push(Line { number: *number, name: name.clone(), values: vec![f64::NAN; head.len()] });
                whole.rows.len() - 1
            });
            for (&column, &value) in columns.iter().zip(values) {
                let own = &mut whole.rows[at].values[column];
                if !own.is_nan() && !value.is_nan() {
                    let name = name.as_deref().unwrap_or_default();
                    return other.refuse(format!("{name} to {} stands in {} too", head[column], whole.file));
                }
                *own = if own.is_nan() { value } else { *own };
            }
        }
        whole.columns = Some(head);
        Ok(whole)
    }

    /// Read the text of a table; `file` appears in errors.
    ///
    /// # Errors
    /// [`MeasuredError::Table`], with file and line.
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
        if width == 0 {
            return self.refuse(format!("line {}: no number", first.number));
        }
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

/// Cells of each line that has some, with the number of the line; `#`, `%` and `!` begin a comment, whatever stands in it.
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
    let is_comment = |line: &str| line.trim_start().starts_with(['#', '%', '!']);
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
