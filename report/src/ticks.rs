//! Round numbers along an axis, all written with the same number of decimals.

use core::ops::Range;

use plotters::coord::ranged1d::{BoldPoints, Ranged};
use plotters::coord::types::RangedCoordf64;

/// Numbers with more decimals than this, or as large as this, are written with a power of ten.
const DECIMALS: usize = 4;
/// See [`DECIMALS`].
const LARGE: f64 = 1e6;

/// Round values within a range.
pub struct Ticks {
    /// The values, in order.
    pub values: Vec<f64>,
    form: Form,
}

/// How the numbers are written.
enum Form {
    Decimals(usize),
    PowersOfTen,
    /// Values are logarithms to the base of ten, numbers what they are of.
    Decades,
}

impl Ticks {
    /// As many of them as fit, at most `count`.
    pub fn new(range: &Range<f64>, count: usize) -> Ticks {
        let values = RangedCoordf64::from(range.clone()).key_points(BoldPoints(count));
        let decimals = if range.start.abs().max(range.end.abs()) < LARGE { decimals(&values) } else { None };
        Ticks { values, form: decimals.map_or(Form::PowersOfTen, Form::Decimals) }
    }

    /// Powers of ten within a range of logarithms, with twice and five times them where that makes `count` at most.
    pub fn decades(range: &Range<f64>, count: usize) -> Ticks {
        let powers = range.start.floor() as i32..=range.end.ceil() as i32;
        let all = |of_each: &[f64]| -> Vec<f64> {
            let each = powers.clone().flat_map(|power| of_each.iter().map(move |m| f64::from(power) + m.log10()));
            each.filter(|value| range.contains(value)).collect()
        };
        let fine = all(&[1.0, 2.0, 5.0]);
        Ticks { values: if fine.len() <= count { fine } else { all(&[1.0]) }, form: Form::Decades }
    }

    /// The value in figures.
    pub fn number(&self, value: f64) -> String {
        let figures = match self.form {
            Form::Decimals(decimals) => format!("{:.decimals$}", rounded(value, decimals) + 0.0), // no minus before a zero
            Form::PowersOfTen => power_of_ten(value),
            Form::Decades => decade(value),
        };
        figures.replace('-', "\u{2212}")
    }
}

/// The fewest decimals that write all of these values exactly enough.
fn decimals(values: &[f64]) -> Option<usize> {
    let step = values.windows(2).map(|pair| pair[1] - pair[0]).fold(f64::INFINITY, f64::min);
    (0..=DECIMALS).find(|&decimals| values.iter().all(|&value| (rounded(value, decimals) - value).abs() < 1e-3 * step))
}

fn rounded(value: f64, decimals: usize) -> f64 {
    let scale = 10f64.powi(decimals as i32);
    (value * scale).round() / scale
}

/// The number whose logarithm this is, to one figure.
fn decade(logarithm: f64) -> String {
    let (number, power) = (10f64.powf(logarithm), logarithm.floor() as i32);
    match power {
        -4..=5 => format!("{number:.*}", (-power).max(0) as usize),
        _ => power_of_ten(number),
    }
}

/// Three figures and a power of ten, without trailing zeros.
fn power_of_ten(value: f64) -> String {
    if value == 0.0 {
        return "0".into();
    }
    let short: f64 = format!("{value:.2e}").parse().expect("a formatted number is a number");
    format!("{short:e}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(range: Range<f64>) -> Vec<String> {
        let ticks = Ticks::new(&range, 5);
        ticks.values.iter().map(|&value| ticks.number(value)).collect()
    }

    #[test]
    fn decimals_are_as_many_as_needed() {
        assert_eq!(numbers(0.0..10.0), ["0", "5", "10"]);
        assert_eq!(numbers(-0.11..0.11), ["\u{2212}0.10", "\u{2212}0.05", "0.00", "0.05", "0.10"]);
    }

    #[test]
    fn a_decade_has_its_power_of_ten_and_what_lies_between() {
        let numbers = |range: Range<f64>, count| -> Vec<String> {
            let ticks = Ticks::decades(&range, count);
            ticks.values.iter().map(|&value| ticks.number(value)).collect()
        };
        assert_eq!(numbers(-2.0..0.4, 9), ["0.01", "0.02", "0.05", "0.1", "0.2", "0.5", "1", "2"]);
        assert_eq!(numbers(-2.0..6.1, 9), ["0.01", "0.1", "1", "10", "100", "1000", "10000", "100000", "1e6"]);
    }

    #[test]
    fn small_numbers_are_written_with_powers_of_ten() {
        assert_eq!(numbers(0.0..2e-6), ["0", "5e\u{2212}7", "1e\u{2212}6", "1.5e\u{2212}6", "2e\u{2212}6"]);
    }
}
