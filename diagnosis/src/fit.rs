//! The best vars and amplitudes of a hypothesis with the exact twin, and its evidence.
//!
//! In units of their prior standard deviations all unknowns `u` are standard normal, and the data whitened, so that
//!
//! `cost = |r(u)|^2 + |u|^2`, `ln evidence = -cost/2 - ln det(1 + J^T J)/2` (Laplace),
//!
//! minimised by damped Gauss-Newton within the range of the vars (what that takes from the integral: [`super::evidence`]). The
//! normalisation of the data is the same for all hypotheses but those that change their covariance, and is counted.

use estimator::MonitorState;
use nalgebra::{Cholesky, DMatrix, DVector, Dyn};
use twin::{Drives, EffectError, Machine, Signature, Signatures};

use super::data::Data;
use super::evidence::{Within, bounded, prior};
use super::hypothesis::{Hypothesis, Unknown};

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
    /// The same with the vars that are at a bound of their range held there.
    pub free: Cholesky<f64, Dyn>,
    /// `J^T r - u`, zero for the vars that are held.
    pub slope: DVector<f64>,
    /// The data whitened for this hypothesis, where it says that the baselines drift.
    drifting: Option<Box<Data>>,
}

/// Expected decrease of the cost at which the steps have settled.
const SETTLED: f64 = 0.01;
/// Chi-square per number beyond which a fit is far off.
const GROSS: f64 = 1.3;
const STEPS: usize = 25;
/// Steps after which a fit is given up whose cost is larger than a rival's by this factor.
const TRIAL: usize = 4;
const HOPELESS: f64 = 1.5;
const HALVINGS: usize = 6;
const SWEEPS: usize = 1000;
/// Step of an amplitude for its derivative, in prior standard deviations.
const DIFFERENCE: f64 = 0.02;

struct Point {
    u: DVector<f64>,
    residual: DVector<f64>,
    cost: f64,
}

impl Fitted {
    /// Fit, from a guess of the vars (and of the other unknowns, if it is as long).
    ///
    /// # Errors
    /// [`EffectError`] if there is no stable machine at the guess.
    pub fn of(data: &Data, hypothesis: &Hypothesis, guess: &DVector<f64>) -> Result<Self, EffectError> {
        Self::against(data, hypothesis, guess, f64::INFINITY)
    }

    /// The same, given up after a few steps if the cost stays far above that of a rival.
    ///
    /// # Errors
    /// [`EffectError`] if there is no stable machine at the guess.
    pub fn against(
        data: &Data,
        hypothesis: &Hypothesis,
        guess: &DVector<f64>,
        rival: f64,
    ) -> Result<Self, EffectError> {
        if let Some(given) = hypothesis.given.iter().find(|effect| effect.kind.moves_baselines()) {
            let drifting = data.drifting(given.amplitude.abs());
            let fitted = Self::minimise(&drifting, hypothesis, guess, rival)?;
            return Ok(Self { drifting: Some(Box::new(drifting)), ..fitted });
        }
        let fitted = Self::minimise(data, hypothesis, guess, rival)?;
        let Some(term) = hypothesis.terms.iter().position(|term| term.kind.moves_baselines()) else {
            return Ok(fitted);
        };
        // the drift of the baselines is as large as that of the quadrupoles
        let drifting = data.drifting(fitted.amplitude(data, term).0.abs());
        let fitted = Self::minimise(&drifting, hypothesis, &fitted.u, rival)?;
        Ok(Self { drifting: Some(Box::new(drifting)), ..fitted })
    }

    /// The hypothesis at the prior's mean, linearised and not fitted.
    ///
    /// # Errors
    /// [`EffectError`].
    pub fn unfitted(data: &Data, hypothesis: &Hypothesis) -> Result<Self, EffectError> {
        let unknowns = hypothesis.unknowns(data);
        let u = DVector::zeros(data.ring.quadrupoles.len() + unknowns.len());
        let here = point(data, hypothesis, u)?;
        let jacobian = differentiate(data, hypothesis, &unknowns, &here)?;
        Ok(Self::at(data, hypothesis, here, normal(&jacobian), jacobian))
    }

    /// The data as this fit whitens them.
    pub fn data<'d>(&'d self, data: &'d Data) -> &'d Data {
        self.drifting.as_deref().unwrap_or(data)
    }

    fn minimise(data: &Data, hypothesis: &Hypothesis, guess: &DVector<f64>, rival: f64) -> Result<Self, EffectError> {
        let vars = data.ring.quadrupoles.len();
        let unknowns = hypothesis.unknowns(data);
        let mut u = guess.clone().resize_vertically(vars + unknowns.len(), 0.0);
        u.rows_mut(0, vars).iter_mut().for_each(|u| *u = bounded(*u));
        let mut here = point(data, hypothesis, u)?;
        let mut jacobian = differentiate(data, hypothesis, &unknowns, &here)?;
        let mut factor = normal(&jacobian);
        for taken in 0..STEPS {
            if taken >= TRIAL && here.cost > HOPELESS * rival {
                break;
            }
            let slope = jacobian.tr_mul(&here.residual) - &here.u;
            let step = within(&here.u, &factor.solve(&slope), &slope, &jacobian, vars);
            let Some((next, expected)) = descend(data, hypothesis, &here, &step, &slope) else { break };
            here = next;
            if expected < SETTLED {
                break;
            }
            jacobian = differentiate(data, hypothesis, &unknowns, &here)?;
            factor = normal(&jacobian);
        }
        Ok(Self::at(data, hypothesis, here, factor, jacobian))
    }

    fn at(
        data: &Data,
        hypothesis: &Hypothesis,
        here: Point,
        factor: Cholesky<f64, Dyn>,
        jacobian: DMatrix<f64>,
    ) -> Self {
        let vars = data.ring.quadrupoles.len();
        let params = params_of(&here.u, vars);
        let slope = jacobian.tr_mul(&here.residual) - &here.u;
        let lower = factor.l();
        let Within { free, slope, log_det, log_inside } = Within::of(&lower * lower.transpose(), &here.u, slope, vars);
        let log_evidence = -0.5 * (here.cost + log_det + data.log_det()) + log_inside;
        let hypothesis = hypothesis.clone();
        let Point { u, residual, cost } = here;
        Self { hypothesis, params, cost, log_evidence, residual, jacobian, factor, free, slope, u, drifting: None }
    }

    /// `ln` posterior at another point, and its gradient.
    ///
    /// # Errors
    /// [`EffectError`] if there is no stable machine.
    pub fn density_at(&self, data: &Data, u: &DVector<f64>) -> Result<(f64, DVector<f64>), EffectError> {
        let data = self.data(data);
        let here = point(data, &self.hypothesis, u.clone())?;
        let jacobian = differentiate(data, &self.hypothesis, &self.hypothesis.unknowns(data), &here)?;
        Ok((-0.5 * here.cost, jacobian.tr_mul(&here.residual) - u))
    }

    /// True where the fit is so far off that its vars are bent out of shape.
    pub fn is_gross(&self) -> bool {
        self.residual.norm_squared() > GROSS * self.residual.len() as f64
    }

    /// `ln` posterior at the best point, up to a constant of the recording: evidence without the freedom of the unknowns.
    pub fn log_posterior(&self, data: &Data) -> f64 {
        -0.5 * (self.cost + self.data(data).log_det())
    }

    /// Amplitude and standard deviation of a term, the vars' range left out of the latter; (1, 0) without one.
    pub fn amplitude(&self, data: &Data, term: usize) -> (f64, f64) {
        self.unknown(data, term).map_or((1.0, 0.0), |(at, scale)| {
            let mut unit = DVector::zeros(self.u.len());
            unit[at] = 1.0;
            (self.u[at] * scale, self.factor.solve(&unit)[at].sqrt() * scale)
        })
    }

    /// Which of the unknowns is the amplitude of a term, and its prior standard deviation.
    pub fn unknown(&self, data: &Data, term: usize) -> Option<(usize, f64)> {
        let unknowns = self.hypothesis.unknowns(data);
        unknowns.iter().enumerate().find_map(|(i, unknown)| match unknown {
            Unknown::Amplitude(of, scale) if *of == term => Some((self.params.len() + i, *scale)),
            _ => None,
        })
    }

    /// The machine at the best point, and what drives it.
    ///
    /// # Errors
    /// [`EffectError`].
    pub fn machine(&self, data: &Data) -> Result<(Machine, Drives), EffectError> {
        self.hypothesis.machine(data, &self.params, &self.u.as_slice()[self.params.len()..])
    }

    /// Predictions at the best point, rows frames, columns monitors [m], then the two tunes [1].
    ///
    /// # Errors
    /// [`EffectError`].
    pub fn predicted(&self, data: &Data) -> Result<DMatrix<f64>, EffectError> {
        self.predicted_at(data, &self.u)
    }

    fn predicted_at(&self, data: &Data, u: &DVector<f64>) -> Result<DMatrix<f64>, EffectError> {
        let vars = self.params.len();
        let (machine, drives) = self.hypothesis.machine(data, &params_of(u, vars), &u.as_slice()[vars..])?;
        let (readings, tunes, tune_drift) = machine.readings(&drives)?;
        Ok(Signature { readings, tunes: [tunes.x, tunes.y], tune_drift }.by_frame(&drives.time))
    }

    /// Derivative of the predictions with respect to every u.
    ///
    /// # Errors
    /// [`EffectError`].
    pub fn slopes(&self, data: &Data) -> Result<Vec<DMatrix<f64>>, EffectError> {
        let vars = self.params.len();
        let (machine, drives) = self.machine(data)?;
        let signatures = Signatures::of(&machine, &drives)?;
        let by_frame = |signature: Signature, scale: f64| signature.by_frame(&drives.time) * scale;
        let of_vars = signatures.of_vars().into_iter().map(|signature| by_frame(signature, prior().1));
        let mut slopes: Vec<DMatrix<f64>> = of_vars.collect();
        for (i, unknown) in self.hypothesis.unknowns(data).iter().enumerate() {
            slopes.push(match unknown {
                Unknown::Member(term, width) => by_frame(signatures.of_effect(term.kind, term.site)?, *width),
                _ => {
                    let at = |step: f64| {
                        let mut u = self.u.clone();
                        u[vars + i] += step;
                        self.predicted_at(data, &u)
                    };
                    (at(DIFFERENCE)? - at(-DIFFERENCE)?) / (2.0 * DIFFERENCE)
                }
            });
        }
        Ok(slopes)
    }

    /// Sum of (residual/expected noise)^2 over the readings of monitors in state ok, baselines (and their drift) taken out, per degree
    /// of freedom (readings less baselines less vars).
    ///
    /// # Errors
    /// [`EffectError`].
    pub fn chi2_per_dof(&self, data: &Data) -> Result<f64, EffectError> {
        let data = self.data(data);
        let miss = data.miss(&self.predicted(data)?);
        let (mut sum, mut freedom) = (0.0, -(self.params.len() as f64));
        for b in data.speaking_monitors().into_iter().filter(|&b| data.health()[b].state == MonitorState::Ok) {
            let own = data.about_baseline(b, &miss.column(b).into_owned());
            sum += own.norm_squared();
            freedom += own.len() as f64 - 1.0;
        }
        Ok(sum / data.expected_noise.powi(2) / freedom)
    }

    /// Covariance of `ln` of the vars.
    pub fn covariance(&self) -> DMatrix<f64> {
        let (vars, (_, sigma)) = (self.params.len(), prior());
        self.factor.inverse().view((0, 0), (vars, vars)) * (sigma * sigma)
    }
}

/// `ln` vars of the first unknowns.
fn params_of(u: &DVector<f64>, vars: usize) -> Vec<f64> {
    let (mean, sigma) = prior();
    u.rows(0, vars).iter().map(|u| mean + sigma * u).collect()
}

/// The best step within the range: the full one if it stays there, else by projected Gauss-Seidel sweeps.
fn within(
    u: &DVector<f64>,
    full: &DVector<f64>,
    slope: &DVector<f64>,
    jacobian: &DMatrix<f64>,
    vars: usize,
) -> DVector<f64> {
    let clamp = |i: usize, step: f64| if i < vars { bounded(u[i] + step) - u[i] } else { step };
    let mut step = DVector::from_fn(u.len(), |i, _| clamp(i, full[i]));
    if step == *full {
        return step;
    }
    let mut matrix = jacobian.transpose() * jacobian;
    (0..matrix.ncols()).for_each(|i| matrix[(i, i)] += 1.0);
    for _ in 0..SWEEPS {
        let mut moved = 0.0_f64;
        for i in 0..step.len() {
            let pull = slope[i] - matrix.column(i).dot(&step);
            let next = clamp(i, step[i] + pull / matrix[(i, i)]);
            moved = moved.max((next - step[i]).abs());
            step[i] = next;
        }
        if moved < 1e-6 {
            break;
        }
    }
    step
}

fn normal(jacobian: &DMatrix<f64>) -> Cholesky<f64, Dyn> {
    let mut matrix = jacobian.transpose() * jacobian;
    (0..matrix.ncols()).for_each(|i| matrix[(i, i)] += 1.0);
    matrix.cholesky().expect("1 + J^T J is positive")
}

fn point(data: &Data, hypothesis: &Hypothesis, u: DVector<f64>) -> Result<Point, EffectError> {
    let vars = data.ring.quadrupoles.len();
    let (machine, drives) = hypothesis.machine(data, &params_of(&u, vars), &u.as_slice()[vars..])?;
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
    step: &DVector<f64>,
    slope: &DVector<f64>,
) -> Option<(Point, f64)> {
    let mut share = 1.0;
    for _ in 0..HALVINGS {
        let u = &here.u + step * share;
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
    let (_, sigma) = prior();
    let (machine, drives) = hypothesis.machine(data, &params_of(&here.u, vars), &here.u.as_slice()[vars..])?;
    let signatures = Signatures::of(&machine, &drives)?;
    let mut jacobian = DMatrix::zeros(data.size(), vars + unknowns.len());
    for (q, signature) in signatures.of_vars().iter().enumerate() {
        jacobian.set_column(q, &(data.signature(signature) * sigma));
    }
    for (i, unknown) in unknowns.iter().enumerate() {
        let column = match unknown {
            Unknown::Member(term, width) => data.signature(&signatures.of_effect(term.kind, term.site)?) * *width,
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
