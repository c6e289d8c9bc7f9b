//! Names by patterns: `BPM*`, or `x:BPM*` where they are of one plane.

use core::str::FromStr;

use glob::MatchOptions;

/// A pattern of names, and the plane if it states one.
#[derive(Debug, Clone)]
pub struct Pattern {
    text: String,
    names: glob::Pattern,
    planes: Option<[bool; 2]>,
}

impl FromStr for Pattern {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (planes, names) = match text.split_at_checked(2) {
            Some(("x:", names)) => (Some([true, false]), names),
            Some(("y:", names)) => (Some([false, true]), names),
            _ => (None, text),
        };
        let names = glob::Pattern::new(names).map_err(|error| error.to_string())?;
        Ok(Self { text: text.into(), names, planes })
    }
}

impl Pattern {
    /// The pattern as it was written.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// The planes of a name that matches, whatever its case: those of the pattern, else those that the type of the element has.
    pub(super) fn planes(&self, name: &str, of_type: Option<[bool; 2]>) -> Option<[bool; 2]> {
        let options = MatchOptions { case_sensitive: false, ..MatchOptions::new() };
        self.names.matches_with(name, options).then(|| self.planes.or(of_type).unwrap_or([true; 2]))
    }
}
