//! Shares of campaigns, with their limits.

use schemars::JsonSchema;
use serde::Serialize;
use statrs::distribution::{Beta, ContinuousCDF};

use crate::outcome::Outcome;

/// Share of successes among trials, with the 95 % limits of Clopper and Pearson.
///
/// Source: C. Clopper and E. Pearson, Biometrika 26 (1934) 404.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, JsonSchema)]
pub struct Share {
    /// Successes.
    pub of: usize,
    /// Trials.
    pub trials: usize,
    /// Lower and upper limit.
    pub limits: [f64; 2],
}

/// Number of successes below which there are none.
const ROUNDING: f64 = 1e-9;

impl Share {
    /// Count.
    pub fn of<'o>(outcomes: impl IntoIterator<Item = &'o Outcome>, is: impl Fn(&Outcome) -> bool) -> Self {
        let (of, trials) = outcomes.into_iter().fold((0, 0), |(of, n), one| (of + usize::from(is(one)), n + 1));
        Self::new(of, trials)
    }

    /// Of some trials.
    pub fn new(of: usize, trials: usize) -> Self {
        Self { of, trials, limits: Self::limits(of as f64, trials as f64) }
    }

    /// The limits, which fractional numbers have too.
    pub fn limits(of: f64, trials: f64) -> [f64; 2] {
        let beta = |a: f64, b: f64, p: f64| Beta::new(a, b).map_or(0.0, |beta| beta.inverse_cdf(p));
        // shares of a weighted sum are off 0 and 1 by rounding
        let (none, all) = (of < ROUNDING, trials - of < ROUNDING);
        let lower = if none { 0.0 } else { beta(of, trials - of + 1.0, 0.025) };
        let upper = if all { 1.0 } else { beta(of + 1.0, trials - of, 0.975) };
        [lower, upper]
    }

    /// In words.
    pub fn text(&self) -> String {
        if self.trials == 0 {
            return "none".into();
        }
        let [lower, upper] = self.limits.map(|limit| 100.0 * limit);
        format!("{} of {} ({lower:.1} to {upper:.1} %)", self.of, self.trials)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Clopper and Pearson's limits from their tables: 0 of 300 is below 1.2 %, 8 of 10 between 44.4 and 97.5 %.
    #[test]
    fn limits_are_those_of_clopper_and_pearson() {
        let none = Share::new(0, 300);
        assert!(none.limits[0] == 0.0 && (none.limits[1] - 0.01222).abs() < 1e-4, "{none:?}");
        let most = Share::new(8, 10);
        assert!((most.limits[0] - 0.4439).abs() < 1e-3 && (most.limits[1] - 0.9748).abs() < 1e-3, "{most:?}");
    }
}
