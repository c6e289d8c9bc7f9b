//! Names by patterns: `BPM*`, or `x:BPM*` where they are of one plane; `CommonName=PH*`, or `x:CommonName=PH*`, by another field of the file.

use core::str::FromStr;

use glob::MatchOptions;

use super::element::Element;

/// A pattern of names, and the plane if it states one.
#[derive(Debug, Clone)]
pub struct Pattern {
    text: String,
    /// Where the names stand; none of the names of the elements.
    field: Option<String>,
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
        let (field, names) = names.split_once('=').map_or((None, names), |(field, names)| (Some(field.into()), names));
        let names = glob::Pattern::new(names).map_err(|error| error.to_string())?;
        Ok(Self { text: text.into(), field, names, planes })
    }
}

impl Pattern {
    /// The pattern as it was written.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// What is compared of an element: its name, or its field where it has that.
    pub(super) fn word<'e>(&self, element: &'e Element) -> Option<&'e str> {
        self.field.as_ref().map_or(Some(&element.name), |field| element.words.get(field)).map(String::as_str)
    }

    /// The name of an element that matches, whatever its case.
    pub(super) fn name<'e>(&self, element: &'e Element) -> Option<&'e str> {
        let options = MatchOptions { case_sensitive: false, ..MatchOptions::new() };
        self.word(element).filter(|name| self.names.matches_with(name, options))
    }

    /// The planes of an element that matches: those of the pattern, else those that its type has.
    pub(super) fn planes(&self, of_type: Option<[bool; 2]>) -> [bool; 2] {
        self.planes.or(of_type).unwrap_or([true; 2])
    }
}
