//! The evidence for one free amplitude.

/// The evidence for one amplitude, and what the data says of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Evidence {
    /// `ln` Bayes factor over none.
    pub log_bayes_factor: f64,
    /// Mean of the posterior, in the unit of the width.
    pub amplitude: f64,
    /// Standard deviation of the posterior.
    pub sigma: f64,
}

impl Evidence {
    /// By the slope and the curvature (power) of the log-likelihood at zero:
    ///
    /// `ln Bayes factor = w^2 g^2/(1 + w^2 G)/2 - ln(1 + w^2 G)/2`.
    pub fn from_score(slope: f64, power: f64, width: f64) -> Self {
        let variance = width * width;
        let power = variance * power;
        let log_bayes_factor = log_bayes_factor_of_alike(variance * slope * slope, power, 1.0);
        Self { log_bayes_factor, amplitude: variance * slope / (1.0 + power), sigma: posterior_sigma(power, width) }
    }

    /// Of a signal that is not linear in its amplitude, about its most probable one: `gained` is by how much less the sum of squares is with it,
    /// `power` the square of the signal's derivative there.
    ///
    /// `ln Bayes factor = (gained - a^2/w^2)/2 - ln(1 + w^2 G)/2`.
    pub fn about(amplitude: f64, gained: f64, power: f64, width: f64) -> Self {
        let power = width.powi(2) * power;
        let log_bayes_factor = 0.5 * (gained - (amplitude / width).powi(2) - power.ln_1p());
        Self { log_bayes_factor, amplitude, sigma: posterior_sigma(power, width) }
    }
}

/// `ln` Bayes factor of `count` amplitudes that share one power, in units of their prior standard deviations; `square`: the sum of their squared
/// slopes.
///
/// `ln Bayes factor = square/(1 + power)/2 - count ln(1 + power)/2`.
pub fn log_bayes_factor_of_alike(square: f64, power: f64, count: f64) -> f64 {
    0.5 * square / (1.0 + power) - 0.5 * (count * power.ln_1p())
}

fn posterior_sigma(power: f64, width: f64) -> f64 {
    width / (1.0 + power).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_amplitude_is_the_mean_of_prior_and_data_by_their_precisions() {
        let (slope, power, width) = (3.0, 8.0, 0.5);
        let found = Evidence::from_score(slope, power, width);
        let precision = power + 1.0 / (width * width);
        assert_eq!(found.amplitude, slope / precision);
        assert!((found.sigma - precision.sqrt().recip()).abs() < 1e-15, "rounding");
    }

    /// The ratio of two normal densities of the least-squares amplitude `g/G`: of variance `w^2 + 1/G` with an amplitude, `1/G` without one.
    #[test]
    fn the_evidence_is_that_of_the_least_squares_amplitude() {
        let log_density = |x: f64, variance: f64| -0.5 * (x * x / variance + variance.ln());
        for (slope, power, width) in [(0.0, 4.0, 1.0), (12.0, 4.0, 1.0), (-7.0, 0.3, 2.5), (1e3, 1e6, 1e-3)] {
            let fitted = slope / power;
            let expected = log_density(fitted, width * width + power.recip()) - log_density(fitted, power.recip());
            let found = Evidence::from_score(slope, power, width).log_bayes_factor;
            assert!((found - expected).abs() < 1e-12 * expected.abs().max(1.0), "{found} {expected}");
        }
    }

    #[test]
    fn a_pattern_that_the_data_cannot_show_says_nothing() {
        assert_eq!(Evidence::from_score(0.0, 0.0, 2.0), Evidence { log_bayes_factor: 0.0, amplitude: 0.0, sigma: 2.0 });
    }

    #[test]
    fn a_linear_signal_has_the_same_evidence_about_its_amplitude() {
        let (slope, power, width) = (3.0, 8.0, 0.5);
        let found = Evidence::from_score(slope, power, width);
        let gained = 2.0 * found.amplitude * slope - found.amplitude.powi(2) * power;
        let about = Evidence::about(found.amplitude, gained, power, width);
        assert!((about.log_bayes_factor - found.log_bayes_factor).abs() < 1e-14, "rounding");
        assert_eq!(about.sigma, found.sigma);
    }

    #[test]
    fn alike_amplitudes_add_their_evidence() {
        let (slopes, power) = ([1.0, -2.0, 0.5], 3.0);
        let single: f64 = slopes.iter().map(|&slope| Evidence::from_score(slope, power, 1.0).log_bayes_factor).sum();
        let square = slopes.iter().map(|slope| slope * slope).sum();
        assert!((log_bayes_factor_of_alike(square, power, 3.0) - single).abs() < 1e-14, "rounding");
    }
}
