//! Lognormal prior of a quadrupole factor, and the truncated normal that its posterior becomes.
//!
//! The params are `theta = ln var`; a lognormal var of mean 1 and width `w` has
//! `sigma^2 = ln(1 + w^2)` and `mean of theta = -sigma^2/2`. It is truncated to a range, 0.94..1.06 in the paper.

use serde::{Deserialize, Serialize};

/// Prior of one `theta = ln var`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Prior {
    /// Mean of theta.
    pub mean: f32,
    /// Standard deviation of theta.
    pub sigma: f32,
    /// Smallest theta.
    pub lower: f32,
    /// Largest theta.
    pub upper: f32,
}

impl Prior {
    /// Lognormal of mean 1 and standard deviation `width`, truncated to a range of the factor.
    ///
    /// ```
    /// let prior = estimator::Prior::lognormal(0.03, [0.94, 1.06]);
    /// assert!((prior.sigma - 0.02999).abs() < 1e-5 && (prior.mean + 0.00045).abs() < 1e-6);
    /// ```
    pub fn lognormal(width: f32, [lower, upper]: [f32; 2]) -> Self {
        let variance = libm::log1pf(width * width);
        let sigma = libm::sqrtf(variance);
        Self { mean: -0.5 * variance, sigma, lower: libm::logf(lower), upper: libm::logf(upper) }
    }

    /// True if every number is finite, and sizes are positive.
    pub fn is_sound(&self) -> bool {
        let Self { mean, sigma, lower, upper } = *self;
        [mean, sigma, lower, upper].iter().all(|v| v.is_finite()) && sigma > 0.0 && upper > lower
    }
}

/// A normal distribution of theta truncated to the prior's range: the marginal posterior of one param.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Marginal {
    /// Mean of the normal before truncation.
    pub mean: f32,
    /// Its standard deviation.
    pub sigma: f32,
    /// Smallest theta.
    pub lower: f32,
    /// Largest theta.
    pub upper: f32,
}

/// Below this probability between the bounds, all of it lies in a tail whose shape is exponential.
const TAIL: f32 = 1e-4;

impl Marginal {
    /// Mean and standard deviation of `var = exp(theta)` under the truncated normal.
    ///
    /// The exponential is expanded to second order in sigma: against quadrature the mean is off by less than 2e-5, the
    /// standard deviation by less than 5e-4 of itself, 2e-3 at a bound (test `moments_match_quadrature`).
    pub fn moments(&self) -> (f32, f32) {
        let (alpha, beta) = ((self.lower - self.mean) / self.sigma, (self.upper - self.mean) / self.sigma);
        let is_inside = alpha < -6.0 && beta > 6.0;
        let (mean, sigma) = if is_inside { (self.mean, self.sigma) } else { self.truncated(alpha, beta) };
        let mut var = libm::expf(mean) * (1.0 + 0.5 * sigma * sigma);
        if !is_inside {
            // not `clamp`, which panics on bounds that are crossed
            var = var.max(libm::expf(self.lower)).min(libm::expf(self.upper));
        }
        (var, var * sigma)
    }

    /// Moments of the truncated normal. Source: Johnson, Kotz and Balakrishnan, Continuous Univariate Distributions 1
    /// (1994), sec. 10.1.
    fn truncated(&self, alpha: f32, beta: f32) -> (f32, f32) {
        let inside = between(alpha, beta);
        if inside < TAIL && (alpha > 0.0 || beta < 0.0) {
            // the near bound, and an exponential of the slope there
            let (bound, distance) = if alpha > 0.0 { (self.lower, alpha) } else { (self.upper, beta) };
            return (bound + self.sigma / distance, self.sigma / distance.abs());
        }
        let (a, b) = (density(alpha) / inside, density(beta) / inside);
        let shift = a - b;
        let variance = 1.0 + alpha * a - beta * b - shift * shift;
        (self.mean + self.sigma * shift, self.sigma * libm::sqrtf(variance.max(0.0)))
    }

    /// The var below which the fraction `p` of the truncated distribution lies.
    pub fn quantile(&self, p: f32) -> f32 {
        let (alpha, beta) = ((self.lower - self.mean) / self.sigma, (self.upper - self.mean) / self.sigma);
        let inside = between(alpha, beta);
        let theta = if inside >= TAIL {
            self.mean + self.sigma * standard_quantile(cumulative(alpha) + p * inside)
        } else if alpha > 0.0 {
            self.lower - self.sigma / alpha * libm::log1pf(-p)
        } else {
            self.upper - self.sigma / beta * libm::logf(p)
        };
        libm::expf(theta.max(self.lower).min(self.upper))
    }
}

fn density(z: f32) -> f32 {
    0.398_942_3 * libm::expf(-0.5 * z * z)
}

fn cumulative(z: f32) -> f32 {
    0.5 * libm::erfcf(-z * core::f32::consts::FRAC_1_SQRT_2)
}

/// Probability between two bounds, both taken from the near tail so that no digits cancel.
fn between(alpha: f32, beta: f32) -> f32 {
    if alpha > 0.0 { cumulative(-alpha) - cumulative(-beta) } else { cumulative(beta) - cumulative(alpha) }
}

/// Quantile of the standard normal distribution, to 7 digits.
///
/// Source: M. J. Wichura, Algorithm AS 241, Applied Statistics 37 (1988) 477, routine PPND7.
fn standard_quantile(p: f32) -> f32 {
    let q = p - 0.5;
    if q.abs() <= 0.425 {
        let r = 0.180_625 - q * q;
        let above = ((59.109_374 * r + 159.291_13) * r + 50.434_27) * r + 3.387_132_7;
        let below = ((67.187_56 * r + 78.757_76) * r + 17.895_17) * r + 1.0;
        return q * above / below;
    }
    let tail = if q < 0.0 { p } else { 1.0 - p };
    let r = libm::sqrtf(-libm::logf(tail.max(f32::MIN_POSITIVE)));
    let z = if r <= 5.0 {
        let r = r - 1.6;
        (((0.170_238_21 * r + 1.306_728_5) * r + 2.756_815_4) * r + 1.423_437_3)
            / ((0.120_211_33 * r + 0.737_001_6) * r + 1.0)
    } else {
        let r = r - 5.0;
        (((0.017_337_203 * r + 0.428_682_95) * r + 3.081_226_4) * r + 6.657_905)
            / ((0.012_258_202 * r + 0.241_978_95) * r + 1.0)
    };
    if q < 0.0 { -z } else { z }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_invert_the_cumulative_distribution() {
        for i in 1..200 {
            let p = i as f32 / 200.0;
            assert!((cumulative(standard_quantile(p)) - p).abs() < 2e-6, "{p}"); // f32 rounding of erfc
        }
        assert!((standard_quantile(0.975) - 1.959_964).abs() < 1e-5);
    }

    /// Moments of var by quadrature of the truncated density.
    fn quadrature(m: &Marginal) -> (f64, f64) {
        let n = 20_000;
        let step = f64::from(m.upper - m.lower) / n as f64;
        let (mut mass, mut first, mut second) = (0.0, 0.0, 0.0);
        for i in 0..n {
            let theta = f64::from(m.lower) + (i as f64 + 0.5) * step;
            let z = (theta - f64::from(m.mean)) / f64::from(m.sigma);
            let (weight, var) = (libm::exp(-0.5 * z * z), libm::exp(theta));
            mass += weight;
            first += weight * var;
            second += weight * var * var;
        }
        let mean = first / mass;
        (mean, libm::sqrt(second / mass - mean * mean))
    }

    #[test]
    fn moments_match_quadrature() {
        let bounds = Prior::lognormal(0.03, [0.94, 1.06]);
        for (mean, sigma, sigma_error) in
            [(0.0, 0.004, 5e-4), (0.055, 0.005, 2e-3), (-0.04, 0.01, 2e-3), (0.0, 0.03, 5e-4)]
        {
            let m = Marginal { mean, sigma, lower: bounds.lower, upper: bounds.upper };
            let ((mean, sigma), (exact_mean, exact_sigma)) = (m.moments(), quadrature(&m));
            assert!((f64::from(mean) - exact_mean).abs() < 2e-5, "{m:?}: {mean} {exact_mean}");
            assert!((f64::from(sigma) / exact_sigma - 1.0).abs() < sigma_error, "{m:?}: {sigma} {exact_sigma}");
        }
    }

    #[test]
    fn far_outside_the_range_everything_stays_within_it() {
        let bounds = Prior::lognormal(0.03, [0.94, 1.06]);
        for mean in [-0.3, 0.25] {
            let m = Marginal { mean, sigma: 0.01, lower: bounds.lower, upper: bounds.upper };
            let quantiles = [0.025, 0.16, 0.84, 0.975].map(|p| m.quantile(p));
            assert!(quantiles.is_sorted() && quantiles[0] >= 0.9399 && quantiles[3] <= 1.0601, "{quantiles:?}");
            let (var, sigma) = m.moments();
            assert!(var > 0.94 && var < 1.06 && sigma > 0.0, "{var} {sigma}");
        }
    }
}
