//! The posterior of vars and amplitudes of a hypothesis, for NUTS: what the Gaussian of [`super::fit`] is checked by.
//!
//! In units of prior standard deviations, `-cost/2` is the log-density of u. The vars have coordinates w without bounds (see
//! [`inference::posterior`]), and all of them those of the Gaussian: `w = best + L^-T z`, `L L^T` the curvature in w.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};

use super::data::Data;
use super::evidence::prior;
use super::fit::Fitted;
use inference::nuts::{Density, NutsError, NutsRun, NutsSettings, Unstable, explore};
use inference::posterior::{Bounded, params_of, unbounded_of};

/// A fitted hypothesis, its density sampled.
struct Extended {
    data: Data,
    fitted: Fitted,
    /// `L^-T`.
    spread: DMatrix<f64>,
}

/// Sample vars and amplitudes about a fit; what is kept are the vars and all other unknowns, in the order of the fit, the latter
/// in prior standard deviations.
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
    explore(Arc::new(extended), &names, settings, |_| ())
}

/// `1 + J^T J` in coordinates without bounds, and what the bounds bend.
fn curvature(fitted: &Fitted) -> DMatrix<f64> {
    let sigma = prior().1;
    let lower = fitted.factor.l();
    let mut curvature = &lower * lower.transpose();
    let slope = fitted.jacobian.tr_mul(&fitted.residual) - &fitted.u;
    for (i, free) in unbounded_of(&fitted.params).iter().enumerate() {
        let bound = Bounded::at(*free);
        curvature.row_mut(i).scale_mut(bound.slope);
        curvature.column_mut(i).scale_mut(bound.slope);
        let bend = sigma * sigma * bound.log_curvature - slope[i] * sigma * bound.bend;
        curvature[(i, i)] += bend.max(0.0);
    }
    curvature
}

impl Extended {
    /// The vars' coordinates without bounds (`ln var`), and the other unknowns.
    fn at(&self, position: &[f64]) -> (DVector<f64>, DVector<f64>) {
        let (vars, (_, sigma)) = (self.fitted.params.len(), prior());
        let step = &self.spread * DVector::from_column_slice(position);
        let free = unbounded_of(&self.fitted.params) + step.rows(0, vars) * sigma;
        let others = self.fitted.u.rows(vars, step.len() - vars) + step.rows(vars, step.len() - vars);
        (free, others)
    }
}

impl Density for Extended {
    fn dimension(&self) -> usize {
        self.fitted.u.len()
    }

    fn evaluate(&self, position: &[f64]) -> Result<(f64, Vec<f64>), Unstable> {
        let (mean, sigma) = prior();
        let (free, others) = self.at(position);
        let params = params_of(free.as_slice());
        let u = params.iter().map(|theta| (theta - mean) / sigma).chain(others.iter().copied());
        let u = DVector::from_iterator(self.dimension(), u);
        let (mut value, mut slope) = self.fitted.density_at(&self.data, &u).map_err(Unstable::new)?;
        for (slope, free) in slope.iter_mut().zip(free.iter()) {
            let bound = Bounded::at(*free);
            value += bound.slope.ln();
            *slope = *slope * bound.slope + sigma * bound.log_slope_slope;
        }
        Ok((value, self.spread.tr_mul(&slope).as_slice().to_vec()))
    }

    fn vars(&self) -> usize {
        self.fitted.params.len()
    }

    fn expand(&self, position: &[f64]) -> Vec<f64> {
        let (free, others) = self.at(position);
        params_of(free.as_slice()).iter().map(|theta| theta.exp()).chain(others.iter().copied()).collect()
    }
}
