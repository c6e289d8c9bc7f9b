//! A file, or a variable of it: `ring.mat:THERING`, `response.h5:/orm`.

use std::path::{Path, PathBuf};

use measured::MeasuredError;
use twin::limits::FILE;

/// Where something is read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Source {
    /// The file.
    pub path: PathBuf,
    /// The variable or dataset, if one is named.
    pub name: Option<String>,
}

impl Source {
    /// A name of a file that exists is the file; else the first part before a colon that is one.
    pub fn of(argument: &Path) -> Self {
        let text = argument.to_string_lossy();
        let named = || {
            let mut parts = text.match_indices(':').map(|(at, _)| text.split_at(at));
            parts.find(|(file, _)| Path::new(file).is_file())
        };
        match (!argument.exists()).then(named).flatten() {
            Some((file, name)) => Self { path: file.into(), name: Some(name[1..].into()) },
            None => Self { path: argument.into(), name: None },
        }
    }
}

/// The bytes of a file.
pub(super) fn bytes(file: &Path) -> Result<Vec<u8>, MeasuredError> {
    FILE.bytes(file).map_err(|source| MeasuredError::Read { file: file.display().to_string(), source })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_colon_names_a_variable_unless_the_file_has_it() {
        let folder = tempfile::tempdir().unwrap();
        let [plain, odd] = ["ring.mat", "a:b.mat"].map(|name| folder.path().join(name));
        [&plain, &odd].iter().for_each(|file| std::fs::write(file, "").unwrap());
        let of = |path: &Path| Source::of(path);
        assert_eq!(of(&odd), Source { path: odd.clone(), name: None });
        let with = |name: &str| PathBuf::from(format!("{}:{name}", plain.display()));
        assert_eq!(of(&with("/a:b/c")), Source { path: plain.clone(), name: Some("/a:b/c".into()) });
        let absent = folder.path().join("absent.mat:RING");
        assert_eq!(of(&absent), Source { path: absent.clone(), name: None });
    }
}
