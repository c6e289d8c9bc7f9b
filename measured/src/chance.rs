//! How far chance goes.

use statrs::distribution::{ContinuousCDF, Normal};

/// Standard deviations that a normal number exceeds, of either sign, once in so many.
pub fn deviations(once_in: f64) -> f64 {
    -Normal::standard().inverse_cdf(0.5 / once_in)
}
