//! `orbitcal history`: what a daemon has estimated over hours and months.

use std::path::{Path, PathBuf};

use host_bridge::config::Config;
use host_bridge::history::{self, History, Row, Span};
use results::output::{self, OutputError, table};
use schemars::JsonSchema;
use serde::Serialize;

use super::{CommandError, check_outputs};
use crate::cli;

/// Vars that fit beside the rest in a table.
const VARS: usize = 2;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &cli::History) -> Result<(), CommandError> {
    check_outputs([options.json.as_deref(), options.csv.as_deref()])?;
    let folder = folder(&options.from)?;
    let span =
        Span { since_ms: options.since.unwrap_or(0), until_ms: options.until.unwrap_or(Span::default().until_ms) };
    let history = history::read(&folder, &span)?;
    let vars = chosen(&history, &options.vars)?;
    if history.damaged > 0 {
        output::warn(format_args!("{}: {} damaged lines are left out", folder.display(), history.damaged));
    }
    if let Some(path) = &options.json {
        output::json(path, &HistoryResult::of(&history, &vars))?;
    }
    if let Some(path) = &options.csv {
        let text = as_csv(&history, &vars);
        if path == Path::new("-") { output::say(text.trim_end())? } else { output::bytes(path, text.as_bytes())? }
    }
    let is_taken = [&options.json, &options.csv].into_iter().flatten().any(|path| path == Path::new("-"));
    if options.quiet || is_taken { Ok(()) } else { show(&history, &vars, options) }
}

/// The folder of a configuration's history, or the folder itself.
fn folder(from: &Path) -> Result<PathBuf, CommandError> {
    if from.is_dir() {
        return Ok(from.to_owned());
    }
    let none = || CommandError::Input(format!("{}: history.folder is not given", from.display()));
    Config::read(from)?.history.folder.ok_or_else(none)
}

/// Vars by their names; all of them without any.
fn chosen(history: &History, names: &[String]) -> Result<Vec<usize>, CommandError> {
    let there = &history.columns.vars;
    let find = |name: &String| {
        let wrong = || CommandError::Input(format!("no var {name} in the history; there are {}", there.join(", ")));
        there.iter().position(|each| each == name).ok_or_else(wrong)
    };
    if names.is_empty() { Ok((0..there.len()).collect()) } else { names.iter().map(find).collect() }
}

fn show(history: &History, vars: &[usize], options: &cli::History) -> Result<(), CommandError> {
    let rows = evenly(&history.rows, options.rows);
    let is_chosen = !options.vars.is_empty();
    // without a choice each row names the var that is farthest from 1
    let columns: Vec<Option<usize>> =
        if is_chosen { vars.iter().take(VARS).copied().map(Some).collect() } else { vec![None] };
    let title = |column: &Option<usize>| column.map_or("farthest from 1", |var| &history.columns.vars[var]).to_owned();
    let titles: Vec<String> = columns.iter().map(title).collect();
    let mut shown = table(
        ["time (UTC)", "chi2/dof", "model"].into_iter().chain(titles.iter().map(String::as_str)).chain(["not ok"]),
    );
    for row in &rows {
        let cells =
            columns.iter().map(|column| cell(history, row, column.or_else(|| farthest(history, row, vars)), is_chosen));
        let first = [time(row.time_ms), format!("{:.3}", row.chi_square[0] / row.chi_square[1].max(1.0)), fits(row)];
        shown.add_row(first.into_iter().chain(cells).chain([unwell(history, row)]));
    }
    let of = if rows.len() < history.rows.len() { format!(", {} of them below", rows.len()) } else { String::new() };
    output::say(format_args!("{} estimates{of}", history.rows.len()))?;
    if !rows.is_empty() {
        output::say(shown)?;
    }
    if is_chosen && vars.len() > VARS {
        output::say(format_args!("a table has room for {VARS} vars; --csv and --json have all"))?;
    }
    Ok(())
}

/// So many of the rows, the first and the last among them.
fn evenly(rows: &[Row], count: usize) -> Vec<&Row> {
    if rows.len() <= count {
        return rows.iter().collect();
    }
    let at = |i: usize| i * (rows.len() - 1) / count.saturating_sub(1).max(1);
    (0..count).map(|i| &rows[at(i)]).collect()
}

fn farthest(history: &History, row: &Row, vars: &[usize]) -> Option<usize> {
    let deviation = |var: usize| {
        let [mean, sigma] = history.var(row, var);
        ((mean - 1.0) / sigma).abs()
    };
    let numbers = vars.iter().copied().filter(|var| deviation(*var).is_finite());
    numbers.max_by(|one, other| deviation(*one).total_cmp(&deviation(*other)))
}

fn cell(history: &History, row: &Row, var: Option<usize>, is_named_above: bool) -> String {
    let Some(var) = var else { return String::new() };
    let [mean, sigma] = history.var(row, var);
    let name = if is_named_above { String::new() } else { format!("{} ", history.columns.vars[var]) };
    if mean.is_nan() { "-".to_owned() } else { format!("{name}{mean:.4} ± {sigma:.4}") }
}

fn fits(row: &Row) -> String {
    let word = match (row.mismatch, row.is_usable) {
        (true, _) => "disagrees",
        (false, true) => "fits",
        (false, false) => "not usable",
    };
    word.to_owned()
}

/// Instruments that were not ok: a few by name, else how many.
fn unwell(history: &History, row: &Row) -> String {
    let all: Vec<String> = history.unwell(row).map(|(name, state)| format!("{name} {}", state.word())).collect();
    if all.len() <= 3 { all.join(", ") } else { format!("{} and {} more", all[..2].join(", "), all.len() - 2) }
}

/// In UTC, to the second.
fn time(time_ms: u64) -> String {
    let moment = i64::try_from(time_ms).ok().and_then(|ms| jiff::Timestamp::from_millisecond(ms).ok());
    moment.map_or_else(|| time_ms.to_string(), |moment| moment.strftime("%Y-%m-%d %H:%M:%S").to_string())
}

/// What the history holds. Field names are those of the command's JSON.
#[derive(Debug, Serialize, JsonSchema)]
pub(super) struct HistoryResult<'h> {
    rows: Vec<RowResult<'h>>,
    /// Lines that could not be read.
    damaged: u64,
}

/// An estimate; a number that the daemon did not have is null.
#[derive(Debug, Serialize, JsonSchema)]
struct RowResult<'h> {
    /// In UTC, to the second.
    time: String,
    time_ms: u64,
    sequence: u32,
    frames: u32,
    usable: bool,
    mismatch: bool,
    chi_square: Option<f32>,
    degrees_of_freedom: Option<f32>,
    nis_per_reading: Option<f32>,
    vars: Vec<VarResult<'h>>,
    /// Monitors and correctors that were not ok.
    not_ok: Vec<Unwell<'h>>,
}

#[derive(Debug, Serialize, JsonSchema)]
struct VarResult<'h> {
    name: &'h str,
    mean: Option<f32>,
    sigma: Option<f32>,
}

#[derive(Debug, Serialize, JsonSchema)]
struct Unwell<'h> {
    name: &'h str,
    state: &'static str,
}

impl<'h> HistoryResult<'h> {
    fn of(history: &'h History, vars: &[usize]) -> Self {
        Self {
            rows: history.rows.iter().map(|row| RowResult::of(history, row, vars)).collect(),
            damaged: history.damaged,
        }
    }
}

impl<'h> RowResult<'h> {
    fn of(history: &'h History, row: &'h Row, vars: &[usize]) -> Self {
        let [chi_square, degrees_of_freedom] = row.chi_square.map(finite);
        let var = |var: &usize| {
            let [mean, sigma] = history.var(row, *var).map(finite);
            VarResult { name: &history.columns.vars[*var], mean, sigma }
        };
        Self {
            time: time(row.time_ms).replace(' ', "T") + "Z",
            time_ms: row.time_ms,
            sequence: row.sequence,
            frames: row.frames,
            usable: row.is_usable,
            mismatch: row.mismatch,
            chi_square,
            degrees_of_freedom,
            nis_per_reading: finite(row.nis_per_reading),
            vars: vars.iter().map(var).collect(),
            not_ok: history.unwell(row).map(|(name, state)| Unwell { name, state: state.word() }).collect(),
        }
    }
}

fn finite(value: f32) -> Option<f32> {
    Some(value).filter(|value| value.is_finite())
}

fn as_csv(history: &History, vars: &[usize]) -> String {
    let mut rows = csv::Writer::from_writer(Vec::new());
    let names = vars.iter().map(|var| &history.columns.vars[*var]);
    let names = names.flat_map(|name| [format!("{name}_mean"), format!("{name}_sigma")]);
    let first = ["time", "sequence", "frames", "usable", "mismatch", "chi_square", "degrees_of_freedom", "not_ok"];
    let mut write = |fields: Vec<String>| rows.write_record(fields).expect("memory takes any row");
    write(first.iter().map(|name| (*name).to_owned()).chain(names).collect());
    for row in &history.rows {
        let unwell: Vec<String> = history.unwell(row).map(|(name, state)| format!("{name} {}", state.word())).collect();
        let [usable, mismatch] = [row.is_usable, row.mismatch].map(|is_so| u8::from(is_so).to_string());
        let own = [
            time(row.time_ms).replace(' ', "T") + "Z",
            row.sequence.to_string(),
            row.frames.to_string(),
            usable,
            mismatch,
            row.chi_square[0].to_string(),
            row.chi_square[1].to_string(),
            unwell.join(" "),
        ];
        let values = vars.iter().flat_map(|var| history.var(row, *var)).map(|value| value.to_string());
        write(own.into_iter().chain(values).collect());
    }
    let bytes = rows.into_inner().map_err(|error| OutputError::of(Path::new("rows"), error.error()));
    String::from_utf8(bytes.expect("memory takes any row")).expect("names and numbers are UTF-8")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_has_the_first_and_the_last_row() {
        let row = |time_ms| Row {
            time_ms,
            sequence: 0,
            frames: 0,
            is_usable: true,
            mismatch: false,
            chi_square: [1.0; 2],
            nis_per_reading: 1.0,
            vars: vec![],
            states: vec![],
        };
        let rows: Vec<Row> = (0..100).map(row).collect();
        let times = |count| evenly(&rows, count).iter().map(|row| row.time_ms).collect::<Vec<_>>();
        assert_eq!((times(4), times(1), times(0).len(), times(200).len()), (vec![0, 33, 66, 99], vec![0], 0, 100));
        assert_eq!(time(1_764_009_000_000), "2025-11-24 18:30:00");
    }
}
