//! The middle of some numbers.

/// Median, the upper one of two in the middle; none of no numbers.
///
/// ```
/// assert_eq!(twin::median([3.0, 1.0, 2.0, 9.0]), Some(3.0));
/// assert_eq!(twin::median([]), None);
/// ```
pub fn median(values: impl IntoIterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.into_iter().collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}
