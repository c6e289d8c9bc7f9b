//! A table of SDDS (Self Describing Data Sets), in ASCII or binary: a response matrix as elegant and the tools of the APS write it.
//!
//! The first column of strings names the lines (`BPMName`); every other column of numbers but `s` is one of the table, named after its corrector:
//! `H1`, `H1#2` for the second of the name, `H1.KICK` with elegant's item. The description says the plane of both (`horizontal-plane response
//! matrix`), and `HKICK` or `VKICK` that of a corrector. `FILE:COLUMN` takes one column, `FILE:X,Y` one below the other. Units are those of the columns.
//!
//! A page is the values of the parameters, the arrays and the rows; a file with several is refused. Nothing is allocated that the file has no bytes for.
//!
//! Source: M. Borland, SDDS File Format (version 1), OAG, Argonne; elegant, `response.c`.

use core::str::FromStr;
use std::collections::HashMap;

use super::stated::Stated;
use super::table::Table;
use measured::MeasuredError;
use twin::limits::{Budget, MEMORY, TEXT};

/// What a value takes here, and in a table after that [B].
const VALUE: u64 = 64;
/// Column of positions, which is no corrector's.
const POSITION: &str = "s";
type Found<T> = Result<T, String>;

/// True where the bytes begin as such a file does.
pub(super) fn is_one(bytes: &[u8]) -> bool {
    bytes.starts_with(b"SDDS")
}

/// Read it; `columns` are those that are asked for.
///
/// # Errors
/// [`MeasuredError::Table`].
pub(super) fn read(file: &str, bytes: &[u8], columns: Option<&str>) -> Result<Table, MeasuredError> {
    let refused = |problem: String| MeasuredError::Table { file: file.into(), problem };
    let page = Page::of(bytes).map_err(refused)?;
    let (stated, head, lines) = page.table(columns).map_err(refused)?;
    Table::named(file, stated, head, lines)
}

/// Types of values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Short,
    UShort,
    Long,
    ULong,
    Long64,
    ULong64,
    Float,
    Double,
    Character,
    String,
}

impl Kind {
    fn is_number(self) -> bool {
        !matches!(self, Self::Character | Self::String)
    }
}

impl FromStr for Kind {
    type Err = String;

    fn from_str(word: &str) -> Found<Self> {
        Ok(match word {
            "short" => Self::Short,
            "ushort" => Self::UShort,
            "long" => Self::Long,
            "ulong" => Self::ULong,
            "long64" => Self::Long64,
            "ulong64" => Self::ULong64,
            "float" => Self::Float,
            "double" => Self::Double,
            "character" => Self::Character,
            "string" => Self::String,
            other => return Err(format!("type {other} of SDDS is not known here")),
        })
    }
}

/// A value.
#[derive(Debug, Clone, PartialEq)]
enum Value {
    Number(f64),
    Text(String),
}

/// What is known of a column.
#[derive(Debug)]
struct Column {
    name: String,
    units: String,
    kind: Kind,
}

/// The header's words, and the values of one page.
#[derive(Debug)]
struct Page {
    description: String,
    columns: Vec<Column>,
    rows: Vec<Vec<Value>>,
}

impl Page {
    fn of(bytes: &[u8]) -> Found<Self> {
        let mut header = Header { rest: bytes, is_little: true };
        header.line()?;
        let (mut description, mut parameters, mut arrays, mut columns) =
            (String::new(), Vec::new(), Vec::new(), Vec::new());
        let data = loop {
            let (command, mut words) = header.command()?;
            let mut word = |key: &str| words.remove(key).unwrap_or_default();
            match command.as_str() {
                "description" => description = format!("{} {}", word("text"), word("contents")).to_lowercase(),
                "parameter" if word("fixed_value").is_empty() => parameters.push(word("type").parse()?),
                "parameter" | "associate" => {}
                "array" => arrays.push((word("type").parse()?, word("dimensions").parse().unwrap_or(1))),
                "column" => {
                    columns.push(Column { name: word("name"), units: word("units"), kind: word("type").parse()? })
                }
                "data" => break words,
                other => return Err(format!("command &{other} of SDDS is not known here")),
            }
        };
        if columns.is_empty() {
            return Err("no columns".into());
        }
        let is_set = |key: &str| data.get(key).is_some_and(|value| value != "0");
        for key in ["additional_header_lines", "lines_per_row"] {
            if data.get(key).is_some_and(|value| !["0", "1"].contains(&value.as_str())) {
                return Err(format!("&data {key} is not known here"));
            }
        }
        let mut source: Box<dyn Values> = match data.get("mode").map(String::as_str) {
            Some("binary") => Box::new(Binary { rest: header.rest, is_little: header.is_little }),
            Some("ascii") => Box::new(Ascii::of(header.rest)?),
            other => return Err(format!("&data mode: expected ascii or binary, found {other:?}")),
        };
        let rows = page(
            source.as_mut(),
            (&parameters, &arrays, &columns),
            (is_set("no_row_counts"), is_set("column_major_order")),
        )?;
        Ok(Self { description, columns, rows })
    }

    /// What the file says, names of the columns, and lines with their names.
    #[allow(clippy::type_complexity)] // the arguments of a table
    fn table(self, asked: Option<&str>) -> Found<(Stated, Option<Vec<String>>, Vec<(Option<String>, Vec<f64>)>)> {
        let names = self.columns.iter().position(|one| one.kind == Kind::String);
        let place = |name: &str| {
            let found = self.columns.iter().position(|one| one.name == name && one.kind.is_number());
            let have = || self.columns.iter().map(|one| one.name.as_str()).collect::<Vec<_>>().join(", ");
            found.ok_or_else(|| format!("no column of numbers {name}; found {}", have()))
        };
        let plane = match (self.description.contains("horizontal"), self.description.contains("vertical")) {
            (true, false) => "x:",
            (false, true) => "y:",
            _ => "",
        };
        let line = |row: &[Value], plane: &str| match names.map(|at| &row[at]) {
            Some(Value::Text(name)) => Some(format!("{plane}{}", numbered(name))),
            _ => None,
        };
        let number = |row: &[Value], at: usize| if let Value::Number(number) = row[at] { number } else { f64::NAN };
        if let Some(asked) = asked {
            let chosen = asked.split(',').map(place).collect::<Found<Vec<_>>>()?;
            let of_column = |&at: &usize| {
                let own = match self.columns[at].name.to_lowercase().as_str() {
                    "x" => "x:",
                    "y" => "y:",
                    _ => plane,
                };
                self.rows.iter().map(|row| (line(row, own), vec![number(row, at)])).collect::<Vec<_>>()
            };
            return Ok((self.stated(&chosen)?, None, chosen.iter().flat_map(of_column).collect()));
        }
        let matrix: Vec<usize> = (0..self.columns.len())
            .filter(|&at| self.columns[at].kind.is_number() && self.columns[at].name != POSITION)
            .collect();
        let head = matrix.iter().map(|&at| corrector(&self.columns[at].name, plane)).collect();
        let lines = self.rows.iter().map(|row| (line(row, plane), matrix.iter().map(|&at| number(row, at)).collect()));
        Ok((self.stated(&matrix)?, Some(head), lines.collect()))
    }

    /// By the units of the columns, which must be one.
    fn stated(&self, matrix: &[usize]) -> Found<Stated> {
        let mut units = matrix.iter().map(|&at| self.columns[at].units.to_lowercase());
        let first = units.next().unwrap_or_default();
        if let Some(other) = units.find(|one| *one != first) {
            return Err(format!("columns have the units {first} and {other}, expected one"));
        }
        Ok(Stated::of_units(&first))
    }
}

/// `H1#2` as the lattice counts it, `H1[2]`.
fn numbered(name: &str) -> String {
    match name.split_once('#') {
        Some((name, number)) => format!("{name}[{number}]"),
        None => name.into(),
    }
}

/// Name of a corrector, without elegant's item, which may say its plane.
fn corrector(column: &str, plane: &str) -> String {
    let items = [(".HKICK", "x:"), (".VKICK", "y:"), (".KICK", plane)];
    let item = items.into_iter().find_map(|(item, plane)| Some((column.strip_suffix(item)?, plane)));
    let (name, plane) = item.unwrap_or((column, plane));
    format!("{plane}{}", numbered(name))
}

/// The values of a page, in their order.
trait Values {
    fn next(&mut self, kind: Kind) -> Found<Value>;

    /// Beyond a parameter, which nothing here needs.
    fn parameter(&mut self, kind: Kind) -> Found<()> {
        self.next(kind).map(drop)
    }

    /// Number of the rows; none where they go on to the end of the page.
    fn count(&mut self, is_stated: bool) -> Found<Option<u64>>;

    /// True where nothing is left.
    fn is_empty(&mut self) -> bool;

    /// True where the number of rows stands before the parameters.
    fn counts_first(&self) -> bool;
}

fn page(
    from: &mut dyn Values,
    (parameters, arrays, columns): (&[Kind], &[(Kind, usize)], &[Column]),
    (is_uncounted, by_columns): (bool, bool),
) -> Found<Vec<Vec<Value>>> {
    let memory = Budget::new(MEMORY);
    let next = |from: &mut dyn Values, kind| {
        memory.take(VALUE).map_err(|exceeded| exceeded.to_string())?;
        from.next(kind)
    };
    let mut count = if from.counts_first() { from.count(true)? } else { None };
    parameters.iter().try_for_each(|kind| from.parameter(*kind))?;
    for &(kind, dimensions) in arrays {
        let mut elements = 1.0;
        for _ in 0..dimensions {
            let Value::Number(size) = next(from, Kind::Long)? else {
                return Err("a dimension that is no number".into());
            };
            elements *= size;
        }
        let mut left = elements;
        while left > 0.0 {
            next(from, kind)?;
            left -= 1.0;
        }
    }
    if !from.counts_first() {
        count = from.count(!is_uncounted)?;
    }
    let mut rows: Vec<Vec<Value>> = Vec::new();
    if by_columns {
        let count = count.ok_or("columns one after the other need the number of rows")?;
        for column in columns {
            for row in 0..count {
                let value = next(from, column.kind)?;
                match rows.get_mut(row as usize) {
                    Some(own) => own.push(value),
                    None => rows.push(vec![value]),
                }
            }
        }
    } else {
        while count.map_or_else(|| !from.is_empty(), |count| (rows.len() as u64) < count) {
            rows.push(columns.iter().map(|column| next(from, column.kind)).collect::<Found<_>>()?);
        }
    }
    if from.is_empty() { Ok(rows) } else { Err("more than one page, expected one response".into()) }
}

/// The rest of a header.
struct Header<'a> {
    rest: &'a [u8],
    is_little: bool,
}

impl Header<'_> {
    /// The next line.
    fn line(&mut self) -> Found<String> {
        let end = self.rest.iter().position(|byte| *byte == b'\n').ok_or("cut off within its header")?;
        TEXT.check(end as u64).map_err(|exceeded| exceeded.to_string())?;
        let (line, rest) = self.rest.split_at(end);
        self.rest = &rest[1..];
        Ok(String::from_utf8_lossy(line).trim().to_owned())
    }

    /// `&column name=x, units=m, &end` over some lines.
    fn command(&mut self) -> Found<(String, HashMap<String, String>)> {
        let mut text = String::new();
        while !text.ends_with("&end") {
            let line = self.line()?;
            match line.strip_prefix('!') {
                Some(comment) if comment.contains("big-endian") => self.is_little = false,
                Some(_) => {}
                None if line.is_empty() => {}
                None => text.extend([" ", line.as_str()]),
            }
            TEXT.check(text.len() as u64).map_err(|exceeded| exceeded.to_string())?;
        }
        let body = text.strip_suffix("&end").unwrap_or_default().trim();
        let (command, words) = body.split_once(char::is_whitespace).unwrap_or((body, ""));
        let command =
            command.strip_prefix('&').ok_or_else(|| format!("expected a command such as &column, found {command}"))?;
        Ok((command.to_lowercase(), assignments(words)))
    }
}

/// `name=x, text="a, b"`.
fn assignments(words: &str) -> HashMap<String, String> {
    let mut all = HashMap::new();
    let mut rest = words;
    while let Some((key, after)) = rest.split_once('=') {
        let after = after.trim_start();
        let (value, next) = match after.strip_prefix('"') {
            Some(quoted) => quoted_text(quoted),
            None => {
                let (value, next) = after.split_once([',', ' ', '\t']).unwrap_or((after, ""));
                (value.trim().into(), next)
            }
        };
        all.insert(key.trim_matches([' ', ',', '\t']).to_owned(), value);
        rest = next;
    }
    all
}

/// Text up to the quotation mark that ends it, and what is behind that.
fn quoted_text(text: &str) -> (String, &str) {
    let mut value = String::new();
    let mut letters = text.char_indices();
    while let Some((at, letter)) = letters.next() {
        match letter {
            '"' => return (value, &text[at + 1..]),
            '\\' => value.extend(letters.next().map(|(_, letter)| letter)),
            letter => value.push(letter),
        }
    }
    (value, "")
}

/// Values as text: parameters a line each, rows and arrays by words.
struct Ascii<'a> {
    rest: &'a str,
}

impl<'a> Ascii<'a> {
    fn of(bytes: &'a [u8]) -> Found<Self> {
        let rest = str::from_utf8(bytes).map_err(|_| "expected data in ASCII")?;
        Ok(Self { rest })
    }

    /// Beyond blanks and lines of comment.
    fn skip(&mut self) {
        self.rest = self.rest.trim_start();
        while self.rest.starts_with('!') {
            self.rest = self.rest.split_once('\n').map_or("", |(_, rest)| rest).trim_start();
        }
    }

    fn word(&mut self) -> Found<String> {
        self.skip();
        if let Some(quoted) = self.rest.strip_prefix('"') {
            let (value, rest) = quoted_text(quoted);
            self.rest = rest;
            return Ok(value);
        }
        let (word, rest) = self.rest.split_at(self.rest.find(char::is_whitespace).unwrap_or(self.rest.len()));
        self.rest = rest;
        if word.is_empty() { Err("cut off within its rows".into()) } else { Ok(word.into()) }
    }
}

impl Values for Ascii<'_> {
    /// A line, whatever is in it.
    fn parameter(&mut self, _kind: Kind) -> Found<()> {
        loop {
            let (line, rest) = self.rest.split_once('\n').ok_or("cut off within its parameters")?;
            self.rest = rest;
            if !line.starts_with('!') {
                return Ok(());
            }
        }
    }

    fn next(&mut self, kind: Kind) -> Found<Value> {
        let word = self.word()?;
        match kind {
            Kind::String | Kind::Character => Ok(Value::Text(word)),
            _ => word.parse().map(Value::Number).map_err(|_| format!("expected a number, found {word}")),
        }
    }

    fn count(&mut self, is_stated: bool) -> Found<Option<u64>> {
        if !is_stated {
            return Ok(None);
        }
        let word = self.word()?;
        word.parse().map(Some).map_err(|_| format!("expected the number of rows, found {word}"))
    }

    fn is_empty(&mut self) -> bool {
        self.skip();
        self.rest.is_empty()
    }

    fn counts_first(&self) -> bool {
        false
    }
}

/// Values as bytes.
struct Binary<'a> {
    rest: &'a [u8],
    is_little: bool,
}

impl Binary<'_> {
    fn take<const N: usize>(&mut self) -> Found<[u8; N]> {
        let (bytes, rest) = self.rest.split_first_chunk::<N>().ok_or("cut off within its data")?;
        self.rest = rest;
        let mut bytes = *bytes;
        if !self.is_little {
            bytes.reverse();
        }
        Ok(bytes)
    }

    fn text(&mut self) -> Found<String> {
        let length = i32::from_le_bytes(self.take()?);
        let (text, rest) = usize::try_from(length)
            .ok()
            .and_then(|length| self.rest.split_at_checked(length))
            .ok_or_else(|| format!("a string of {length} bytes, {} are left", self.rest.len()))?;
        self.rest = rest;
        TEXT.check(text.len() as u64).map_err(|exceeded| exceeded.to_string())?;
        Ok(String::from_utf8_lossy(text).into_owned())
    }
}

impl Values for Binary<'_> {
    fn next(&mut self, kind: Kind) -> Found<Value> {
        Ok(Value::Number(match kind {
            Kind::Short => i16::from_le_bytes(self.take()?).into(),
            Kind::UShort => u16::from_le_bytes(self.take()?).into(),
            Kind::Long => i32::from_le_bytes(self.take()?).into(),
            Kind::ULong => u32::from_le_bytes(self.take()?).into(),
            Kind::Long64 => i64::from_le_bytes(self.take()?) as f64,
            Kind::ULong64 => u64::from_le_bytes(self.take()?) as f64,
            Kind::Float => f32::from_le_bytes(self.take()?).into(),
            Kind::Double => f64::from_le_bytes(self.take()?),
            Kind::Character => return Ok(Value::Text(char::from(self.take::<1>()?[0]).into())),
            Kind::String => return Ok(Value::Text(self.text()?)),
        }))
    }

    /// A number that does not fit is announced by the least one.
    fn count(&mut self, _is_stated: bool) -> Found<Option<u64>> {
        let stated = match i32::from_le_bytes(self.take()?) {
            i32::MIN => i64::from_le_bytes(self.take()?),
            short => short.into(),
        };
        u64::try_from(stated).map(Some).map_err(|_| format!("{stated} rows"))
    }

    fn is_empty(&mut self) -> bool {
        self.rest.is_empty()
    }

    fn counts_first(&self) -> bool {
        true
    }
}
