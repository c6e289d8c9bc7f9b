//! A var against nominal in one line of a terminal: where its mean is, one and two error bars to each side, and where 1 is.

use results::EstimateRecord;

/// Smallest distance of the ends from 1.
const LEAST: f32 = 0.02;
/// Largest: the prior's range, twice over.
const MOST: f32 = 0.12;

/// From 1 to either end, so that all vars of a record fit with two error bars, within bounds.
pub(super) fn reach(record: &EstimateRecord) -> f32 {
    let far = record.mean.iter().zip(&record.sigma).map(|(mean, sigma)| (mean - 1.0).abs() + 2.0 * sigma);
    far.filter(|far| far.is_finite()).fold(LEAST, f32::max).min(MOST)
}

/// The line, of an odd number of characters; empty without room for one.
pub(super) fn band(mean: f32, sigma: f32, reach: f32, width: usize) -> String {
    let half = width.saturating_sub(1) / 2;
    if half == 0 || !mean.is_finite() || !sigma.is_finite() {
        return String::new();
    }
    // a value beyond an end stands at that end
    let place = |value: f32| ((value - 1.0) / reach * half as f32).round().clamp(-(half as f32), half as f32) as isize;
    let [from2, from1, at, to1, to2] = [-2.0, -1.0, 0.0, 1.0, 2.0].map(|sigmas| place(mean + sigmas * sigma));
    let mark = |i: isize| match i {
        i if i == at => '●',
        i if (from1..=to1).contains(&i) => '━',
        i if (from2..=to2).contains(&i) => '─',
        0 => '│',
        _ => ' ',
    };
    (-(half as isize)..=half as isize).map(mark).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mean_and_error_bars_stand_where_they_are() {
        // eleven characters from 0.95 to 1.05: one is 0.01
        assert_eq!(band(1.0, 0.0, 0.05, 11), "     ●     ");
        assert_eq!(band(1.02, 0.01, 0.05, 11), "     ─━●━─ ");
        assert_eq!(band(0.97, 0.01, 0.05, 11), "─━●━─│     ");
        assert_eq!(band(1.3, 0.01, 0.05, 11), "     │    ●");
        assert_eq!((band(1.0, 0.1, 0.05, 2), band(f32::NAN, 0.1, 0.05, 11)), (String::new(), String::new()));
    }
}
