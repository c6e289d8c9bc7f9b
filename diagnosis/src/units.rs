//! The Gaussian about the best point of a fit, within the range of the vars.
//!
//! A var whose best value lies at a bound is held there: the Gaussian of the others is that given its value, and its own density falls
//! as `exp(-g x - h x^2/2)` from the bound, g the slope and h the curvature with the others adapting. For a free var the evidence
//! contains the part of its normal distribution within the range, as if the vars were independent.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector};

use evidence::Factor;
use inference::{Coordinates, Prior};

/// Precision given to a var that is held.
const HELD: f64 = 1e12;
/// Distance from a bound within which a var counts as at the bound, in prior standard deviations.
const AT: f64 = 1e-9;

/// Params `theta = ln var` in units of their prior standard deviations, `u = (theta - mean)/sigma` [N].
#[derive(Debug, Clone, PartialEq)]
pub struct Units {
    mean: DVector<f64>,
    /// Prior standard deviation of each param.
    pub sigma: DVector<f64>,
    /// Range of each u.
    range: Vec<[f64; 2]>,
    /// Their coordinates without bounds, for a sampler.
    pub coordinates: Coordinates,
}

impl Units {
    /// Of a prior that has a width.
    pub fn from_prior(prior: &Prior) -> Self {
        let sigma = prior.precision.map(|precision| precision.sqrt().recip());
        let range = |(i, range): (usize, &[f64; 2])| range.map(|bound| (bound - prior.mean[i]) / sigma[i]);
        Self {
            range: prior.range.iter().enumerate().map(range).collect(),
            mean: prior.mean.clone(),
            sigma,
            coordinates: Coordinates::from_prior(prior),
        }
    }

    /// The same of a prior whose standard deviations are so many times as large, within the same range.
    pub(crate) fn scaled(&self, by: f64) -> Self {
        let range = self.range.iter().map(|range| range.map(|bound| bound / by)).collect();
        Self { sigma: &self.sigma * by, range, ..self.clone() }
    }

    /// Number of params.
    pub fn len(&self) -> usize {
        self.range.len()
    }

    /// Params of the first unknowns.
    pub fn params(&self, u: &DVector<f64>) -> Vec<f64> {
        (0..self.len()).map(|i| self.mean[i] + self.sigma[i] * u[i]).collect()
    }

    /// The first unknowns of params.
    pub fn unknowns(&self, params: &[f64]) -> impl Iterator<Item = f64> {
        params.iter().enumerate().map(|(i, theta)| (theta - self.mean[i]) / self.sigma[i])
    }

    /// Smallest and largest factor of each param.
    pub fn ranges(&self) -> Vec<[f64; 2]> {
        let factor = |(i, range): (usize, &[f64; 2])| range.map(|u| (self.mean[i] + self.sigma[i] * u).exp());
        self.range.iter().enumerate().map(factor).collect()
    }

    /// Bounds of some unknowns, the params first; the others have none.
    pub fn bounds(&self, unknowns: usize) -> Vec<[f64; 2]> {
        let free = core::iter::repeat([f64::NEG_INFINITY, f64::INFINITY]);
        self.range.iter().copied().chain(free).take(unknowns).collect()
    }

    /// A covariance of unknowns as that of the params.
    pub fn covariance(&self, of_unknowns: &DMatrix<f64>) -> DMatrix<f64> {
        DMatrix::from_fn(self.len(), self.len(), |i, j| of_unknowns[(i, j)] * self.sigma[i] * self.sigma[j])
    }

    /// A step of the unknowns as one of the params.
    pub fn step(&self, of_unknowns: &DVector<f64>) -> DVector<f64> {
        of_unknowns.rows(0, self.len()).component_mul(&self.sigma)
    }
}

/// A Gaussian, and the share of it within the range.
pub struct BoundedGaussian {
    /// Factor of the precision, the held vars at their bounds.
    pub free: Factor,
    /// Slope of the log-density, zero for the held.
    pub slope: DVector<f64>,
    /// `ln` of the determinant of the free unknowns' precision.
    pub log_det: f64,
    /// `ln` of the share of the integral within the range.
    pub log_inside: f64,
}

impl BoundedGaussian {
    /// Of the factor of a precision and the slope at `u`, the first of which are params and have a range; none if the precision is not
    /// positive.
    pub fn from_precision(
        precision: &Factor,
        u: &DVector<f64>,
        mut slope: DVector<f64>,
        units: &Units,
    ) -> Option<Self> {
        let vars = units.len();
        let against = |&i: &usize| {
            let [lower, upper] = units.range[i];
            (u[i] <= lower + AT && slope[i] < 0.0) || (u[i] >= upper - AT && slope[i] > 0.0)
        };
        let held: BTreeMap<usize, f64> = (0..vars).filter(against).map(|i| (i, slope[i].abs())).collect();
        held.keys().for_each(|&i| slope[i] = 0.0);
        let (free, mut log_inside) =
            if held.is_empty() { (precision.clone(), 0.0) } else { holding(&precision.matrix(), &held)? };
        let of_vars = free.whiten(&DMatrix::identity(u.len(), vars));
        for i in (0..vars).filter(|i| !held.contains_key(i)) {
            let (sigma, [lower, upper]) = (of_vars.column(i).norm(), units.range[i]);
            log_inside += (normal_cdf((upper - u[i]) / sigma) - normal_cdf((lower - u[i]) / sigma)).ln();
        }
        let log_det = free.log_determinant() - held.len() as f64 * HELD.ln();
        Some(Self { free, slope, log_det, log_inside })
    }
}

/// The factor of a precision with some vars held at a bound, and `ln` of the integrals from their bounds; `held`: the slope of each.
fn holding(precision: &DMatrix<f64>, held: &BTreeMap<usize, f64>) -> Option<(Factor, f64)> {
    let mut matrix = precision.clone();
    for &i in held.keys() {
        matrix.row_mut(i).fill(0.0);
        matrix.column_mut(i).fill(0.0);
        matrix[(i, i)] = HELD;
    }
    let free = Factor::of(matrix)?;
    let of_one = |(&i, &pull): (&usize, &f64)| {
        let coupling = precision.column(i).map_with_location(|row, _, h| if held.contains_key(&row) { 0.0 } else { h });
        log_tail(pull, precision[(i, i)] - free.whiten(&coupling).norm_squared())
    };
    let log_tails = held.iter().map(of_one).sum();
    Some((free, log_tails))
}

/// `ln` of the integral of `exp(-g x - h x^2/2)` over x > 0, over that of a standard normal.
fn log_tail(g: f64, h: f64) -> f64 {
    // exp(z^2/2) (1 - cdf(z))/sqrt(h), z = g/sqrt(h); its asymptote where the tail underflows
    let z = g / h.sqrt();
    let scaled =
        if z < 25.0 { (0.5 * z * z).exp() * normal_cdf(-z) } else { 1.0 / (z * core::f64::consts::TAU.sqrt()) };
    scaled.ln() - 0.5 * h.ln()
}

fn normal_cdf(z: f64) -> f64 {
    0.5 * statrs::function::erf::erfc(-z / core::f64::consts::SQRT_2)
}
