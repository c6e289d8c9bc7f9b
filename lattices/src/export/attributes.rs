//! Attributes of a statement in the syntax that MAD-X and Bmad share: `, k1 = 0.5, tilt = 0.01`.

use core::fmt::{self, Write};

use twin::Element;

/// Attributes so far.
#[derive(Debug)]
pub(super) struct Attributes(String);

impl Attributes {
    /// None.
    pub fn new() -> Self {
        Self(String::new())
    }

    /// True if there are none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// A number, with all the digits that it has.
    pub fn number(&mut self, word: &str, value: f64) -> &mut Self {
        let _ = write!(self.0, ", {word} = {value:?}");
        self
    }

    /// A number that is not 0.
    pub fn other(&mut self, word: &str, value: f64) -> &mut Self {
        if value == 0.0 { self } else { self.number(word, value) }
    }

    /// Length of an element [m].
    pub fn length(&mut self, element: &Element) -> &mut Self {
        self.number("l", element.length)
    }

    /// Numbers that are not all 0.
    pub fn list(&mut self, word: &str, values: &[f64]) -> &mut Self {
        if values.iter().any(|value| *value != 0.0) {
            let values: Vec<String> = values.iter().map(|value| format!("{value:?}")).collect();
            let _ = write!(self.0, ", {word} = {{{}}}", values.join(", "));
        }
        self
    }
}

impl fmt::Display for Attributes {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&self.0)
    }
}
