//! A history as it is read, also while a daemon writes it.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use super::TIERS;
use super::files::{HistoryError, numbered};
use super::row::{Columns, Row};
use crate::health::State;

/// From when until when [ms since 1970], both included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Span {
    /// The beginning.
    pub since_ms: u64,
    /// The end.
    pub until_ms: u64,
}

impl Default for Span {
    fn default() -> Self {
        Self { since_ms: 0, until_ms: u64::MAX }
    }
}

/// Rows in the order of time, all with the same columns.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct History {
    /// Of whose numbers: those of the newest file, and others that older files have.
    pub columns: Columns,
    /// What was kept: numbers that an older file does not have are none.
    pub rows: Vec<Row>,
    /// Lines that are damaged; the last one of a file, if it is not whole, is being written.
    pub damaged: u64,
}

/// The history in a folder: every row of the finest tier that reaches back to its time.
///
/// # Errors
/// [`HistoryError`] if there is none.
pub fn read(folder: &Path, span: &Span) -> Result<History, HistoryError> {
    let mut history = History::default();
    let mut until_ms = span.until_ms;
    let mut tiers: Vec<Vec<Row>> = Vec::new();
    let mut is_there = false;
    for tier in TIERS {
        let files = numbered(folder, tier);
        is_there |= !files.is_empty();
        let of_files = files.iter().rev().map(|(_, path)| read_file(path, &mut history));
        let of_files: Vec<Vec<Row>> = of_files.collect::<Result<_, _>>()?;
        let mut rows: Vec<Row> = of_files.into_iter().rev().flatten().collect();
        let first = rows.iter().map(|row| row.time_ms).min();
        rows.retain(|row| (span.since_ms..=until_ms).contains(&row.time_ms));
        // coarser rows only before the finer ones
        until_ms = first.map_or(until_ms, |first| until_ms.min(first.saturating_sub(1)));
        tiers.push(rows);
    }
    if !is_there {
        let reason = if folder.is_dir() { "no history there" } else { "folder not found" };
        return Err(HistoryError::of(folder, reason));
    }
    history.rows = tiers.into_iter().rev().flatten().collect();
    // a clock that was put back: what happened first stays first within a tier, times tell of tiers
    history.rows.sort_by_key(|row| row.time_ms);
    Ok(history)
}

/// The rows of a file by the columns of the history, which grow by those of the file.
fn read_file(path: &PathBuf, history: &mut History) -> Result<Vec<Row>, HistoryError> {
    let bytes = match fs::read(path) {
        Ok(bytes) => bytes,
        // it was the oldest, and was removed just now
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(HistoryError::of(path, error)),
    };
    let mut lines = bytes.split_inclusive(|byte| *byte == b'\n').filter_map(|line| line.strip_suffix(b"\n"));
    let text = |line| core::str::from_utf8(line).unwrap_or_default();
    let Some(first) = lines.next() else { return Ok(Vec::new()) };
    let Some(columns) = Columns::of_header(text(first)) else {
        history.damaged += 1;
        return Ok(Vec::new());
    };
    let places = Places::of(&columns, &mut history.columns);
    let mut rows = Vec::new();
    for line in lines {
        match Row::of_line(text(line), &columns) {
            Some(row) => rows.push(places.put(row)),
            None => history.damaged += 1,
        }
    }
    Ok(rows)
}

/// Where the numbers of a file go.
struct Places {
    vars: Vec<usize>,
    states: Vec<usize>,
    /// Nothing has to be moved.
    is_same: bool,
}

impl Places {
    fn of(columns: &Columns, all: &mut Columns) -> Self {
        let is_same = columns == all;
        let place = |names: &mut Vec<String>, name: &String| {
            names.iter().position(|there| there == name).unwrap_or_else(|| {
                names.push(name.clone());
                names.len() - 1
            })
        };
        let vars = columns.vars.iter().map(|name| place(&mut all.vars, name)).collect();
        let states = columns.instruments.iter().map(|name| place(&mut all.instruments, name)).collect();
        Self { vars, states, is_same: is_same || columns == all }
    }

    fn put(&self, row: Row) -> Row {
        if self.is_same {
            return row;
        }
        let length = |places: &[usize]| places.iter().max().map_or(0, |last| last + 1);
        let mut vars = vec![[f32::NAN; 2]; length(&self.vars)];
        let mut states = vec![State::Ok; length(&self.states)];
        self.vars.iter().zip(&row.vars).for_each(|(place, var)| vars[*place] = *var);
        self.states.iter().zip(&row.states).for_each(|(place, state)| states[*place] = *state);
        Row { vars, states, ..row }
    }
}

impl History {
    /// Mean and standard deviation of a var in a row; not a number where the row has none.
    pub fn var(&self, row: &Row, var: usize) -> [f32; 2] {
        row.vars.get(var).copied().unwrap_or([f32::NAN; 2])
    }

    /// Instruments that were not ok in a row.
    pub fn unwell<'h>(&'h self, row: &'h Row) -> impl Iterator<Item = (&'h str, State)> {
        let each = self.columns.instruments.iter().zip(&row.states);
        each.filter(|(_, state)| **state != State::Ok).map(|(name, state)| (name.as_str(), *state))
    }
}

#[cfg(test)]
mod tests {
    use super::super::row::tests::{columns, row};
    use super::*;

    fn write(folder: &Path, name: &str, columns: &Columns, times: &[u64]) {
        let lines: String = times.iter().map(|time| row(*time).line()).collect();
        fs::write(folder.join(name), columns.header() + &lines).unwrap();
    }

    fn times(folder: &Path, span: &Span) -> Vec<u64> {
        read(folder, span).unwrap().rows.iter().map(|row| row.time_ms).collect()
    }

    #[test]
    fn finer_rows_stand_for_coarser_ones_of_their_time() {
        let folder = tempfile::tempdir().unwrap();
        write(folder.path(), "hours-00000000.csv", &columns(), &[0, 100, 200]);
        write(folder.path(), "minutes-00000003.csv", &columns(), &[90, 120, 150, 180]);
        write(folder.path(), "fine-00000009.csv", &columns(), &[170, 171]);
        write(folder.path(), "fine-00000010.csv", &columns(), &[172]);
        assert_eq!(times(folder.path(), &Span::default()), [0, 90, 120, 150, 170, 171, 172]);
        assert_eq!(times(folder.path(), &Span { since_ms: 100, until_ms: 171 }), [120, 150, 170, 171]);
    }

    #[test]
    fn a_line_that_is_being_written_is_left_out_and_a_damaged_one_is_counted() {
        let folder = tempfile::tempdir().unwrap();
        let half = &row(3).line()[..40];
        let text = columns().header() + &row(1).line() + "1,2\n" + &row(2).line() + half;
        fs::write(folder.path().join("fine-00000000.csv"), text).unwrap();
        let history = read(folder.path(), &Span::default()).unwrap();
        assert_eq!((history.rows.len(), history.damaged), (2, 1));
    }

    #[test]
    fn an_older_machine_has_its_own_names() {
        let folder = tempfile::tempdir().unwrap();
        let older = Columns { vars: vec!["B2".into(), "A2".into()], instruments: vec!["x_C6".into(), "V".into()] };
        write(folder.path(), "fine-00000000.csv", &older, &[1]);
        write(folder.path(), "fine-00000001.csv", &columns(), &[2]);
        let history = read(folder.path(), &Span::default()).unwrap();
        assert_eq!(history.columns.vars, ["A2", "odd, name", "B2"]);
        assert_eq!(history.var(&history.rows[0], 2), row(0).vars[0]);
        assert!(history.var(&history.rows[0], 1)[0].is_nan() && history.var(&history.rows[1], 2)[0].is_nan());
        assert_eq!(history.unwell(&history.rows[1]).collect::<Vec<_>>(), [("x_C6", State::Noisy)]);
    }

    #[test]
    fn no_history_is_said() {
        let folder = tempfile::tempdir().unwrap();
        assert!(read(folder.path(), &Span::default()).unwrap_err().to_string().ends_with("no history there"));
        let missing = read(&folder.path().join("no"), &Span::default()).unwrap_err();
        assert!(missing.to_string().ends_with("folder not found"));
    }
}
