//! What a number of a recording may be.

use twin::limits;

/// What a number may be, in words and as a check of finite values.
pub(super) struct Limit {
    pub words: &'static str,
    accepts: fn(f64) -> bool,
}

pub(super) const FINITE: Limit =
    Limit { words: "a number from -1e15 to 1e15", accepts: |x| limits::FINITE.check(x).is_ok() };
pub(super) const POSITIVE: Limit =
    Limit { words: "a number from 1e-15 to 1e15", accepts: |x| limits::POSITIVE.check(x).is_ok() };
pub(super) const NOT_NEGATIVE: Limit =
    Limit { words: "a number from 0 to 1e15", accepts: |x| limits::NOT_NEGATIVE.check(x).is_ok() };
pub(super) const NO_SETTING: Limit = Limit { words: "0, as no corrector is named", accepts: |x| x == 0.0 };
pub(super) const POSITION: Limit = Limit { words: "a position from -100 to 100 mm", accepts: |x| x.abs() <= 100.0 };
pub(super) const RF_OFFSET: Limit =
    Limit { words: "a relative offset from -0.01 to 0.01", accepts: |x| x.abs() <= 0.01 };
pub(super) const TUNE: Limit =
    Limit { words: "a fractional tune from 0 to below 1", accepts: |x| (0.0..1.0).contains(&x) };

impl Limit {
    pub fn check(&self, value: f64) -> Option<f64> {
        (value.is_finite() && (self.accepts)(value)).then_some(value)
    }

    /// Rust reads `NaN` and `inf` as numbers; `check` turns them away.
    pub fn parse(&self, cell: &str) -> Option<f64> {
        cell.parse().ok().and_then(|value| self.check(value))
    }
}

/// A division, as `x · 0.001` would round twice: decimal values stay correct to 1 ulp.
pub(super) fn from_milli(value: f64) -> f64 {
    value / 1000.0
}

/// The decimal number that [`from_milli`] made, to nine places.
pub(super) fn in_milli(value: f64) -> f64 {
    (value * 1e12).round() / 1e9
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_words_are_those_of_the_ranges() {
        let ranges = [limits::FINITE, limits::POSITIVE, limits::NOT_NEGATIVE].map(|range| range.to_string());
        assert_eq!([FINITE, POSITIVE, NOT_NEGATIVE].map(|limit| limit.words), ranges);
    }

    #[test]
    fn decimal_millimetres_stay_correct_to_one_ulp() {
        for tenth_micron in -200_000..=200_000_i32 {
            let cell = format!("{:.4}", f64::from(tenth_micron) / 1e4);
            let exact: f64 = format!("{cell}e-3").parse().expect("a decimal");
            let metres = from_milli(cell.parse().expect("a decimal"));
            assert!(metres.to_bits().abs_diff(exact.to_bits()) <= 1, "{cell} mm became {metres} m");
            assert_eq!(from_milli(in_milli(metres)), metres, "{cell} mm");
        }
    }
}
