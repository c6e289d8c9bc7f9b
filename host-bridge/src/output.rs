//! Files that appear whole or not at all.

use std::io::Write;
use std::path::Path;

use serde::Serialize;
use tempfile::NamedTempFile;

/// Why a file was not written.
#[derive(Debug, thiserror::Error)]
#[error("{path}: {source}")]
pub struct OutputError {
    path: String,
    source: std::io::Error,
}

/// Write JSON to a file, or to stdout for `-`.
///
/// # Errors
/// [`OutputError`]; a file of that name is then as it was.
pub fn json(path: &Path, value: &impl Serialize) -> Result<(), OutputError> {
    let wrong = |source| OutputError { path: path.display().to_string(), source };
    let mut text = serde_json::to_string_pretty(value).map_err(|e| wrong(e.into()))?;
    text.push('\n');
    if path == Path::new("-") {
        return std::io::stdout().write_all(text.as_bytes()).map_err(wrong);
    }
    whole(path, text.as_bytes()).map_err(wrong)
}

/// Write bytes to a file.
///
/// # Errors
/// [`OutputError`]; a file of that name is then as it was.
pub fn bytes(path: &Path, bytes: &[u8]) -> Result<(), OutputError> {
    whole(path, bytes).map_err(|source| OutputError { path: path.display().to_string(), source })
}

fn whole(path: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let mut file = temporary(path)?;
    file.write_all(bytes)?;
    file.persist(path).map_err(|e| e.error)?;
    Ok(())
}

/// A temporary file beside its final place, with the permissions that a created file has.
///
/// # Errors
/// What the system says, for instance that the folder does not exist.
pub fn temporary(path: &Path) -> std::io::Result<NamedTempFile> {
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut builder = tempfile::Builder::new();
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(std::fs::Permissions::from_mode(0o666)); // less the umask, as open(2) does
    }
    builder.tempfile_in(folder).map_err(|error| error.kind().into()) // without the temporary name
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

    #[test]
    fn a_missing_folder_is_named() {
        let error = json(Path::new("/nonexistent/a.json"), &1).unwrap_err();
        assert!(error.to_string().starts_with("/nonexistent/a.json: "), "{error}");
    }
}
