//! Limits on what is read and asked for, each stated once: what is counted ([`Limit`], [`Budget`]) is checked before memory is asked for
//! it, and a number lies in its [`Range`]. The table for users is docs/limits.md.

mod document;
mod range;

use core::cell::Cell;
use std::fs::File;
use std::io::{self, BufRead, ErrorKind, Read};
use std::path::Path;

pub use document::{Document, json};
pub use range::{FINITE, NOT_NEGATIVE, POSITIVE, Range, SECONDS};

/// The most of something that is counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limit {
    /// How many.
    pub most: u64,
    /// Of what, in the words of an error.
    pub of: &'static str,
}

/// A file; the largest real ones, full lattices as JSON and long recordings, have some 30 MB.
pub const FILE: Limit = Limit { most: 1 << 26, of: "bytes in a file" };
/// A file that people write: a plan, a header, a configuration.
pub const SETTINGS: Limit = Limit { most: 1 << 20, of: "bytes in a TOML file" };
/// What a file becomes: its numbers (8 bytes each), values, names, and what is inflated.
pub const MEMORY: Limit = Limit { most: 192 << 20, of: "bytes in memory for the contents of a file" };
/// Lists, structs, lines and replicas; a lattice needs five or so. A level takes a kilobyte of the stack.
pub const DEPTH: Limit = Limit { most: 64, of: "levels within each other" };
/// The largest ring that is planned has some 60,000.
pub const ELEMENTS: Limit = Limit { most: 100_000, of: "elements and lines in a ring, repeats counted" };
/// A name, a text, or a line of a table: errors quote them.
pub const TEXT: Limit = Limit { most: 1 << 20, of: "bytes in a name or a line" };
/// What the chains of a sampler keep, 8 bytes a number.
pub const DRAWS: Limit = Limit { most: 1 << 24, of: "numbers in all draws (chains x draws x parameters)" };
/// Frames of a measurement that is planned.
pub const FRAMES: Limit = Limit { most: 1_000_000, of: "frames of a measurement (settings x repeats)" };

/// More than a limit allows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("expected at most {} {}, found {found}", .limit.most, .limit.of)]
pub struct Exceeded {
    limit: Limit,
    found: u64,
}

impl Limit {
    /// Whether so many are allowed.
    ///
    /// # Errors
    /// [`Exceeded`].
    pub fn check(self, found: u64) -> Result<(), Exceeded> {
        if found <= self.most { Ok(()) } else { Err(Exceeded { limit: self, found }) }
    }

    /// The bytes of a file or a device, no more of them than this.
    ///
    /// # Errors
    /// What the system says, or [`ErrorKind::FileTooLarge`].
    pub fn bytes(self, path: &Path) -> io::Result<Vec<u8>> {
        self.bytes_of(&File::open(path)?)
    }

    /// The same of a file that is open.
    ///
    /// # Errors
    /// As [`Limit::bytes`].
    pub fn bytes_of(self, file: &File) -> io::Result<Vec<u8>> {
        // a device states no length
        self.check(file.metadata()?.len()).map_err(too_large)?;
        let mut bytes = Vec::new();
        file.take(self.most + 1).read_to_end(&mut bytes)?;
        self.check(bytes.len() as u64).map_err(too_large)?;
        Ok(bytes)
    }

    /// The same as text.
    ///
    /// # Errors
    /// As [`Limit::bytes`], or [`ErrorKind::InvalidData`].
    pub fn text(self, path: &Path) -> io::Result<String> {
        text(self.bytes(path)?)
    }

    /// Lines of a stream, whose lengths this limits; an error is the last of them.
    pub fn lines(self, mut from: impl BufRead) -> impl Iterator<Item = io::Result<String>> {
        let mut line = move || {
            let mut line = Vec::new();
            from.by_ref().take(self.most + 1).read_until(b'\n', &mut line)?;
            self.check(line.len() as u64).map_err(too_large)?;
            text(line)
        };
        core::iter::from_fn(move || Some(line()).filter(|line| !line.as_ref().is_ok_and(String::is_empty)))
    }
}

fn too_large(exceeded: Exceeded) -> io::Error {
    io::Error::new(ErrorKind::FileTooLarge, exceeded)
}

fn text(bytes: Vec<u8>) -> io::Result<String> {
    String::from_utf8(bytes).map_err(|_| io::Error::new(ErrorKind::InvalidData, "expected UTF-8 text"))
}

/// What is taken of a limit, bit by bit.
#[derive(Debug, Clone)]
pub struct Budget {
    limit: Limit,
    taken: Cell<u64>,
}

impl Budget {
    /// Nothing is taken yet.
    pub fn new(limit: Limit) -> Self {
        Self { limit, taken: Cell::new(0) }
    }

    /// Take so many more.
    ///
    /// # Errors
    /// [`Exceeded`].
    pub fn take(&self, count: u64) -> Result<(), Exceeded> {
        self.taken.set(self.taken.get().saturating_add(count));
        self.limit.check(self.taken.get())
    }

    /// How many may still be taken.
    pub fn left(&self) -> u64 {
        self.limit.most.saturating_sub(self.taken.get())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_budget_is_used_up_by_what_is_taken_in_all() {
        let budget = Budget::new(Limit { most: 10, of: "eggs" });
        assert_eq!((budget.take(4), budget.left()), (Ok(()), 6));
        assert_eq!(budget.take(7).unwrap_err().to_string(), "expected at most 10 eggs, found 11");
        assert_eq!(budget.take(u64::MAX).unwrap_err().found, u64::MAX);
    }

    #[test]
    fn no_more_of_a_file_is_read_than_its_limit() {
        let limit = Limit { most: 4, of: "bytes" };
        let file = std::env::temp_dir().join(format!("limits-{}", std::process::id()));
        std::fs::write(&file, "12345").unwrap();
        let said = |path: &Path| crate::unreadable(&limit.text(path).unwrap_err());
        assert_eq!(said(&file), "expected at most 4 bytes, found 5");
        std::fs::write(&file, "1234").unwrap();
        assert_eq!(limit.text(&file).unwrap(), "1234");
        std::fs::remove_file(&file).unwrap();
        #[cfg(unix)]
        assert_eq!(said(Path::new("/dev/zero")), "expected at most 4 bytes, found 5");
    }

    #[test]
    fn a_stream_without_an_end_of_a_line_is_given_up() {
        let limit = Limit { most: 4, of: "bytes" };
        let lines: Vec<_> = limit.lines("ab\n\ncde".as_bytes()).map(Result::unwrap).collect();
        assert_eq!(lines, ["ab\n", "\n", "cde"]);
        let error = limit.lines(io::BufReader::new(io::repeat(b'x'))).next();
        assert!(error.is_some_and(|line| line.is_err()));
    }

    #[test]
    fn the_page_states_every_limit() {
        let page = include_str!("../../../docs/limits.md");
        for Limit { most, of } in [FILE, SETTINGS, MEMORY, DEPTH, ELEMENTS, TEXT, DRAWS, FRAMES] {
            assert!(page.contains(&format!("| {of} | {most} |")), "| {of} | {most} |");
        }
        assert!(page.contains(&SECONDS.to_string()), "{SECONDS}");
    }
}
