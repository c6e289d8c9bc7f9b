//! How like two sets of elements are.

/// Of measured elements beside predicted ones.
#[derive(Debug, Clone, Copy)]
pub struct Likeness {
    /// Correlation about 0, 1 where both have one pattern.
    pub correlation: f64,
    /// The factor by which the predicted ones are nearest to the measured ones.
    pub factor: f64,
    /// Pairs that count.
    pub counted: usize,
}

impl Likeness {
    /// Of pairs, measured and predicted, those that are both known; `None` where all of either are 0.
    pub fn of(pairs: impl Iterator<Item = (f64, f64)>) -> Option<Self> {
        let (mut sums, mut counted) = ([0.0; 3], 0);
        for (m, p) in pairs.filter(|(m, p)| m.is_finite() && p.is_finite()) {
            sums = [sums[0] + m * m, sums[1] + m * p, sums[2] + p * p];
            counted += 1;
        }
        let [measured, product, predicted] = sums;
        let size = (measured * predicted).sqrt();
        (size > 0.0).then(|| Self { correlation: product / size, factor: product / predicted, counted })
    }
}
