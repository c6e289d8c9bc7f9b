//! What a command leaves behind: files that appear whole or not at all, and lines whose reader may have gone.

use core::fmt::Display;
use std::io::{self, ErrorKind, Write};
use std::path::Path;

use comfy_table::{ContentArrangement, Table, presets};
use serde::Serialize;
use tempfile::NamedTempFile;

use crate::finite;

/// Width of every table, that of a plain terminal.
const COLUMNS: u16 = 80;

/// Why a file was not written.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {reason}")]
pub struct OutputError {
    path: String,
    reason: String,
}

impl OutputError {
    /// For a file.
    pub fn of(path: &Path, reason: impl Display) -> Self {
        Self { path: path.display().to_string(), reason: reason.to_string() }
    }
}

/// Print a text and a line feed. A reader that has gone, as in `orbitcal fit | head`, is no error.
///
/// # Errors
/// What the system says of stdout, for instance that the disk is full.
pub fn say(text: impl Display) -> Result<(), OutputError> {
    let mut stdout = io::stdout().lock();
    match writeln!(stdout, "{text}").and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => Err(OutputError::of(Path::new("stdout"), error)),
        _ => Ok(()),
    }
}

/// What went wrong: a line on stderr where the program says so, whether or not anybody reads it.
pub fn warn(text: impl Display) {
    tracing::warn!("{text}");
}

/// What an operator is told: a line on stderr, too.
pub fn tell(text: impl Display) {
    tracing::info!("{text}");
}

/// A text in lines of 80 columns at most, but for words that are longer.
pub fn fill(text: &str) -> String {
    lines(text, usize::from(COLUMNS)).join("\n")
}

/// A text in lines of this many columns at most, but for words that are longer.
pub fn lines(text: &str, columns: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= columns => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

/// An empty table that fits a terminal of 80 columns; cells that are too long are wrapped.
pub fn table<'h>(header: impl IntoIterator<Item = &'h str>) -> Table {
    let mut table = Table::new();
    table.load_style(presets::ASCII_BORDERS_ONLY_CONDENSED);
    table.set_content_arrangement(ContentArrangement::Dynamic).set_width(COLUMNS);
    table.set_header(header);
    table
}

/// Write JSON to a file, or to stdout for `-`; a field whose number is not finite is absent, and the field `absent` names it.
///
/// # Errors
/// [`OutputError`]; a file of that name is then as it was.
pub fn json(path: &Path, value: &impl Serialize) -> Result<(), OutputError> {
    let text = finite::text(value).map_err(|e| OutputError::of(path, e))?;
    if path == Path::new("-") { say(text) } else { bytes(path, (text + "\n").as_bytes()) }
}

/// Write bytes to a file; what is no file (a device, a pipe, a link) is written through.
///
/// # Errors
/// [`OutputError`]; a file of that name is then as it was.
pub fn bytes(path: &Path, bytes: &[u8]) -> Result<(), OutputError> {
    if is_written_through(path) {
        return std::fs::write(path, bytes).map_err(|e| OutputError::of(path, e.kind()));
    }
    let mut file = temporary(path)?;
    file.write_all(bytes).map_err(|e| OutputError::of(path, e.kind()))?;
    file.persist(path).map_err(|e| OutputError::of(path, e.error.kind()))?;
    Ok(())
}

/// See, before work is put into it, that a file can be written; `-` is stdout.
///
/// # Errors
/// [`OutputError`], as later for the file.
pub fn check(path: &Path) -> Result<(), OutputError> {
    if path.is_dir() {
        return Err(OutputError::of(path, "expected a file, found a folder"));
    }
    if path == Path::new("-") || is_written_through(path) { Ok(()) } else { temporary(path).map(drop) }
}

/// True for a device, a pipe or a link: a new file in its place would make an ordinary file of `/dev/null`.
fn is_written_through(path: &Path) -> bool {
    path.symlink_metadata().is_ok_and(|there| !there.is_file() && !there.is_dir())
}

/// The same for a folder that need not be there yet.
///
/// # Errors
/// [`OutputError`].
pub fn check_folder(path: &Path) -> Result<(), OutputError> {
    let there = path.ancestors().find(|folder| folder.exists() || folder.as_os_str().is_empty());
    match there {
        Some(file) if file.is_file() => Err(OutputError::of(file, "expected a folder, found a file")),
        Some(folder) => temporary(&folder.join("any")).map(drop).map_err(|error| OutputError::of(path, error.reason)),
        None => Ok(()),
    }
}

/// A temporary file beside its final place, with the permissions that a created file has.
///
/// # Errors
/// What the system says, for instance that the folder does not exist.
pub fn temporary(path: &Path) -> Result<NamedTempFile, OutputError> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut builder = tempfile::Builder::new();
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(std::fs::Permissions::from_mode(0o666)); // less the umask, as open(2) does
    }
    builder.tempfile_in(folder).map_err(|error| match error.kind() {
        ErrorKind::NotFound => OutputError::of(path, "folder not found"),
        kind => OutputError::of(path, kind), // without the temporary name
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_appears_whole_and_replaces_the_old_one() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.json");
        json(&path, &[1, 2]).unwrap();
        json(&path, &[3]).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "[\n  3\n]\n");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1, "no temporary file is left");
    }

    /// A link, and the device behind `/dev/null`, stay what they are.
    #[test]
    #[cfg(unix)]
    fn what_is_no_file_is_written_through() {
        let folder = tempfile::tempdir().unwrap();
        let [link, file, null] = ["link", "file", "null"].map(|name| folder.path().join(name));
        std::os::unix::fs::symlink(&file, &link).unwrap();
        std::os::unix::fs::symlink("/dev/null", &null).unwrap();
        for path in [&link, &null] {
            check(path).unwrap();
            json(path, &[3]).unwrap();
            assert!(path.is_symlink(), "{}", path.display());
        }
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "[\n  3\n]\n");
        assert_eq!(std::fs::read_to_string(&null).unwrap(), "");
    }

    #[test]
    fn a_check_finds_what_would_fail_later_and_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let said = |checked: Result<(), OutputError>| checked.unwrap_err().to_string();
        assert_eq!(said(check(Path::new("/nonexistent/a.json"))), "/nonexistent/a.json: folder not found");
        let here = folder.path().display();
        assert_eq!(said(check(folder.path())), format!("{here}: expected a file, found a folder"));
        let file = folder.path().join("a.csv");
        std::fs::write(&file, "").unwrap();
        assert_eq!(
            said(check_folder(&file.join("draws"))),
            format!("{}: expected a folder, found a file", file.display())
        );
        check(&file).unwrap();
        check(Path::new("-")).unwrap();
        check_folder(&folder.path().join("new/draws")).unwrap();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn long_lines_are_broken_between_words() {
        let text = "monitors: ".to_owned() + &"x_C6 noisy; ".repeat(20);
        let filled = fill(&text);
        assert!(filled.lines().count() == 4 && filled.lines().all(|line| line.len() <= 80), "{filled}");
        assert_eq!(filled.split_whitespace().collect::<Vec<_>>(), text.split_whitespace().collect::<Vec<_>>());
    }

    #[test]
    fn tables_fit_eighty_columns_whatever_is_in_them() {
        let mut table = table(["recording", "sentence"]);
        table.add_row(["open-00", &"a long sentence ".repeat(20)]);
        assert!(table.lines().all(|line| line.chars().count() <= 80), "{table}");
    }
}
