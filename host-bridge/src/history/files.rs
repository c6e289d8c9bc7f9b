//! The files of one tier: rows are appended to the newest; a file that is full is followed by another, and the oldest is removed.
//!
//! A row is appended in one piece. If the process or the system dies within it, or the disk is full, the file ends in a piece of a row: at the next
//! start what comes after the last whole row is set aside, and rows go on behind it.

use core::time::Duration;
use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use results::CommandError;
use results::output::warn;

use super::row::{Columns, Row};
use super::{FILES, Tier};

/// Damaged ends that are kept; the oldest is removed when another one comes.
const ASIDE: usize = 8;
/// Rows are put on the disk as often as this.
const SYNC: Duration = Duration::from_secs(10);

/// Why a history cannot be kept or read.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {reason}")]
pub struct HistoryError {
    path: String,
    reason: String,
}

impl HistoryError {
    pub(super) fn of(path: &Path, reason: impl core::fmt::Display) -> Self {
        Self { path: path.display().to_string(), reason: reason.to_string() }
    }
}

/// Files of a tier in a folder with their numbers, the oldest first.
pub(super) fn numbered(folder: &Path, tier: &str) -> Vec<(u64, PathBuf)> {
    let number = |path: &Path| {
        let name = path.file_name()?.to_str()?;
        name.strip_prefix(tier)?.strip_prefix('-')?.strip_suffix(".csv")?.parse().ok()
    };
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let mut files: Vec<(u64, PathBuf)> =
        entries.filter_map(|entry| Some((number(&entry.path())?, entry.path()))).collect();
    files.sort();
    files
}

/// The file that is being written.
#[derive(Debug)]
struct Current {
    file: File,
    rows: u64,
    /// Up to the end of the last whole row.
    bytes: u64,
    synced: Instant,
}

/// The files of one tier, to be written.
#[derive(Debug)]
pub(super) struct Files {
    folder: PathBuf,
    tier: Tier,
    columns: Columns,
    current: Option<Current>,
    /// When the last row was made [ms since 1970].
    pub last_ms: Option<u64>,
}

impl Files {
    /// Go on behind the last whole row in a folder, if its file has these columns.
    pub fn open(folder: &Path, tier: &Tier, columns: &Columns) -> Result<Self, HistoryError> {
        let mut this = Self {
            folder: folder.to_owned(),
            tier: tier.clone(),
            columns: columns.clone(),
            current: None,
            last_ms: None,
        };
        if let Some((_, path)) = numbered(folder, tier.name).pop() {
            this.resume(&path).map_err(|error| HistoryError::of(&path, error))?;
        }
        Ok(this)
    }

    /// Append a row.
    pub fn append(&mut self, row: &Row) -> io::Result<()> {
        if self.current.as_ref().is_none_or(|current| current.rows >= self.tier.rows_of_a_file()) {
            self.begin()?;
        }
        if let Some(current) = &mut self.current {
            current.append(row)?;
        }
        self.last_ms = Some(row.time_ms);
        Ok(())
    }

    /// Begin the next file, and remove those that are too many.
    fn begin(&mut self) -> io::Result<()> {
        if let Some(full) = self.current.take() {
            full.file.sync_data()?;
        }
        let there = numbered(&self.folder, self.tier.name);
        let next = there.last().map_or(0, |(number, _)| number + 1);
        for (_, path) in there.iter().rev().skip(FILES as usize) {
            fs::remove_file(path)?;
        }
        let path = self.folder.join(format!("{}-{next:08}.csv", self.tier.name));
        let header = self.columns.header();
        let mut file = File::options().append(true).create_new(true).open(&path)?;
        if let Err(error) = file.write_all(header.as_bytes()) {
            let _ = fs::remove_file(&path);
            return Err(error);
        }
        self.current = Some(Current { file, rows: 0, bytes: header.len() as u64, synced: Instant::now() });
        Ok(())
    }

    /// Go on with a file, its damaged end set aside; one of other columns is left as it is.
    fn resume(&mut self, path: &Path) -> io::Result<()> {
        let bytes = fs::read(path)?;
        let (mut at, mut end, mut rows, mut columns) = (0, 0, 0, None);
        for line in bytes.split_inclusive(|byte| *byte == b'\n') {
            at += line.len();
            let Some(line) = line.strip_suffix(b"\n") else { break };
            let text = core::str::from_utf8(line).unwrap_or_default();
            match &columns {
                None => {
                    columns = Columns::of_header(text);
                    end = if columns.is_some() { at } else { break };
                }
                Some(columns) => {
                    if let Some(row) = Row::of_line(text, columns) {
                        (end, rows, self.last_ms) = (at, rows + 1, Some(row.time_ms));
                    }
                }
            }
        }
        if end < bytes.len() {
            self.set_aside(path, &bytes[end..])?;
        }
        if end == 0 {
            return fs::remove_file(path);
        }
        let file = File::options().append(true).open(path)?;
        file.set_len(end as u64)?;
        if columns.as_ref() == Some(&self.columns) {
            let bytes = end as u64;
            self.current = Some(Current { file, rows, bytes, synced: Instant::now() });
        }
        Ok(())
    }

    /// Keep the damaged end of a file beside it.
    fn set_aside(&self, path: &Path, end: &[u8]) -> io::Result<()> {
        let name = |number: u64| self.folder.join(format!("set-aside-{number:08}"));
        let number = |entry: &fs::DirEntry| entry.file_name().to_str()?.strip_prefix("set-aside-")?.parse::<u64>().ok();
        let mut there: Vec<u64> = fs::read_dir(&self.folder)?.flatten().filter_map(|entry| number(&entry)).collect();
        there.sort_unstable();
        for old in there.iter().rev().skip(ASIDE - 1) {
            fs::remove_file(name(*old))?;
        }
        let aside = name(there.last().map_or(0, |last| last + 1));
        fs::write(&aside, end)?;
        let (path, aside, bytes) = (path.display(), aside.display(), end.len());
        warn(format_args!("{path}: {bytes} bytes after its last whole row were set aside as {aside}"));
        Ok(())
    }
}

impl Current {
    fn append(&mut self, row: &Row) -> io::Result<()> {
        let line = row.line();
        if let Err(error) = self.file.write_all(line.as_bytes()) {
            // a part of it may be there; if that cannot be undone now, the next start does
            let _ = self.file.set_len(self.bytes);
            return Err(error);
        }
        (self.bytes, self.rows) = (self.bytes + line.len() as u64, self.rows + 1);
        if self.synced.elapsed() >= SYNC {
            self.synced = Instant::now();
            self.file.sync_data()?;
        }
        Ok(())
    }
}

/// A lock on the folder, held as long as this lives: two daemons do not write one history.
pub(super) fn lock(folder: &Path) -> Result<File, HistoryError> {
    let path = folder.join("lock");
    let made = fs::create_dir_all(folder).and_then(|()| File::options().create(true).append(true).open(&path));
    let file = made.map_err(|error| HistoryError::of(folder, error))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(fs::TryLockError::WouldBlock) => {
            Err(HistoryError::of(folder, "another daemon writes its history there; give each a folder of its own"))
        }
        Err(fs::TryLockError::Error(error)) => Err(HistoryError::of(&path, error)),
    }
}

impl From<HistoryError> for CommandError {
    fn from(error: HistoryError) -> Self {
        Self::Input(error.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::super::row::tests::{columns, row};
    use super::*;

    fn tier(rows: u64) -> Tier {
        Tier { name: "fine", every: Duration::ZERO, rows }
    }

    fn rows(folder: &Path) -> Vec<u64> {
        let lines =
            |path: PathBuf| fs::read_to_string(path).unwrap().lines().skip(1).map(str::to_owned).collect::<Vec<_>>();
        let all = numbered(folder, "fine").into_iter().flat_map(|(_, path)| lines(path));
        all.map(|line| Row::of_line(&line, &columns()).expect("whole").time_ms).collect()
    }

    #[test]
    fn the_oldest_rows_go_and_the_disk_is_bounded() {
        let folder = tempfile::tempdir().unwrap();
        let mut files = Files::open(folder.path(), &tier(80), &columns()).unwrap();
        let most = super::super::FILES + 1;
        for time in 0..1000 {
            files.append(&row(time)).unwrap();
            let there = numbered(folder.path(), "fine");
            let bytes: u64 = there.iter().map(|(_, path)| fs::metadata(path).unwrap().len()).sum();
            let bound = most * (columns().header().len() as u64 + 10 * columns().most_bytes());
            assert!(bytes <= bound, "{bytes} of {bound}");
        }
        let kept = rows(folder.path());
        assert!(kept.len() >= 80 && kept == (1000 - kept.len() as u64..1000).collect::<Vec<_>>(), "{kept:?}");
    }

    /// Whatever is left of the last row, the rows before it are read, and rows go on behind them.
    #[test]
    fn a_torn_end_is_set_aside_wherever_it_is_torn() {
        let whole = |folder: &Path| {
            let mut files = Files::open(folder, &tier(1000), &columns()).unwrap();
            (0..3).for_each(|time| files.append(&row(time)).unwrap());
            fs::read(&numbered(folder, "fine")[0].1).unwrap()
        };
        let sample = tempfile::tempdir().unwrap();
        let bytes = whole(sample.path());
        for cut in 0..bytes.len() {
            let folder = tempfile::tempdir().unwrap();
            fs::write(folder.path().join("fine-00000000.csv"), &bytes[..cut]).unwrap();
            let mut files = Files::open(folder.path(), &tier(1000), &columns()).unwrap();
            files.append(&row(9)).unwrap();
            let left = bytes[..cut].iter().filter(|byte| **byte == b'\n').count().saturating_sub(1);
            let expected: Vec<u64> = (0..left as u64).chain([9]).collect();
            assert_eq!(rows(folder.path()), expected, "cut at {cut}");
            let whole_lines = bytes[..cut].iter().rposition(|byte| *byte == b'\n').map_or(0, |at| at + 1);
            let aside = fs::read(folder.path().join("set-aside-00000000")).unwrap_or_default();
            assert_eq!(aside, bytes[whole_lines..cut], "cut at {cut}");
        }
    }

    /// As a file system leaves it that had the length on the disk and not the bytes.
    #[test]
    fn an_end_of_zeros_or_of_noise_is_set_aside() {
        let folder = tempfile::tempdir().unwrap();
        for end in [&[0_u8; 300][..], &[0xff, 0xfe, b'\n', 0x80], b"1,2,3\n"] {
            let mut files = Files::open(folder.path(), &tier(1000), &columns()).unwrap();
            files.append(&row(1)).unwrap();
            let path = numbered(folder.path(), "fine").pop().unwrap().1;
            File::options().append(true).open(&path).unwrap().write_all(end).unwrap();
        }
        Files::open(folder.path(), &tier(1000), &columns()).unwrap();
        assert_eq!(rows(folder.path()), [1, 1, 1]);
        let aside = |number| fs::read(folder.path().join(format!("set-aside-{number:08}"))).unwrap();
        assert_eq!([aside(0).len(), aside(1).len(), aside(2).len()], [300, 4, 6]);
    }

    #[test]
    fn damaged_ends_do_not_pile_up() {
        let folder = tempfile::tempdir().unwrap();
        for _ in 0..30 {
            let mut files = Files::open(folder.path(), &tier(1000), &columns()).unwrap();
            files.append(&row(1)).unwrap();
            let path = numbered(folder.path(), "fine").pop().unwrap().1;
            File::options().append(true).open(&path).unwrap().write_all(b"half a row").unwrap();
        }
        Files::open(folder.path(), &tier(1000), &columns()).unwrap();
        let names = fs::read_dir(folder.path()).unwrap().flatten().map(|entry| entry.file_name());
        let aside = names.filter(|name| name.to_string_lossy().starts_with("set-aside")).count();
        assert_eq!((aside, rows(folder.path()).len()), (ASIDE, 30));
    }

    #[test]
    fn a_full_disk_leaves_whole_rows() {
        let folder = tempfile::tempdir().unwrap();
        let mut files = Files::open(folder.path(), &tier(1000), &columns()).unwrap();
        files.append(&row(1)).unwrap();
        let current = files.current.as_mut().unwrap();
        let good = core::mem::replace(&mut current.file, File::options().write(true).open("/dev/full").unwrap());
        let error = files.append(&row(2)).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::StorageFull);
        files.current.as_mut().unwrap().file = good;
        files.append(&row(3)).unwrap();
        assert_eq!(rows(folder.path()), [1, 3]);
    }

    #[test]
    fn other_columns_begin_another_file() {
        let folder = tempfile::tempdir().unwrap();
        Files::open(folder.path(), &tier(1000), &columns()).unwrap().append(&row(1)).unwrap();
        let other = Columns { vars: vec!["A2".into()], ..columns() };
        let mut files = Files::open(folder.path(), &tier(1000), &other).unwrap();
        files.append(&Row { vars: vec![[1.0, 0.1]], ..row(2) }).unwrap();
        assert_eq!(numbered(folder.path(), "fine").len(), 2);
    }

    #[test]
    fn two_daemons_do_not_write_one_history() {
        let folder = tempfile::tempdir().unwrap();
        let held = lock(folder.path()).unwrap();
        assert!(lock(folder.path()).unwrap_err().to_string().contains("another daemon writes its history there"));
        drop(held);
        lock(folder.path()).unwrap();
    }
}
