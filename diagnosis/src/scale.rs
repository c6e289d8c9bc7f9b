//! How large the noise of each monitor is, over what the recording's header states.
//!
//! Each monitor's own measurement, from its repeats, has a known error. The logarithms of the true scales are normal about a common one,
//! which the header knows to a prior width, with a scatter between monitors; both are taken over only where the evidence asks for them, so
//! that monitors that agree with the header keep its noise exactly. A monitor far from all others has a scale of its own.
//!
//! Source: A. Gelman et al., Bayesian Data Analysis (2013), ch. 5.4, the hierarchical normal model; E. B. Wilson and M. M. Hilferty, PNAS 17 (1931) 684.

use twin::{Measured, median};

use super::half_normal::HalfNormal;

/// Scales of the monitors.
#[derive(Debug, Clone, PartialEq)]
pub struct Scales {
    /// `ln` of the common scale.
    pub common: Measured,
    /// Scatter of `ln` of the scales between monitors.
    pub scatter: Measured,
    /// Scale of each, 1 of one of which nothing is known.
    pub each: Vec<f64>,
}

/// Width of the prior of the common scale: a noise is quoted to a quarter, since it depends on intensity and filling pattern.
pub const QUOTED: f64 = 0.25;
/// Width of the prior of the scatter: monitors of one make differ by a tenth.
pub const ALIKE: f64 = 0.1;
/// A monitor this many standard deviations from the others has a scale of its own.
const FAR: f64 = 4.0;
/// Scatters that are tried.
const SCATTERS: usize = 60;

impl Scales {
    /// From each monitor's `ln` of its measured scale, where there is one.
    pub fn from_measured(measured: &[Option<Measured>]) -> Self {
        let known: Vec<Measured> = measured.iter().copied().flatten().collect();
        let (near, scatter) = Self::scatter_of(&known);
        let common = common_of(&near, scatter.value);
        let shrunk_scale = |one: &Option<Measured>| one.map_or(0.0, |one| shrunk(one, common.value, scatter.value));
        Self { each: measured.iter().map(|one| shrunk_scale(one).exp()).collect(), common, scatter }
    }

    /// The monitors near the others, and the scatter of these.
    fn scatter_of(known: &[Measured]) -> (Vec<Measured>, Measured) {
        let mut near = known.to_vec();
        // the furthest one goes first: it widens the scatter of the others
        while near.len() > 2
            && let Some(at) = furthest(&near)
        {
            near.remove(at);
        }
        let scatter = scatter_among(&near).unwrap_or(Measured { value: 0.0, sigma: ALIKE });
        (near, scatter)
    }
}

/// Of the scales that are far from the others the furthest, in standard deviations.
fn furthest(all: &[Measured]) -> Option<usize> {
    let centre = centre_of(all);
    let off = |one: &Measured| (one.value - centre).abs() / one.sigma;
    let far = (0..all.len()).filter(|&at| !is_alike(all, at));
    far.max_by(|&a, &b| off(&all[a]).total_cmp(&off(&all[b])))
}

/// True if one of some scales lies near the others, by the scatter of these alone.
fn is_alike(all: &[Measured], at: usize) -> bool {
    let mut others = all.to_vec();
    let left_out = others.remove(at);
    let scatter = scatter_among(&others).map_or(0.0, |scatter| scatter.value);
    !is_far(left_out, centre_of(&others), scatter)
}

/// The scatter of some scales, 0 with its root mean square where none is more likely; none without any scale.
fn scatter_among(near: &[Measured]) -> Option<Measured> {
    if near.is_empty() {
        return None;
    }
    let log_density = |scatter: f64| {
        let weights: Vec<f64> = near.iter().map(|one| one.sigma.hypot(scatter).powi(-2)).collect();
        let total: f64 = weights.iter().sum();
        let mean = near.iter().zip(&weights).map(|(one, weight)| one.value * weight).sum::<f64>() / total;
        let square: f64 = near.iter().zip(&weights).map(|(one, weight)| (one.value - mean).powi(2) * weight).sum();
        0.5 * (weights.iter().map(|weight| weight.ln()).sum::<f64>() - square - total.ln())
    };
    let posterior = HalfNormal::from_log_likelihood(log_density, ALIKE, SCATTERS);
    let needed = posterior.log_evidence > log_density(0.0);
    let of_grid = || Measured { value: posterior.mean, sigma: posterior.sigma() };
    Some(if needed { of_grid() } else { Measured { value: 0.0, sigma: posterior.square.sqrt() } })
}

/// The common scale of some, 0 where none is more likely.
fn common_of(near: &[Measured], scatter: f64) -> Measured {
    let weights: Vec<f64> = near.iter().map(|one| one.sigma.hypot(scatter).powi(-2)).collect();
    let total: f64 = weights.iter().sum();
    if total == 0.0 {
        return Measured { value: 0.0, sigma: QUOTED };
    }
    let mean = near.iter().zip(&weights).map(|(one, weight)| one.value * weight).sum::<f64>() / total;
    let (variance, prior) = (1.0 / total, QUOTED * QUOTED);
    let gain = 0.5 * (mean * mean / variance - mean * mean / (variance + prior) - ((variance + prior) / variance).ln());
    let sigma = (prior * variance / (prior + variance)).sqrt();
    let value = if gain > 0.0 { mean * prior / (prior + variance) } else { 0.0 };
    Measured { value, sigma }
}

/// `ln` of the scale of one monitor.
fn shrunk(one: Measured, common: f64, scatter: f64) -> f64 {
    if is_far(one, common, scatter) {
        return one.value;
    }
    common + (one.value - common) * scatter.powi(2) / (scatter.powi(2) + one.sigma.powi(2))
}

/// True for a scale far from the others.
fn is_far(one: Measured, centre: f64, scatter: f64) -> bool {
    let off = one.value - centre;
    off.abs() > by_chance(&one, off < 0.0).hypot(FAR * scatter)
}

/// How far chance takes `ln` of a measured scale, down or up. A variance of `n` differences is a chi-square, of which the cube root is nearly normal about
/// `1 - v` with the variance `v = 2/(9 n)`, and not the logarithm, whose error is `s = 1/sqrt(2 n)`: half the noise in twenty differences would seem less
/// likely than it is.
fn by_chance(one: &Measured, down: bool) -> f64 {
    let variance = 4.0 / 9.0 * one.sigma.powi(2);
    let least = (1.0 - variance - FAR * variance.sqrt()).max(0.0);
    if down { -1.5 * least.ln() } else { FAR * one.sigma }
}

/// Their median.
fn centre_of(all: &[Measured]) -> f64 {
    median(all.iter().map(|one| one.value)).unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Of 22 differences half of the noise has a probability of 1.4e-4, among thirty monitors one in 250 campaigns; twice the noise 1e-9.
    #[test]
    fn few_quiet_differences_are_chance_and_few_loud_ones_are_not() {
        let of = |scales: &[f64]| {
            let others = (0..29).map(|_| Some(Measured { value: 0.0, sigma: 0.15 }));
            let own = |scale: &f64| Some(Measured { value: scale.ln(), sigma: 44_f64.sqrt().recip() });
            Scales::from_measured(&others.chain(scales.iter().map(own)).collect::<Vec<_>>()).each.split_off(29)
        };
        assert_eq!(of(&[0.51]), [1.0]);
        let own = of(&[2.0, 0.2]);
        assert!((own[0] - 2.0).abs() < 1e-9 && (own[1] - 0.2).abs() < 1e-9, "{own:?}");
        // the quiet one, further in the logarithm, does not hide the loud one
        let own = of(&[0.51, 1.88]);
        assert!(own[0] == 1.0 && (own[1] - 1.88).abs() < 1e-9, "{own:?}");
    }

    #[test]
    fn scales_far_apart_stay_numbers() {
        // an orbit that drifts makes the noise of monitors as different as their beta functions, to far beyond their errors
        let measured: Vec<Option<Measured>> =
            (0..30).map(|b| Some(Measured { value: f64::from(b % 7), sigma: 0.02 })).collect();
        let scales = Scales::from_measured(&measured);
        assert!(scales.scatter.value.is_finite() && scales.common.sigma.is_finite());
        for (scale, measured) in scales.each.iter().zip(measured.iter().flatten()) {
            // the scatter among them is a hundred times each error, so that none is shrunk by more than a hundredth of its error
            assert!((scale.ln() - measured.value).abs() < 0.2 * measured.sigma, "{scale}");
        }
    }
}
