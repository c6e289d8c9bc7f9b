//! Draws as CmdStan's CSV files, one a chain, for `arviz.from_cmdstan(posterior=[...])` and what else reads them.
//!
//! A line of columns, then one line a draw: seven statistics whose names end in `__`, then the quantities. Numbers are
//! as short as reads back to the same bits. An infinite or undefined number is `inf`, `-inf` or `NaN`, and is read as
//! such.
//!
//! Source: CmdStan User's Guide, Stan CSV files; ArviZ 0.23, `from_cmdstan`.

use std::fs;
use std::io::{BufWriter, ErrorKind, Write};
use std::path::{Path, PathBuf};

use csv::{ReaderBuilder, StringRecord, Writer};
use tempfile::NamedTempFile;

use crate::draws::{Chain, DrawStats, Draws, DrawsError};
use crate::recording::{Mismatch, Part, Place};

/// CmdStan's names of [`DrawStats`]' fields, in their order.
const STATS: [&str; 7] =
    ["lp__", "accept_stat__", "stepsize__", "treedepth__", "n_leapfrog__", "divergent__", "energy__"];

impl Draws {
    /// Writes `chain-1.csv` and so on, each whole or not at all, and gives their paths.
    ///
    /// The folder is made where there is none. Chains of an earlier run beyond the last are removed, so that no reader
    /// takes the two runs for one.
    ///
    /// # Errors
    /// [`DrawsError::Name`], [`DrawsError::Length`] and [`DrawsError::Values`] before anything is written;
    /// [`DrawsError::Unwritable`].
    pub fn write(&self, folder: &Path) -> Result<Vec<PathBuf>, DrawsError> {
        self.check()?;
        fs::create_dir_all(folder).map_err(|error| DrawsError::Unwritable(folder.into(), error.kind()))?;
        let files: Vec<PathBuf> = (1..=self.chains.len()).map(|number| path(folder, number)).collect();
        for (file, chain) in files.iter().zip(&self.chains) {
            write(&self.names, chain, file).map_err(|error| DrawsError::Unwritable(file.clone(), error.kind()))?;
        }
        remove_beyond(folder, files.len())?;
        Ok(files)
    }

    /// Reads the files that [`Draws::write`] leaves in a folder.
    ///
    /// # Errors
    /// The first fault met, with its file and line.
    pub fn read(folder: &Path) -> Result<Self, DrawsError> {
        let mut draws = Self::default();
        let count = numbers(folder).len().max(1); // a gap in the numbers, or no file at all, is a file that is not there
        for number in 1..=count {
            let (names, chain) = read(&path(folder, number), draws.chains.first().map(|_| draws.names.as_slice()))?;
            draws.names = names;
            draws.chains.push(chain);
        }
        draws.check()?;
        Ok(draws)
    }
}

fn path(folder: &Path, number: usize) -> PathBuf {
    folder.join(format!("chain-{number}.csv"))
}

/// Numbers of the chains that lie in a folder.
fn numbers(folder: &Path) -> Vec<usize> {
    let number = |name: &str| name.strip_prefix("chain-")?.strip_suffix(".csv")?.parse().ok();
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter_map(|entry| number(entry.file_name().to_str()?)).collect()
}

fn remove_beyond(folder: &Path, last: usize) -> Result<(), DrawsError> {
    for number in numbers(folder).into_iter().filter(|&number| number > last) {
        let file = path(folder, number);
        fs::remove_file(&file).map_err(|error| DrawsError::Unwritable(file, error.kind()))?;
    }
    Ok(())
}

fn write(names: &[String], chain: &Chain, file: &Path) -> std::io::Result<()> {
    let mut rows = Writer::from_writer(BufWriter::new(temporary(file)?));
    rows.write_record(STATS.into_iter().chain(names.iter().map(String::as_str)))?;
    for (stats, draw) in chain.stats.iter().zip(&chain.draws) {
        rows.write_record(cells(stats).into_iter().chain(draw.iter().map(number)))?;
    }
    let mut buffer = rows.into_inner().map_err(|error| error.into_error())?;
    buffer.flush()?;
    buffer.into_inner()?.persist(file)?;
    Ok(())
}

/// A file beside its final place, readable to all that may read what this user makes, unlike other temporary files.
fn temporary(file: &Path) -> std::io::Result<NamedTempFile> {
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut builder = tempfile::Builder::new();
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(fs::Permissions::from_mode(0o666)); // less the umask, as open(2) does
    }
    builder.tempfile_in(folder)
}

fn cells(stats: &DrawStats) -> [String; STATS.len()] {
    let DrawStats { lp, acceptance, step_size, depth, leapfrogs, divergent, energy } = stats;
    [
        number(lp),
        number(acceptance),
        number(step_size),
        depth.to_string(),
        leapfrogs.to_string(),
        u8::from(*divergent).to_string(),
        number(energy),
    ]
}

/// With an exponent where it is far from 1: `Display` writes out up to 300 zeros.
fn number(value: &f64) -> String {
    format!("{value:?}")
}

/// The names of the quantities, which must be those `expected`, and their draws.
fn read(file: &Path, expected: Option<&[String]>) -> Result<(Vec<String>, Chain), DrawsError> {
    let unreadable = |error| unreadable(file, error);
    let mut rows = ReaderBuilder::new().flexible(true).quoting(false).from_path(file).map_err(unreadable)?;
    let columns = rows.headers().map_err(unreadable)?.clone();
    check_columns(file, &columns, expected)?;
    let mut chain = Chain::default();
    for record in rows.records() {
        let mut cells = Cells::new(file, &columns, record.map_err(unreadable)?)?;
        chain.stats.push(cells.stats()?);
        chain.draws.push(cells.draw()?);
    }
    Ok((columns.iter().skip(STATS.len()).map(String::from).collect(), chain))
}

fn unreadable(file: &Path, error: csv::Error) -> DrawsError {
    let kind = match error.into_kind() {
        csv::ErrorKind::Io(error) => error.kind(),
        _ => ErrorKind::InvalidData, // no UTF-8; lines may differ in length here
    };
    DrawsError::Unreadable(file.into(), kind)
}

/// Reports the first column that differs from the statistics, followed by the expected names where there are some.
fn check_columns(file: &Path, columns: &StringRecord, expected: Option<&[String]>) -> Result<(), DrawsError> {
    let end = "the end of the line";
    let count = expected.map_or(columns.len(), |names| STATS.len() + names.len());
    for i in 0..STATS.len().max(count).max(columns.len()) {
        let found = columns.get(i).unwrap_or(end);
        let wanted = match (STATS.get(i), expected) {
            (Some(stat), _) => stat,
            (None, Some(names)) => names.get(i - STATS.len()).map_or(end, String::as_str),
            (None, None) => found,
        };
        if wanted != found {
            let at = Place { file: file.into(), line: 1, part: Part::Column((i + 1).to_string()) };
            return Err(DrawsError::Columns(Mismatch { at, expected: wanted.into(), found: format!("{found:?}") }));
        }
    }
    Ok(())
}

/// The cells of one line, taken from left to right.
struct Cells<'a> {
    file: &'a Path,
    columns: &'a StringRecord,
    record: StringRecord,
    taken: usize,
}

impl<'a> Cells<'a> {
    fn new(file: &'a Path, columns: &'a StringRecord, record: StringRecord) -> Result<Self, DrawsError> {
        let (need, found) = (columns.len(), record.len());
        let cells = Self { file, columns, record, taken: 0 };
        if found != need {
            let (expected, found) = (format!("{need} cells"), found.to_string());
            return Err(DrawsError::CellCount(Mismatch { at: cells.place(Part::Whole), expected, found }));
        }
        Ok(cells)
    }

    /// The statistics, in the order of [`STATS`].
    fn stats(&mut self) -> Result<DrawStats, DrawsError> {
        Ok(DrawStats {
            lp: self.number()?,
            acceptance: self.number()?,
            step_size: self.number()?,
            depth: self.count()?,
            leapfrogs: self.count()?,
            divergent: self.flag()?,
            energy: self.number()?,
        })
    }

    /// All that follows.
    fn draw(&mut self) -> Result<Vec<f64>, DrawsError> {
        (self.taken..self.columns.len()).map(|_| self.number()).collect()
    }

    fn number(&mut self) -> Result<f64, DrawsError> {
        self.take("a number", |cell| cell.parse().ok())
    }

    fn count(&mut self) -> Result<u64, DrawsError> {
        self.take("a whole number", |cell| cell.parse().ok())
    }

    fn flag(&mut self) -> Result<bool, DrawsError> {
        self.take("0 or 1", |cell| match cell {
            "0" => Some(false),
            "1" => Some(true),
            _ => None,
        })
    }

    fn take<T>(&mut self, expected: &str, parse: impl FnOnce(&str) -> Option<T>) -> Result<T, DrawsError> {
        let (cell, column) = (&self.record[self.taken], &self.columns[self.taken]);
        let value = parse(cell).ok_or_else(|| {
            let at = self.place(Part::Column(column.into()));
            DrawsError::Cell(Mismatch { at, expected: expected.into(), found: format!("{cell:?}") })
        });
        self.taken += 1;
        value
    }

    fn place(&self, part: Part) -> Place {
        let line = self.record.position().map_or(0, |position| position.line()) as usize;
        Place { file: self.file.into(), line, part }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stats(seed: f64) -> DrawStats {
        DrawStats {
            lp: -seed,
            acceptance: 1.0 / seed,
            step_size: 0.1,
            depth: 3,
            leapfrogs: 7,
            divergent: seed > 2.5,
            energy: 1e-300 * seed,
        }
    }

    /// Values that are hard to print.
    fn draws(chains: usize) -> Draws {
        let chain = Chain {
            draws: vec![vec![0.1 + 0.2, f64::MIN_POSITIVE], vec![-0.0, f64::INFINITY], vec![f64::MAX, 1.0 / 3.0]],
            stats: [1.0, 2.0, 3.0].map(stats).to_vec(),
        };
        Draws { names: vec!["A2".into(), "vars.1".into()], chains: vec![chain; chains] }
    }

    /// Writes two chains, changes the one `old` of a chain's file to `new`, and reads them; the path starts at the
    /// folder.
    fn edited(number: usize, old: &str, new: &str) -> String {
        let folder = tempfile::tempdir().expect("a temporary folder can be made");
        let files = draws(2).write(folder.path()).expect("it is writable");
        let text = fs::read_to_string(&files[number - 1]).expect("it was written");
        assert_eq!(text.matches(old).count(), 1, "{old} stands once in the file");
        fs::write(&files[number - 1], text.replace(old, new)).expect("it is writable");
        let error = Draws::read(folder.path()).expect_err(new).to_string();
        error.replace(&format!("{}/", folder.path().display()), "")
    }

    #[test]
    fn draws_read_back_to_the_same_bits() {
        let folder = tempfile::tempdir().expect("a temporary folder can be made");
        let files = draws(2).write(&folder.path().join("new/run")).expect("it is writable");
        assert_eq!(files.iter().map(|file| file.file_name().expect("a file")).collect::<Vec<_>>(), {
            ["chain-1.csv", "chain-2.csv"]
        });
        let read = Draws::read(&folder.path().join("new/run")).expect("they were written");
        assert_eq!(read, draws(2));
        assert!(read.chains[0].draws[1][0].is_sign_negative());
    }

    #[test]
    fn chains_of_an_earlier_run_do_not_stay() {
        let folder = tempfile::tempdir().expect("a temporary folder can be made");
        draws(12).write(folder.path()).expect("it is writable");
        draws(2).write(folder.path()).expect("it is writable");
        assert_eq!(Draws::read(folder.path()), Ok(draws(2)));
        assert_eq!(fs::read_dir(folder.path()).expect("it is there").count(), 2, "no temporary file is left");
    }

    #[test]
    fn unfit_draws_leave_the_folder_as_it_was() {
        let folder = tempfile::tempdir().expect("a temporary folder can be made");
        draws(2).write(folder.path()).expect("it is writable");
        let mut unfit = draws(1);
        unfit.names[0] = "a,b".into();
        assert_eq!(unfit.write(folder.path()), Err(DrawsError::Name("a,b".into())));
        assert_eq!(Draws::read(folder.path()), Ok(draws(2)));
    }

    #[test]
    fn missing_chain_is_named() {
        let folder = tempfile::tempdir().expect("a temporary folder can be made");
        let first = folder.path().join("chain-1.csv");
        assert_eq!(Draws::read(folder.path()), Err(DrawsError::Unreadable(first, ErrorKind::NotFound)));
        let files = draws(3).write(folder.path()).expect("it is writable");
        fs::remove_file(&files[1]).expect("it was written");
        assert_eq!(Draws::read(folder.path()), Err(DrawsError::Unreadable(files[1].clone(), ErrorKind::NotFound)));
    }

    #[test]
    fn folder_that_cannot_be_made_is_named() {
        let file = tempfile::NamedTempFile::new().expect("a temporary file can be made");
        let error = draws(1).write(&file.path().join("run")).expect_err("a file holds no folder");
        assert!(error.to_string().contains("/run: cannot be written: "), "{error}");
    }

    #[test]
    fn wrong_column_is_named() {
        let place = "chain-1.csv, line 1, column 6";
        assert_eq!(edited(1, "divergent__", "bad"), format!("{place}: expected divergent__, found \"bad\""));
        let place = "chain-2.csv, line 1, column 8";
        assert_eq!(edited(2, "A2", "A4"), format!("{place}: expected A2, found \"A4\""));
        let place = "chain-2.csv, line 1, column 9";
        assert_eq!(edited(2, ",vars.1", ""), format!("{place}: expected vars.1, found \"the end of the line\""));
        assert_eq!(edited(2, "vars.1", "vars.1,b"), {
            "chain-2.csv, line 1, column 10: expected the end of the line, found \"b\""
        });
    }

    #[test]
    fn wrong_cell_is_named() {
        let place = "chain-2.csv, line 3, column";
        assert_eq!(edited(2, ",-0.0,", ",x,"), format!("{place} A2: expected a number, found \"x\""));
        assert_eq!(edited(2, "-2.0,0.5,0.1,3", "-2.0,0.5,0.1,-3"), {
            format!("{place} treedepth__: expected a whole number, found \"-3\"")
        });
        assert_eq!(edited(1, "7,1,", "7,2,"), {
            "chain-1.csv, line 4, column divergent__: expected 0 or 1, found \"2\""
        });
    }

    #[test]
    fn cells_are_counted() {
        assert_eq!(edited(1, ",-0.0,", ","), "chain-1.csv, line 3: expected 9 cells, found 8");
    }

    #[test]
    fn bytes_that_are_no_text_are_refused() {
        let folder = tempfile::tempdir().expect("a temporary folder can be made");
        let file = folder.path().join("chain-1.csv");
        fs::write(&file, b"lp__,\xff\n").expect("it is writable");
        assert_eq!(Draws::read(folder.path()), Err(DrawsError::Unreadable(file, ErrorKind::InvalidData)));
    }
}
