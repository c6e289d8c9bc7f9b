//! What the model misses in one block of a matrix: an error whose size and tails are learnt from the residuals.
//!
//! Few instruments of a real ring have most of what the model misses, so that its elements are no normal numbers. They follow Student's
//! distribution with scale `s` and `nu` degrees of freedom, normal where `nu` is infinite:
//!
//! `-ln p(r) = (nu + 1)/2 ln(1 + r^2/(nu s^2)) + ln s + ...`, `s^2 = sigma^2 + tau^2`.
//!
//! A fit minimises it as least squares with the weight `(nu + 1)/(nu + r^2/s^2)/s^2`, made anew from the residuals; an element says
//! `(nu + 1)/(nu + 3)/s^2` about what it depends on.
//!
//! Source: K. L. Lange, R. J. A. Little and J. M. G. Taylor, J. Am. Stat. Assoc. 84 (1989) 881.

use statrs::function::gamma::ln_gamma;

/// Degrees of freedom that are tried: below 2 there is no variance, above 30 the distribution is normal for all that a block can tell.
const FREEDOMS: [f64; 7] = [2.0, 3.0, 4.0, 6.0, 9.0, 15.0, 30.0];

/// What tails gain in ln likelihood in one block of normal errors in a thousand: half the 0.998 quantile of chi-square with one degree of
/// freedom, since they can only be heavier.
const BY_CHANCE: f64 = 4.77;

/// Newton's steps for a variance at most, and how near 1 its mean is in the end.
const STEPS: usize = 100;
const ENOUGH: f64 = 1e-6;

/// What the model misses in one block.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Missed {
    /// `tau` [mm].
    pub scale: f64,
    /// `nu`.
    pub freedom: f64,
}

impl Missed {
    /// Nothing: the stated noise is all there is.
    pub const NOTHING: Self = Self { scale: 0.0, freedom: f64::INFINITY };

    /// Scale `s` of an element [mm] with a stated noise [mm].
    pub fn spread(&self, sigma: f64) -> f64 {
        self.scale.hypot(sigma)
    }

    /// Weight of an element with some residual [1/mm^2]; 0 where the stated noise is infinite.
    pub fn weight(&self, sigma: f64, residual: f64) -> f64 {
        let precision = self.spread(sigma).powi(-2);
        precision * share(self.freedom, 1.0, residual * residual * precision)
    }

    /// What an element says on average [1/mm^2].
    pub fn information(&self, sigma: f64) -> f64 {
        self.spread(sigma).powi(-2) * share(self.freedom, 1.0, 3.0)
    }

    /// `ln p(r)` of a residual [mm].
    pub fn log_likelihood(&self, sigma: f64, residual: f64) -> f64 {
        self.log_norm() + self.log_shape(sigma, residual)
    }

    /// The same less what all residuals have in common.
    pub fn log_shape(&self, sigma: f64, residual: f64) -> f64 {
        let variance = self.scale * self.scale + sigma * sigma;
        let (nu, square) = (self.freedom, residual * residual / variance);
        let shape = if nu.is_finite() { -0.5 * (nu + 1.0) * (square / nu).ln_1p() } else { -0.5 * square };
        shape - 0.5 * variance.ln()
    }

    /// What all residuals have in common.
    fn log_norm(&self) -> f64 {
        let nu = self.freedom;
        let root_of_nu =
            if nu.is_finite() { ln_gamma((nu + 1.0) / 2.0) - ln_gamma(nu / 2.0) - 0.5 * (nu / 2.0).ln() } else { 0.0 };
        root_of_nu - 0.5 * core::f64::consts::TAU.ln()
    }

    /// Most probable for a block's elements, each with its error and its stated noise [mm]: tails are tried from these on, as long as they are more probable.
    pub fn most_probable(self, elements: &[(f64, f64)]) -> Self {
        if elements.is_empty() {
            return Self::NOTHING;
        }
        let told = |freedom: f64| {
            let one = Self { scale: scale(elements, freedom), freedom };
            let shape = elements.iter().map(|&(error, sigma)| one.log_shape(sigma, error)).sum::<f64>();
            (elements.len() as f64 * one.log_norm() + shape, one)
        };
        let from = FREEDOMS.partition_point(|&freedom| freedom < self.freedom).min(FREEDOMS.len() - 1);
        let mut best = told(FREEDOMS[from]);
        let mut climb = |further: &mut dyn Iterator<Item = &f64>| {
            for tried in further.map(|&freedom| told(freedom)) {
                if tried.0 <= best.0 {
                    break;
                }
                best = tried;
            }
        };
        climb(&mut FREEDOMS[..from].iter().rev());
        climb(&mut FREEDOMS[from + 1..].iter());
        let normal = told(f64::INFINITY);
        if best.0 > normal.0 + BY_CHANCE { best.1 } else { normal.1 }
    }
}

/// `(nu + over)/(nu + under)`, 1 of a normal distribution.
fn share(nu: f64, over: f64, under: f64) -> f64 {
    if nu.is_finite() { (nu + over) / (nu + under) } else { 1.0 }
}

/// `tau` at which the likelihood of the elements is largest: the mean of `r^2` times weight is 1.
fn scale(elements: &[(f64, f64)], freedom: f64) -> f64 {
    let tails = freedom.recip();
    let square = |&(r, sigma): &(f64, f64)| [(1.0 + tails) * r * r, 1.0, sigma * sigma + tails * r * r];
    variance(0.0, elements.iter().map(square)).sqrt()
}

/// The `v` from some start on at which the mean of `a/(b v + c)` is 1, or the start where it is less.
///
/// The inverse of that mean is concave, so that Newton's steps on it from below never go too far.
pub fn variance(start: f64, terms: impl Iterator<Item = [f64; 3]> + Clone) -> f64 {
    let mut variance = start;
    for _ in 0..STEPS {
        let (mut count, mut sum, mut slope) = (0.0, 0.0, 0.0);
        for [a, b, c] in terms.clone() {
            let below = (b * variance + c).recip();
            count += 1.0;
            sum += a * below;
            slope += a * below * b * below;
        }
        let mean: f64 = sum / count;
        if mean.is_nan() || mean < 1.0 + ENOUGH {
            break;
        }
        variance += mean * (mean - 1.0) * count / slope;
    }
    variance
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand::rngs::StdRng;
    use rand_distr::{Distribution, StudentT};

    #[test]
    fn its_slope_is_the_weight_and_its_mean_the_information() {
        let (missed, sigma, step) = (Missed { scale: 0.03, freedom: 4.0 }, 0.01, 1e-6);
        let mut information = 0.0;
        for i in -40_000..=40_000 {
            let r = f64::from(i) * 1e-4;
            let at = |r| missed.log_likelihood(sigma, r);
            let slope = (at(r + step) - at(r - step)) / (2.0 * step);
            // third derivative times step^2, and rounding over the step
            assert!((slope + missed.weight(sigma, r) * r).abs() < 1e-6 * (1.0 + slope.abs()), "{r}: {slope}");
            information += slope * slope * at(r).exp() * 1e-4;
        }
        // the tails beyond 4 mm hold less than 1e-8
        assert!((information / missed.information(sigma) - 1.0).abs() < 1e-4, "{information}");
        assert_eq!(Missed::NOTHING.weight(sigma, 5.0), Missed::NOTHING.information(sigma));
        assert_eq!(missed.weight(f64::INFINITY, 0.0), 0.0);
    }

    #[test]
    fn a_variance_makes_the_mean_one() {
        let terms =
            |tails: f64| (1..50).map(move |i| [f64::from(i).powi(3), 1e3 / f64::from(i), 0.1 + tails * f64::from(i)]);
        for tails in [0.0, 2.0] {
            let found = variance(0.0, terms(tails));
            let mean = terms(tails).map(|[a, b, c]| a / (b * found + c)).sum::<f64>() / 49.0;
            assert!((mean - 1.0).abs() < 2.0 * ENOUGH, "{mean}");
        }
        assert_eq!(variance(0.5, [[0.1, 1.0, 0.0]].into_iter()), 0.5);
    }

    #[test]
    fn size_and_tails_are_learnt() {
        let mut random = StdRng::seed_from_u64(3);
        for freedom in [2.0, 4.0, 1e9] {
            let noise = StudentT::new(freedom).unwrap();
            let elements: Vec<(f64, f64)> = (0..4000).map(|_| (0.02 * noise.sample(&mut random), 1e-4)).collect();
            let missed = Missed::NOTHING.most_probable(&elements);
            // 4000 elements tell the scale to 1.1 % sqrt((nu + 3)/nu) and 1/nu to about 0.015: four standard deviations
            assert!((missed.scale / 0.02 - 1.0).abs() < 0.07, "{missed:?}");
            assert!((1.0 / missed.freedom - 1.0 / freedom).abs() < 0.06, "{missed:?}");
        }
    }
}
