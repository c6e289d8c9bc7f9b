//! Which noise monitors have in common within a frame, learnt from whitened differences of repeats.
//!
//! Of each frame there are the differences `z` of some monitors, of variance 1. With a common mode in the pattern `g` they have the
//! covariance `diag(1 - g^2) + g g^T`. Of the momentum's jitter the pattern is the dispersion over the noise, times the rms jitter; of a
//! crate it is the root of the common share in its monitors. How crates are wired is not known: each group of neighbours, in the order of
//! reading and in that along the ring, is tried beside the crates found so far, with a correction for their number. A mode is taken over
//! where its evidence (Laplace, half-normal prior) exceeds that of none.
//!
//! Source: K. V. Mardia, J. T. Kent and J. M. Bibby, Multivariate Analysis (1979), ch. 9, the factor model of known pattern.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector};
use twin::Measured;

use super::columns::beside;
use super::half_normal::HalfNormal;
use super::laplace::Peak;

/// Whitened differences.
pub struct Differences {
    /// Rows frames, columns monitors; not a number where there is none.
    pub all: DMatrix<f64>,
    alike: Vec<Alike>,
}

/// Frames in which the same monitors have a difference.
struct Alike {
    monitors: Vec<usize>,
    frames: f64,
    /// Sum of `z z^T`.
    products: DMatrix<f64>,
}

/// Monitors that share a crate.
#[derive(Debug, Clone, PartialEq)]
pub struct Crate {
    /// The monitors, by index.
    pub monitors: Vec<usize>,
    /// Share of their noise's variance that is common [1].
    pub share: Measured,
}

/// Width of the prior of a crate's share: more than a quarter of the noise is not ordinary.
pub const CRATE: f64 = 0.25;
/// Sizes of the groups that are tried.
const SIZES: core::ops::RangeInclusive<usize> = 2..=8;
/// Crates at most.
const MOST: usize = 12;
/// Part of the noise that is always a monitor's own.
const OWN: f64 = 0.01;
/// Steps of a search through sizes, each a factor; over some 3 prior widths.
const SEARCH: usize = 12;
const FACTOR: f64 = 1.6;
/// Points at which the range of what is not needed is integrated.
const RANGE: usize = 24;

impl Alike {
    /// `ln` density of the frames over that of independent differences: with `S = diag(own) + G G^T`, `V = diag(own)^-1 G` and `N = 1 + G^T V`,
    /// `ln det S = sum of ln own + ln det N` and `S^-1 = diag(own)^-1 - V N^-1 V^T`.
    fn log_likelihood(&self, modes: &DMatrix<f64>) -> f64 {
        let modes = modes.select_rows(&self.monitors);
        let own =
            DVector::from_iterator(modes.nrows(), modes.row_iter().map(|row| (1.0 - row.norm_squared()).max(OWN)));
        let mut over = modes.clone();
        over.column_iter_mut().for_each(|mut column| column.component_div_assign(&own));
        let normal = DMatrix::identity(modes.ncols(), modes.ncols()) + modes.tr_mul(&over);
        let Some(factor) = normal.cholesky() else { return f64::NEG_INFINITY };
        let log_det = 2.0 * factor.l_dirty().diagonal().iter().map(|d| d.ln()).sum::<f64>();
        let squares = self.products.diagonal();
        let alone: f64 =
            own.iter().zip(&squares).map(|(own, square)| square * (1.0 / own - 1.0) + self.frames * own.ln()).sum();
        let together = factor.solve(&(over.tr_mul(&self.products) * over)).trace();
        -0.5 * (alone - together + self.frames * log_det)
    }
}

impl Differences {
    /// Of a matrix, rows frames, columns monitors, not a number where there is none.
    pub fn from_frames(all: DMatrix<f64>) -> Self {
        let mut alike: BTreeMap<Vec<usize>, Vec<usize>> = BTreeMap::new();
        for (frame, row) in all.row_iter().enumerate() {
            let seen = (0..row.len()).filter(|&b| !row[b].is_nan()).collect();
            alike.entry(seen).or_default().push(frame);
        }
        let products = |(monitors, frames): (Vec<usize>, Vec<usize>)| {
            let some = all.select_rows(&frames).select_columns(&monitors);
            Alike { products: some.tr_mul(&some), monitors, frames: frames.len() as f64 }
        };
        Self { alike: alike.into_iter().map(products).collect(), all }
    }

    /// `ln` likelihood of common modes, one a column [monitors][modes], over that of none.
    pub fn log_likelihood(&self, modes: &DMatrix<f64>) -> f64 {
        self.alike.iter().map(|frames| frames.log_likelihood(modes)).sum()
    }

    /// The rms momentum jitter of a pattern per momentum [1], with `width` that of its prior, beside known modes.
    pub fn momentum(&self, pattern: &DVector<f64>, width: f64, known: &DMatrix<f64>) -> Measured {
        let without = self.log_likelihood(known);
        let with = |jitter: f64| self.log_likelihood(&beside(known.clone(), &(pattern * jitter))) - without;
        self.sampled(learnt(with, width, 0.0), 0.5)
    }

    /// With the error of a sample of the frames: readings are in units of their rms in these, that of the mode included. `power`: 1/2 of an
    /// rms, 1 of a variance.
    fn sampled(&self, found: Measured, power: f64) -> Measured {
        let frames = self.all.row_iter().filter(|frame| frame.iter().any(|z| !z.is_nan())).count();
        let sample = found.value * power * (2.0 / frames.max(1) as f64).sqrt();
        Measured { sigma: found.sigma.hypot(sample), ..found }
    }

    /// Crates, beside known modes, and what the recording allows of one more, whose neighbours are in one of some `orders`.
    pub(crate) fn crates(&self, others: &DMatrix<f64>, orders: &[Vec<usize>]) -> (Vec<Crate>, Measured) {
        let correlation = self.correlation(others);
        let strength = |group: &&[usize]| strength(&correlation, group);
        let mut groups = groups(orders);
        let correction = (groups.len().max(1) as f64).ln();
        let mut crates: Vec<Crate> = Vec::new();
        loop {
            let Some(group) = groups.iter().copied().max_by(|a, b| strength(a).total_cmp(&strength(b))) else {
                return (crates, Measured { value: 0.0, sigma: CRATE });
            };
            let known = with_crates(others, &crates);
            let without = self.log_likelihood(&known);
            let with = |share: f64| beside(known.clone(), &crate_mode(others.nrows(), group, share));
            let share = learnt(|share| self.log_likelihood(&with(share)) - without, CRATE, correction);
            let share = self.sampled(Measured { value: share.value.min(1.0 - OWN), ..share }, 1.0);
            if share.value == 0.0 || crates.len() == MOST {
                return (crates, share);
            }
            crates.push(Crate { monitors: group.to_vec(), share });
            groups.retain(|other| !other.iter().any(|b| group.contains(b)));
        }
    }

    /// Mean products of pairs of monitors in units of their errors without correlation, the part of known modes taken out.
    pub fn correlation(&self, known: &DMatrix<f64>) -> DMatrix<f64> {
        let monitors = self.all.ncols();
        let common = known * known.transpose();
        let mut sums = DMatrix::zeros(monitors, monitors);
        for b in 0..monitors {
            for other in 0..b {
                let pairs = self.all.column(b).component_mul(&self.all.column(other));
                let known = pairs.iter().filter(|product| !product.is_nan());
                let (sum, count) = known.fold((0.0, 0.0), |(sum, count), product| (sum + product, count + 1.0));
                let off = if count > 0.0 { (sum - count * common[(b, other)]) / f64::sqrt(count) } else { 0.0 };
                sums[(b, other)] = off;
                sums[(other, b)] = off;
            }
        }
        sums
    }
}

/// A size with a half-normal prior, `ln` likelihood over that of none given, `correction` being the `ln` of the number of ways tried. Where
/// none is more likely it is 0, and the error is the root mean square of the posterior, none included.
fn learnt(log_likelihood: impl Fn(f64) -> f64, width: f64, correction: f64) -> Measured {
    let log_prior = |x: f64| core::f64::consts::FRAC_2_PI.sqrt().ln() - 0.5 * x * x + x.ln();
    let density = |size: f64| log_likelihood(size) + log_prior(size / width);
    let sizes = (0..SEARCH).map(|i| 3.0 * width / FACTOR.powi(i as i32));
    let start = sizes.map(|size| (size, density(size))).max_by(|a, b| a.1.total_cmp(&b.1)).map_or(width, |best| best.0);
    let bounds = [[(width * 1e-3).ln(), (width * 4.0).ln()]];
    let peak = Peak::find(|x| density(x[0].exp()), &DVector::from_element(1, start.ln()), &bounds);
    if let Some(peak) = peak.filter(|peak| peak.log_integral > correction) {
        let value = peak.at[0].exp();
        return Measured { value, sigma: value * peak.sigma(0) };
    }
    Measured { value: 0.0, sigma: HalfNormal::from_log_likelihood(log_likelihood, width, RANGE).range(correction) }
}

/// Groups of neighbours that may share a crate, in some orders.
pub fn groups(orders: &[Vec<usize>]) -> Vec<&[usize]> {
    SIZES.flat_map(|size| orders.iter().flat_map(move |order| order.windows(size))).collect()
}

/// Modes, and one for each crate.
pub fn with_crates(modes: &DMatrix<f64>, crates: &[Crate]) -> DMatrix<f64> {
    let of_crate = |one: &Crate| crate_mode(modes.nrows(), &one.monitors, one.share.value);
    crates.iter().fold(modes.clone(), |modes, one| beside(modes, &of_crate(one)))
}

/// The mode of a crate: the root of its share in each of its monitors.
fn crate_mode(monitors: usize, group: &[usize], share: f64) -> DVector<f64> {
    let mut mode = DVector::zeros(monitors);
    group.iter().for_each(|&b| mode[b] = share.max(0.0).sqrt());
    mode
}

/// How many errors the pairs within a group are correlated by on average.
fn strength(correlation: &DMatrix<f64>, group: &[usize]) -> f64 {
    let pairs = (0..group.len()).flat_map(|i| (0..i).map(move |j| (group[i], group[j])));
    let all: Vec<f64> = pairs.map(|(b, other)| correlation[(b, other)]).collect();
    all.iter().sum::<f64>() / (all.len() as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Of frames with and without some monitors, as the normal density of each with its covariance.
    #[test]
    fn the_likelihood_is_that_of_every_frame() {
        let wave = |i: usize, b: usize| (0.7 + (5 * i + 3 * b) as f64).sin();
        let is_missing = |i: usize, b: usize| (i + 2 * b).is_multiple_of(7);
        let all = DMatrix::from_fn(12, 6, |i, b| if is_missing(i, b) { f64::NAN } else { 1.5 * wave(i, b) });
        let modes = DMatrix::from_fn(6, 2, |b, k| 0.5 * wave(k, b));
        let density = |z: &DVector<f64>, covariance: DMatrix<f64>| {
            let factor = covariance.cholesky().unwrap();
            -0.5 * (z.dot(&factor.solve(z)) + 2.0 * factor.l_dirty().diagonal().iter().map(|d| d.ln()).sum::<f64>())
        };
        let of_frame = |i: usize| {
            let seen: Vec<usize> = (0..6).filter(|&b| !is_missing(i, b)).collect();
            let z = DVector::from_iterator(seen.len(), seen.iter().map(|&b| all[(i, b)]));
            let modes = modes.select_rows(&seen);
            let mut covariance = &modes * modes.transpose();
            covariance.fill_diagonal(1.0);
            density(&z, covariance) - density(&z, DMatrix::identity(seen.len(), seen.len()))
        };
        let known: f64 = (0..12).map(of_frame).sum();
        let found = Differences::from_frames(all.clone()).log_likelihood(&modes);
        assert!((found - known).abs() < 1e-12 * known.abs(), "{found} {known}");
    }
}
