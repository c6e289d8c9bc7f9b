//! What is known of the params before any data: for each `theta = ln var` a normal within a range.

use estimator::Marginal;
use nalgebra::DVector;
use rand::rngs::StdRng;
use rand_distr::{Distribution, Normal};
use twin::{ParameterPrior, Ring};

/// Prior of every param [N].
#[derive(Debug, Clone, PartialEq)]
pub struct Prior {
    /// Mean of each theta; 0 where the density is flat.
    pub mean: DVector<f64>,
    /// One over the variance of each theta; 0 where the density is flat.
    pub precision: DVector<f64>,
    /// Smallest and largest theta of each.
    pub range: Vec<[f64; 2]>,
}

/// Shape of a prior within its range.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Width {
    /// Lognormal, before it ends at the range's bounds of mean exactly 1 and this standard deviation: `ln var` is normal with
    /// variance `ln(1 + w^2)` and mean minus half of it.
    Lognormal(f64),
    /// Flat in `ln var`: the limit of a lognormal of median 1 that grows wide.
    Loguniform,
}

impl Width {
    /// Mean and precision of theta; both 0 where the density of theta is flat.
    pub fn normal(self) -> (f64, f64) {
        match self {
            Self::Lognormal(width) => {
                let variance = width.powi(2).ln_1p();
                (-0.5 * variance, 1.0 / variance)
            }
            Self::Loguniform => (0.0, 0.0),
        }
    }
}

impl Prior {
    /// That of a ring's params.
    pub fn from_ring(ring: &Ring) -> Self {
        Self::shaped(ring, |prior| Width::Lognormal(prior.width))
    }

    /// The ranges of a ring's params, and one shape for all.
    pub fn of_width(ring: &Ring, width: Width) -> Self {
        Self::shaped(ring, |_| width)
    }

    fn shaped(ring: &Ring, width: impl Fn(&ParameterPrior) -> Width) -> Self {
        let normals: Vec<(f64, f64)> = ring.parameters.iter().map(|p| width(&p.prior).normal()).collect();
        Self {
            mean: DVector::from_iterator(normals.len(), normals.iter().map(|(mean, _)| *mean)),
            precision: DVector::from_iterator(normals.len(), normals.iter().map(|(_, precision)| *precision)),
            range: ring.parameters.iter().map(|p| p.prior.range.map(f64::ln)).collect(),
        }
    }

    /// The same with a range that ends nowhere within some standard deviations of the mean; a flat density ends where it did.
    #[must_use]
    pub fn reaching(&self, deviations: f64) -> Self {
        let wider = |(i, &[lower, upper]): (usize, &[f64; 2])| match self.precision[i] {
            0.0 => [lower, upper],
            precision => {
                let reach = deviations / precision.sqrt();
                [lower.min(self.mean[i] - reach), upper.max(self.mean[i] + reach)]
            }
        };
        Self { range: self.range.iter().enumerate().map(wider).collect(), ..self.clone() }
    }

    /// Number of params.
    pub fn len(&self) -> usize {
        self.range.len()
    }

    /// True without any params.
    pub fn is_empty(&self) -> bool {
        self.range.is_empty()
    }

    /// The nearest params within the range.
    pub fn clamp(&self, params: &DVector<f64>) -> DVector<f64> {
        params.map_with_location(|i, _, theta| theta.clamp(self.range[i][0], self.range[i][1]))
    }

    /// `sum of precision (theta - mean)^2`.
    pub fn cost(&self, params: &DVector<f64>) -> f64 {
        let away = params - &self.mean;
        away.component_mul(&away).dot(&self.precision)
    }

    /// Precision of a density as wide as each param's range: what a direction has that neither data nor a normal limit.
    pub(crate) fn precision_of_range(&self, i: usize) -> f64 {
        12.0 / (self.range[i][1] - self.range[i][0]).powi(2)
    }

    /// Marginal of a param, given mean and standard deviation of its normal.
    pub fn marginal(&self, i: usize, mean: f64, sigma: f64) -> Marginal {
        let [lower, upper] = self.range[i].map(|bound| bound as f32);
        Marginal { mean: mean as f32, sigma: sigma as f32, lower, upper }
    }
}

/// The ring with other priors: one width or range for all params, its own where none is given.
pub fn with_priors(ring: &Ring, width: Option<f64>, range: Option<[f64; 2]>) -> Ring {
    let mut ring = ring.clone();
    for parameter in &mut ring.parameters {
        parameter.prior.width = width.unwrap_or(parameter.prior.width);
        parameter.prior.range = range.unwrap_or(parameter.prior.range);
    }
    ring
}

/// A factor from its truncated lognormal prior.
///
/// # Panics
/// If the width is not positive.
pub fn draw(prior: &ParameterPrior, random: &mut StdRng) -> f64 {
    let (mean, precision) = Width::Lognormal(prior.width).normal();
    let normal = Normal::new(mean, precision.sqrt().recip()).expect("a width is positive");
    loop {
        let var = normal.sample(random).exp();
        if (prior.range[0]..=prior.range[1]).contains(&var) {
            return var;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_range_reaches_as_far_as_it_is_told_and_no_less_than_it_did() {
        let ring = with_priors(&Ring::booster(), None, Some([0.8, 1.06]));
        let prior = Prior::from_ring(&ring);
        let far = prior.reaching(5.0).range[7];
        assert_eq!(far[0], 0.8_f64.ln(), "beyond five deviations already");
        assert!((far[1] - (prior.mean[7] + 5.0 / prior.precision[7].sqrt())).abs() < 1e-15);
        let flat = Prior::of_width(&ring, Width::Loguniform);
        assert_eq!(flat.reaching(5.0), flat);
    }

    /// The lognormal's mean is 1 for any width: integrated over ln var.
    #[test]
    fn the_prior_has_mean_one() {
        for width in [0.01, 0.03, 0.3] {
            let (mean, precision) = Width::Lognormal(width).normal();
            assert!(((mean + 0.5 / precision).exp() - 1.0).abs() < 1e-15);
            // and the width that it says: exp(variance) - 1 = width^2
            assert!((((1.0 / precision).exp() - 1.0).sqrt() / width - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn what_is_given_replaces_the_priors_of_all_params() {
        let ring = with_priors(&Ring::booster(), Some(0.01), None);
        let (prior, own) = (Prior::from_ring(&ring), Prior::from_ring(&Ring::booster()));
        assert_eq!(prior.range, own.range);
        assert!((prior.precision[47] / 1e4 - 1.0).abs() < 1e-4); // ln(1 + w^2) = w^2 (1 - w^2/2)
        let narrow = Prior::from_ring(&with_priors(&ring, None, Some([0.99, 1.02])));
        assert_eq!((narrow.range[3], narrow.precision[3]), ([0.99f64.ln(), 1.02f64.ln()], prior.precision[3]));
    }
}
