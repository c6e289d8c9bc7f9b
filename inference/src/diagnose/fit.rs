//! The best vars and amplitudes of a hypothesis with the exact twin, and its evidence.
//!
//! In units of their prior standard deviations all unknowns `u` are standard normal, and the data whitened, so that
//!
//! `cost = |r(u)|^2 + |u|^2`, `ln evidence = -cost/2 - ln det(1 + J^T J)/2` (Laplace),
//!
//! minimised by damped Gauss-Newton. The normalisation of the data is the same for all hypotheses but those that change their
//! covariance, and is counted.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};
use twin::{EffectError, EffectKind, Signatures};

use super::data::Data;
use super::hypothesis::{Hypothesis, Unknown};
use crate::posterior::RANGE;
use crate::stream::PRIOR_WIDTH;

/// A hypothesis at its best.
#[derive(Debug, Clone)]
pub struct Fitted {
    /// What is fitted.
    pub hypothesis: Hypothesis,
    /// Vars and other unknowns, in units of their prior standard deviations.
    pub u: DVector<f64>,
    /// `ln` of each var at the best point.
    pub params: Vec<f64>,
    /// `|r|^2 + |u|^2`.
    pub cost: f64,
    /// `ln` evidence, up to a constant of the recording.
    pub log_evidence: f64,
    /// Whitened residuals.
    pub residual: DVector<f64>,
    /// Their derivative, negative, with respect to u.
    pub jacobian: DMatrix<f64>,
    /// Factor of `1 + J^T J`, the inverse of the covariance of u.
    pub factor: Cholesky<f64, Dyn>,
    /// Standard deviation of the readings' common drift that whitened the data: that of the hypothesis's own amplitude.
    pub drift: f64,
}

/// Expected decrease of the cost at which the steps have settled.
const SETTLED: f64 = 0.01;
const STEPS: usize = 25;
const HALVINGS: usize = 6;
/// Step of an amplitude for its derivative, in prior standard deviations.
const DIFFERENCE: f64 = 0.02;

/// `(mean, sigma)` of `ln var`.
pub fn prior() -> (f64, f64) {
    let variance = f64::from(PRIOR_WIDTH).powi(2).ln_1p();
    (-0.5 * variance, variance.sqrt())
}

struct Point {
    u: DVector<f64>,
    residual: DVector<f64>,
    cost: f64,
}

impl Fitted {
    /// Fit, from a guess of the vars (and of the amplitudes, if it is as long).
    ///
    /// # Errors
    /// [`EffectError`] if there is no stable machine at the guess.
    pub fn of(data: &Data, hypothesis: &Hypothesis, guess: &DVector<f64>) -> Result<Self, EffectError> {
        let vars = data.ring.quadrupoles.len();
        let unknowns = hypothesis.unknowns(data);
        let mut u = guess.clone().resize_vertically(vars + unknowns.len(), 0.0);
        // a kick from zero, where some derivatives vanish
        u.rows_mut(0, vars).iter_mut().for_each(|u| *u = bounded(*u));
        let mut here = point(data, hypothesis, u)?;
        let mut jacobian = differentiate(data, hypothesis, &unknowns, &here)?;
        for _ in 0..STEPS {
            let factor = normal(&jacobian);
            let slope = jacobian.tr_mul(&here.residual) - &here.u;
            let full = factor.solve(&slope);
            let Some((next, expected)) = descend(data, hypothesis, &here, &full, &slope, vars) else { break };
            here = next;
            jacobian = differentiate(data, hypothesis, &unknowns, &here)?;
            if expected < SETTLED {
                break;
            }
        }
        let factor = normal(&jacobian);
        let (mean, sigma) = prior();
        let params = here.u.rows(0, vars).iter().map(|u| mean + sigma * u).collect();
        let log_det: f64 = 2.0 * factor.l_dirty().diagonal().iter().map(|d| d.ln()).sum::<f64>();
        let log_evidence = -0.5 * (here.cost + log_det + data.log_det());
        Ok(Self {
            hypothesis: hypothesis.clone(),
            params,
            cost: here.cost,
            log_evidence,
            residual: here.residual,
            jacobian,
            factor,
            u: here.u,
            drift: 0.0,
        })
    }

    /// Amplitude and standard deviation of a term; (1, 0) without one.
    pub fn amplitude(&self, data: &Data, term: usize) -> (f64, f64) {
        let vars = self.params.len();
        let unknowns = self.hypothesis.unknowns(data);
        let found = unknowns.iter().enumerate().find_map(|(i, unknown)| match unknown {
            Unknown::Amplitude(of, scale) if *of == term => Some((vars + i, *scale)),
            _ => None,
        });
        found.map_or((1.0, 0.0), |(at, scale)| {
            let mut unit = DVector::zeros(self.u.len());
            unit[at] = 1.0;
            (self.u[at] * scale, self.factor.solve(&unit)[at].sqrt() * scale)
        })
    }

    /// Covariance of `ln` of the vars.
    pub fn covariance(&self) -> DMatrix<f64> {
        let (vars, (_, sigma)) = (self.params.len(), prior());
        self.factor.inverse().view((0, 0), (vars, vars)) * (sigma * sigma)
    }
}

fn bounded(u: f64) -> f64 {
    let (mean, sigma) = prior();
    u.clamp((RANGE[0].ln() - mean) / sigma, (RANGE[1].ln() - mean) / sigma)
}

fn normal(jacobian: &DMatrix<f64>) -> Cholesky<f64, Dyn> {
    let mut matrix = jacobian.transpose() * jacobian;
    (0..matrix.ncols()).for_each(|i| matrix[(i, i)] += 1.0);
    matrix.cholesky().expect("1 + J^T J is positive")
}

fn point(data: &Data, hypothesis: &Hypothesis, u: DVector<f64>) -> Result<Point, EffectError> {
    let vars = data.ring.quadrupoles.len();
    let (mean, sigma) = prior();
    let params: Vec<f64> = u.rows(0, vars).iter().map(|u| mean + sigma * u).collect();
    let (machine, drives) = hypothesis.machine(data, &params, &u.as_slice()[vars..])?;
    let (readings, tunes, tune_drift) = machine.readings(&drives)?;
    let residual = data.residual(&readings, tunes, tune_drift);
    let cost = residual.norm_squared() + u.norm_squared();
    Ok(Point { u, residual, cost })
}

/// Half the way as long as the full step leads uphill or to an unstable ring; returns the decrease that was expected too.
fn descend(
    data: &Data,
    hypothesis: &Hypothesis,
    here: &Point,
    full: &DVector<f64>,
    slope: &DVector<f64>,
    vars: usize,
) -> Option<(Point, f64)> {
    let mut share = 1.0;
    for _ in 0..HALVINGS {
        let mut u = &here.u + full * share;
        u.rows_mut(0, vars).iter_mut().for_each(|u| *u = bounded(*u));
        let expected = (&u - &here.u).dot(slope);
        if let Ok(next) = point(data, hypothesis, u)
            && next.cost <= here.cost
        {
            return Some((next, expected));
        }
        share *= 0.5;
    }
    None
}

/// Derivative of the predicted numbers with respect to u.
fn differentiate(
    data: &Data,
    hypothesis: &Hypothesis,
    unknowns: &[Unknown],
    here: &Point,
) -> Result<DMatrix<f64>, EffectError> {
    let vars = data.ring.quadrupoles.len();
    let (mean, sigma) = prior();
    let params: Vec<f64> = here.u.rows(0, vars).iter().map(|u| mean + sigma * u).collect();
    let (machine, drives) = hypothesis.machine(data, &params, &here.u.as_slice()[vars..])?;
    let signatures = Signatures::of(&machine, &drives)?;
    let mut jacobian = DMatrix::zeros(data.len(), vars + unknowns.len());
    for (q, signature) in signatures.of_vars().iter().enumerate() {
        jacobian.set_column(q, &(data.signature(signature) * sigma));
    }
    for (i, unknown) in unknowns.iter().enumerate() {
        let column = match unknown {
            Unknown::Member(term, width) => {
                data.signature(&signatures.of_effect(term.kind, &term.place)?) * *width
            }
            _ => {
                let at = |step: f64| {
                    let mut u = here.u.clone();
                    u[vars + i] += step;
                    point(data, hypothesis, u)
                };
                (at(-DIFFERENCE)?.residual - at(DIFFERENCE)?.residual) / (2.0 * DIFFERENCE)
            }
        };
        jacobian.set_column(vars + i, &column);
    }
    Ok(jacobian)
}

/// True for an effect that also moves the baselines in time.
pub fn moves_baselines(kind: EffectKind) -> bool {
    kind == EffectKind::QuadDrift
}
