//! Numbers that an option, a table or a plan may have.

use core::fmt;

/// The numbers from `low` to `high`, both of them too.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Range {
    /// Smallest.
    pub low: f64,
    /// Largest.
    pub high: f64,
    /// Unit, empty where there is none.
    pub unit: &'static str,
}

/// Any number of a measurement: beyond it sums and squares leave what a double can hold.
pub const FINITE: Range = Range::new(-1e15, 1e15, "");
/// One of these that is above zero, and whose inverse is one too.
pub const POSITIVE: Range = Range::new(1e-15, 1e15, "");
/// One of these that may be zero.
pub const NOT_NEGATIVE: Range = Range::new(0.0, 1e15, "");
/// How long something is waited for: a day at most.
pub const SECONDS: Range = Range::new(0.001, 86_400.0, "s");

impl Range {
    /// With its unit, or `""`.
    pub const fn new(low: f64, high: f64, unit: &'static str) -> Self {
        Self { low, high, unit }
    }

    /// A number of the range; NaN is of none.
    ///
    /// # Errors
    /// In words: the range, and what was found.
    pub fn check(self, found: f64) -> Result<f64, String> {
        if (self.low..=self.high).contains(&found) {
            Ok(found)
        } else {
            Err(format!("expected {self}, found {}", short(found)))
        }
    }

    /// The same of a text.
    ///
    /// # Errors
    /// As [`Range::check`].
    pub fn parse(self, text: &str) -> Result<f64, String> {
        match text.trim().parse() {
            Ok(number) => self.check(number).map_err(|_| format!("expected {self}, found {text}")),
            Err(_) => Err(format!("expected {self}, found {text:?}")),
        }
    }
}

impl fmt::Display for Range {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Self { low, high, unit } = self;
        let space = if unit.is_empty() { "" } else { " " };
        write!(f, "a number from {} to {}{space}{unit}", short(*low), short(*high))
    }
}

/// 86400 or 1e300, not three hundred zeros.
fn short(number: f64) -> String {
    let is_plain = number == 0.0 || (1e-4..1e9).contains(&number.abs());
    if is_plain { number.to_string() } else { format!("{number:e}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_range_holds_both_its_ends_and_no_nan() {
        assert_eq!((SECONDS.check(86_400.0), SECONDS.parse(" 0.001")), (Ok(86_400.0), Ok(0.001)));
        assert_eq!(SECONDS.check(1e300).unwrap_err(), "expected a number from 0.001 to 86400 s, found 1e300");
        assert_eq!(SECONDS.check(f64::NAN).unwrap_err(), "expected a number from 0.001 to 86400 s, found NaN");
        assert_eq!(FINITE.parse("1e999").unwrap_err(), "expected a number from -1e15 to 1e15, found 1e999");
        assert_eq!(POSITIVE.parse("5e-324").unwrap_err(), "expected a number from 1e-15 to 1e15, found 5e-324");
        assert_eq!(POSITIVE.parse("").unwrap_err(), "expected a number from 1e-15 to 1e15, found \"\"");
    }
}
