//! What the system says of a file, in the words of the program.

use std::io::{Error, ErrorKind};

/// Why a file could not be used.
pub fn why(error: &Error) -> String {
    match error.kind() {
        ErrorKind::NotFound => "file not found".into(),
        ErrorKind::InvalidData => "expected UTF-8 text".into(),
        kind => kind.to_string(),
    }
}
