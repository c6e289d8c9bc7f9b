//! The posterior of vars and amplitudes of a hypothesis, sampled by NUTS to validate the Gaussian of its fit.
//!
//! In units of prior standard deviations, `-cost/2` is the log-density of u. The vars have coordinates w without bounds (see
//! [`inference::Bounded`]), and all of them those of the Gaussian: `w = best + L^-T z`, `L L^T` the curvature in w.

use core::ops::ControlFlow;
use std::sync::Arc;

use diagnosis::{Data, Fitted};
use inference::Bounded;
use inference::nuts::{Density, NutsError, NutsRun, NutsSettings, Unstable, explore};
use nalgebra::{DMatrix, DVector};

/// A fitted hypothesis, its density sampled.
struct Extended {
    data: Data,
    fitted: Fitted,
    /// `L^-T`.
    spread: DMatrix<f64>,
}

/// Sample vars and amplitudes about a fit; the draws hold the vars and all other unknowns, in the order of the fit, the latter in
/// prior standard deviations.
///
/// # Errors
/// [`NutsError`].
pub fn sample(data: &Data, fitted: &Fitted, settings: NutsSettings) -> Result<NutsRun, NutsError> {
    let size = fitted.u.len();
    let lower = curvature(fitted).cholesky().expect("a positive matrix with positive numbers added").l();
    let inverse = lower.solve_lower_triangular(&DMatrix::identity(size, size)).expect("a Cholesky factor is regular");
    let unknowns = fitted.hypothesis.unknowns(data);
    let mut names = data.ring.var_names();
    names.extend((0..unknowns.len()).map(|i| format!("unknown {i}")));
    let extended = Extended { data: data.clone(), fitted: fitted.clone(), spread: inverse.transpose() };
    explore(Arc::new(extended), &names, settings, |_| ControlFlow::Continue(()))
}

/// `1 + J^T J` in coordinates without bounds, with the curvature of the coordinates near a bound.
fn curvature(fitted: &Fitted) -> DMatrix<f64> {
    let mut curvature = fitted.factor.matrix();
    let slope = fitted.jacobian.tr_mul(&fitted.residual) - &fitted.u;
    let free = fitted.units.coordinates.unbounded(&fitted.params);
    for (i, bound) in bounded(fitted, free.as_slice()).enumerate() {
        let sigma = fitted.units.sigma[i];
        curvature.row_mut(i).scale_mut(bound.slope);
        curvature.column_mut(i).scale_mut(bound.slope);
        let bend = sigma * sigma * bound.log_curvature - slope[i] * sigma * bound.bend;
        curvature[(i, i)] += bend.max(0.0);
    }
    curvature
}

/// The map of each var at its coordinate without bounds.
fn bounded<'f>(fitted: &'f Fitted, free: &'f [f64]) -> impl Iterator<Item = Bounded> + 'f {
    fitted.units.coordinates.each().iter().zip(free).map(|(one, free)| one.at(*free))
}

impl Extended {
    /// The vars' coordinates without bounds (`ln var`), and the other unknowns.
    fn at(&self, position: &[f64]) -> (DVector<f64>, DVector<f64>) {
        let (units, vars) = (&self.fitted.units, self.fitted.params.len());
        let step = &self.spread * DVector::from_column_slice(position);
        let free = units.coordinates.unbounded(&self.fitted.params) + units.step(&step);
        let others = self.fitted.u.rows(vars, step.len() - vars) + step.rows(vars, step.len() - vars);
        (free, others)
    }
}

impl Density for Extended {
    fn dimension(&self) -> usize {
        self.fitted.u.len()
    }

    fn evaluate(&self, position: &[f64]) -> Result<(f64, Vec<f64>), Unstable> {
        let units = &self.fitted.units;
        let (free, others) = self.at(position);
        let params = units.coordinates.params(free.as_slice());
        let u = DVector::from_iterator(self.dimension(), units.unknowns(&params).chain(others.iter().copied()));
        let (mut value, mut slope) = self.fitted.density_at(&self.data, &u).map_err(Unstable::new)?;
        for (i, bound) in bounded(&self.fitted, free.as_slice()).enumerate() {
            value += bound.slope.ln();
            slope[i] = slope[i] * bound.slope + units.sigma[i] * bound.log_slope_slope;
        }
        Ok((value, self.spread.tr_mul(&slope).as_slice().to_vec()))
    }

    fn ranges(&self) -> Vec<[f64; 2]> {
        self.data.units.ranges()
    }

    fn expand(&self, position: &[f64]) -> Vec<f64> {
        let (free, others) = self.at(position);
        let params = self.fitted.units.coordinates.params(free.as_slice());
        params.iter().map(|theta| theta.exp()).chain(others.iter().copied()).collect()
    }
}
