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
    decimals: Option<usize>,
}

impl Ticks {
    /// As many of them as fit, at most `count`.
    pub fn new(range: &Range<f64>, count: usize) -> Ticks {
        let values = RangedCoordf64::from(range.clone()).key_points(BoldPoints(count));
        let decimals = if range.start.abs().max(range.end.abs()) < LARGE { decimals(&values) } else { None };
        Ticks { values, decimals }
    }

    /// The value in figures.
    pub fn number(&self, value: f64) -> String {
        let figures = match self.decimals {
            Some(decimals) => format!("{:.decimals$}", rounded(value, decimals) + 0.0), // no minus before a zero
            None => power_of_ten(value),
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
    fn small_numbers_are_written_with_powers_of_ten() {
        assert_eq!(numbers(0.0..2e-6), ["0", "5e\u{2212}7", "1e\u{2212}6", "1.5e\u{2212}6", "2e\u{2212}6"]);
    }
}
