//! How much the vars scatter, over the width of their prior.
//!
//! The prior of a var is as wide as a design can promise; the quadrupoles of a machine that was built scatter less, or more. What they do is learnt from
//! the recording, as the widths of the ordinary families are (`widths.rs`), with the prior's width counted as [`COUNTS`] further quadrupoles that
//! scatter by as much as it says. With `s` the scatter over that width:
//!
//! `ln p(ln s) = -COUNTS (ln s + (1/s^2 - 1)/2)`,
//!
//! largest, 0, at 1. With the factors `a` of the vars in prior widths, about the means of focusing and defocusing quadrupoles, and `known` the number of
//! them that the recording shows, the most likely scatter obeys `s^2 = (sum of a^2 + COUNTS)/(known + COUNTS)`.
//!
//! Source: A. Gelman et al., Bayesian Data Analysis (2013), ch. 2.6, the scaled inverse chi-square prior of a variance.

/// Scatter of the vars over the width of their prior.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scatter(pub f64);

/// Quadrupoles that the prior's width counts as: so many give a standard deviation to half. The published table of the Booster scatters by 0.42 of the width that
/// its authors took for the prior.
pub const COUNTS: f64 = 2.0;

impl Default for Scatter {
    /// As the prior says.
    fn default() -> Self {
        Self(1.0)
    }
}

impl Scatter {
    /// From the sum of squares of the vars, in prior widths, and how many of them are known.
    pub fn from_squares(squares: f64, known: f64) -> Self {
        Self(((squares + COUNTS) / (known + COUNTS)).sqrt())
    }

    /// `ln` prior, relative to that of the prior's own width.
    pub(crate) fn log_prior(self) -> f64 {
        -COUNTS * (self.0.ln() + 0.5 * (self.0.powi(-2) - 1.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Of vars that are all known exactly the density is `ln p(ln s) - n ln s - sum of a^2/(2 s^2)`.
    #[test]
    fn the_scatter_is_the_most_likely_one() {
        let (squares, known) = (12.0, 30.0);
        let log_density = |s: f64| Scatter(s).log_prior() - known * s.ln() - 0.5 * squares / s.powi(2);
        let Scatter(best) = Scatter::from_squares(squares, known);
        assert!((best - (14.0_f64 / 32.0).sqrt()).abs() < 1e-12);
        assert!(log_density(best) > log_density(1.01 * best) && log_density(best) > log_density(0.99 * best));
        assert_eq!(Scatter::default().log_prior(), 0.0);
        // one that the recording shows nothing of is as the prior says
        assert_eq!(Scatter::from_squares(0.0, 0.0), Scatter::default());
    }
}
