//! Which noise monitors have in common within a frame, learnt from whitened differences of repeats.
//!
//! Of each frame there are the differences `z` of some monitors, of variance 1. With a common mode in the pattern `g` they have the
//! covariance `diag(1 - g^2) + g g^T`. Of the momentum's jitter the pattern is the dispersion over the noise, times the rms jitter; of a
//! crate it is the root of the common share in its monitors. How crates are wired is not known: groups of neighbours in the order of
//! reading and in that along the ring are tried, with a correction for their number. A mode is taken over where its evidence
//! (Laplace, half-normal prior) exceeds that of none.
//!
//! Source: K. V. Mardia, J. T. Kent and J. M. Bibby, Multivariate Analysis (1979), ch. 9, the factor model of known pattern.

use nalgebra::{DMatrix, DVector};
use twin::Measured;

use super::laplace::Peak;

/// Whitened differences, rows frames, columns monitors; not a number where there is none.
pub struct Differences(pub DMatrix<f64>);

/// Monitors that share a crate, and the share of their noise's variance that is common.
#[derive(Debug, Clone, PartialEq)]
pub struct Crates {
    /// The groups, by index of the monitors.
    pub groups: Vec<Vec<usize>>,
    /// The share [1].
    pub share: Measured,
}

/// Width of the prior of a crate's share: more than a quarter of the noise is not ordinary.
pub const CRATE: f64 = 0.25;
/// Sizes of the groups that are tried.
const SIZES: core::ops::RangeInclusive<usize> = 2..=8;
/// Part of the noise that is always a monitor's own.
const OWN: f64 = 0.05;
/// Steps of a search through sizes, each a factor; over some 3 prior widths.
const SEARCH: usize = 12;
const FACTOR: f64 = 1.6;
/// Points at which the range of what is not needed is integrated, over 3 prior widths.
const RANGE: usize = 24;

impl Differences {
    /// `ln` likelihood of common modes, one a column [monitors][modes], over that of none.
    fn log_likelihood(&self, modes: &DMatrix<f64>) -> f64 {
        let own: Vec<f64> = modes.row_iter().map(|row| (1.0 - row.norm_squared()).max(OWN)).collect();
        self.0.row_iter().map(|frame| of_frame(frame.iter().copied(), &own, modes)).sum()
    }

    /// The rms momentum jitter of a pattern per momentum [1/1], with `width` that of its prior.
    pub fn momentum(&self, pattern: &DVector<f64>, width: f64) -> Measured {
        let modes = |jitter: f64| DMatrix::from_columns(&[pattern * jitter]);
        learnt(|jitter| self.log_likelihood(&modes(jitter)), width, 0.0)
    }

    /// Crates, beside the momentum's jitter (its mode); none if there is no sign of any. `orders`: the monitors one beside another.
    pub fn crates(&self, jitter: &DVector<f64>, orders: &[Vec<usize>]) -> (Option<Crates>, Measured) {
        let correlation = self.correlation(jitter);
        let wirings: Vec<Vec<Vec<usize>>> = orders.iter().flat_map(|order| wirings(order)).collect();
        let strength = |groups: &Vec<Vec<usize>>| strength(&correlation, groups);
        let Some(groups) = wirings.iter().max_by(|a, b| strength(a).total_cmp(&strength(b))) else {
            return (None, Measured { value: 0.0, sigma: 0.0 });
        };
        let without = self.log_likelihood(&DMatrix::from_columns(core::slice::from_ref(jitter)));
        let density = |share: f64| self.log_likelihood(&modes(jitter, groups, share)) - without;
        let share = learnt(density, CRATE, (wirings.len() as f64).ln());
        ((share.value > 0.0).then(|| Crates { groups: groups.clone(), share }), share)
    }

    /// Mean products of pairs of monitors in units of their errors without correlation, the jitter's part taken out.
    fn correlation(&self, jitter: &DVector<f64>) -> DMatrix<f64> {
        let monitors = self.0.ncols();
        let mut sums = DMatrix::zeros(monitors, monitors);
        for b in 0..monitors {
            for other in 0..b {
                let pairs = self.0.column(b).component_mul(&self.0.column(other));
                let known = pairs.iter().filter(|product| !product.is_nan());
                let (sum, count) = known.fold((0.0, 0.0), |(sum, count), product| (sum + product, count + 1.0));
                let off = if count > 0.0 { (sum - count * jitter[b] * jitter[other]) / f64::sqrt(count) } else { 0.0 };
                sums[(b, other)] = off;
                sums[(other, b)] = off;
            }
        }
        sums
    }
}

/// A size with a half-normal prior, `ln` likelihood over that of none given; 0, with its root mean square by the posterior, where that is
/// no more likely than none, `correction` being the `ln` of the number of ways tried.
fn learnt(log_likelihood: impl Fn(f64) -> f64, width: f64, correction: f64) -> Measured {
    let log_prior = |x: f64| core::f64::consts::FRAC_2_PI.sqrt().ln() - 0.5 * x * x + x.ln();
    let density = |size: f64| log_likelihood(size) + log_prior(size / width);
    let sizes = (0..SEARCH).map(|i| 3.0 * width / FACTOR.powi(i as i32));
    let start = sizes.map(|size| (size, density(size))).max_by(|a, b| a.1.total_cmp(&b.1)).map_or(width, |best| best.0);
    let bounds = [[(width * 1e-3).ln(), (width * 4.0).ln()]];
    let peak = Peak::of(|x| density(x[0].exp()), &DVector::from_element(1, start.ln()), &bounds);
    if let Some(peak) = peak.filter(|peak| peak.log_integral > correction) {
        let value = peak.at[0].exp();
        return Measured { value, sigma: value * peak.sigma(0) };
    }
    let point = |i: usize| (i as f64 + 0.5) * 3.0 / RANGE as f64;
    let weights: Vec<(f64, f64)> = (0..RANGE)
        .map(|i| (point(i) * width, (log_likelihood(point(i) * width) - 0.5 * point(i).powi(2)).exp()))
        .collect();
    let sum: f64 = weights.iter().map(|(_, weight)| weight).sum();
    let square: f64 = weights.iter().map(|(size, weight)| size * size * weight).sum();
    Measured { value: 0.0, sigma: if sum > 0.0 { (square / sum).sqrt() } else { width } }
}

/// `ln` density of one frame over that of independent differences: with `S = diag(own) + G G^T`,
/// `ln det S = sum of ln own + ln det(1 + G^T G/own)`.
fn of_frame(differences: impl Iterator<Item = f64>, own: &[f64], modes: &DMatrix<f64>) -> f64 {
    let k = modes.ncols();
    let (mut normal, mut pull) = (DMatrix::identity(k, k), DVector::zeros(k));
    let mut log = 0.0;
    for (b, z) in differences.enumerate().filter(|(_, z)| !z.is_nan()) {
        log -= 0.5 * (z * z * (1.0 / own[b] - 1.0) + own[b].ln());
        for i in 0..k {
            let share = modes[(b, i)] / own[b];
            pull[i] += share * z;
            (0..k).for_each(|j| normal[(i, j)] += share * modes[(b, j)]);
        }
    }
    let Some(factor) = normal.cholesky() else { return f64::NEG_INFINITY };
    let log_det: f64 = factor.l_dirty().diagonal().iter().map(|d: &f64| d.ln()).sum();
    log + 0.5 * pull.dot(&factor.solve(&pull)) - log_det
}

/// The jitter's mode, and one for each crate of a common share.
fn modes(jitter: &DVector<f64>, groups: &[Vec<usize>], share: f64) -> DMatrix<f64> {
    let mut modes = DMatrix::zeros(jitter.len(), groups.len() + 1);
    modes.set_column(0, jitter);
    for (i, group) in groups.iter().enumerate() {
        group.iter().for_each(|&b| modes[(b, i + 1)] = share.max(0.0).sqrt());
    }
    modes
}

/// All ways to divide an order into groups of one size, but for those at its ends.
fn wirings(order: &[usize]) -> Vec<Vec<Vec<usize>>> {
    let of_size = |size: usize| {
        (0..size.min(order.len())).map(move |first| {
            let (start, rest) = order.split_at(first);
            let groups = core::iter::once(start).chain(rest.chunks(size));
            groups.filter(|group| group.len() > 1).map(<[usize]>::to_vec).collect::<Vec<_>>()
        })
    };
    SIZES.flat_map(of_size).filter(|groups| !groups.is_empty()).collect()
}

/// How many errors the pairs within groups are correlated by on average.
fn strength(correlation: &DMatrix<f64>, groups: &[Vec<usize>]) -> f64 {
    let pairs = |group: &Vec<usize>| {
        let group = group.clone();
        (0..group.len()).flat_map(move |i| (0..i).map(|j| (group[i], group[j])).collect::<Vec<_>>()).collect::<Vec<_>>()
    };
    let all: Vec<f64> =
        groups.iter().flat_map(|group| pairs(group)).map(|(b, other)| correlation[(b, other)]).collect();
    all.iter().sum::<f64>() / (all.len().max(1) as f64).sqrt()
}
