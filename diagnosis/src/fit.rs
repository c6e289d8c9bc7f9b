//! The fit of a hypothesis: its best vars and amplitudes with the exact twin, and its evidence.
//!
//! In units of their prior standard deviations all unknowns `u` are standard normal, and the data whitened, so that
//!
//! `cost = |r(u)|^2 + |u|^2`, `ln evidence = -cost/2 - ln det(1 + J^T J)/2` (Laplace),
//!
//! minimised by damped Gauss-Newton within the range of the vars (which cuts the integral: [`super::units`]). The normalisation of
//! the data is included, since hypotheses with drifting baselines change their covariance. The ordinary imperfections, many and
//! small, are taken to first order about the start of the fit (gains no lower than -0.5), but for those that change the focusing.

use nalgebra::{DMatrix, DVector};
use twin::{Drives, EffectError, EffectKind, Machine, Measured, OrbitError, Signature, Signatures};

use super::columns::beside;
use super::data::Data;
use super::element::Form;
use super::family::Family;
use super::hypothesis::Hypothesis;
use super::term::Term;
use super::units::{BoundedGaussian, Units};
use super::unknown::{Quantity, Unknown};
use evidence::{Factor, gram};
use inference::{Limits, Objective, OptimiseError, Quadratic, minimise};

/// A hypothesis at its best.
#[derive(Debug, Clone)]
pub struct Fitted {
    /// The hypothesis that is fitted.
    pub hypothesis: Hypothesis,
    /// Vars and other unknowns, in units of their prior standard deviations.
    pub u: DVector<f64>,
    /// The vars in these units.
    pub units: Units,
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
    pub factor: Factor,
    /// The same with the vars that are at a bound of their range held there.
    pub free: Factor,
    /// `J^T r - u`, zero for the vars that are held.
    pub slope: DVector<f64>,
    /// The data as this fit has them, where they are its own: whitened for baselines that drift, or linearised about its machine.
    pub(super) own: Option<Box<Data>>,
}

/// Why a hypothesis has no fit.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FitError {
    /// No stable machine where the fit begins, or an effect that is not defined for this ring.
    #[error(transparent)]
    Effect(#[from] EffectError),
    /// A derivative is so large, or not a number, that the normal matrix is not positive.
    #[error("the normal matrix of a fit is not positive")]
    Degenerate,
}

impl From<OrbitError> for FitError {
    fn from(error: OrbitError) -> Self {
        Self::Effect(error.into())
    }
}

const LIMITS: Limits = Limits { settled: 0.01, steps: 25, halvings: 6 };
/// Chi-square per number above which a fit is poor.
const POOR: f64 = 1.3;
/// Number of steps after which a fit is abandoned if its cost exceeds a rival's by a factor, and that factor.
const TRIAL: usize = 4;
const HOPELESS: f64 = 1.5;
/// Step of an amplitude for its derivative, in prior standard deviations.
const DIFFERENCE: f64 = 0.02;

/// A hypothesis and the data that it is fitted to.
struct Problem<'d> {
    data: &'d Data,
    hypothesis: &'d Hypothesis,
    unknowns: Vec<Unknown>,
    /// The ordinary imperfections of first order at the start, the last unknowns of the fit.
    start: DVector<f64>,
    ordinary: Ordinary,
}

/// Ordinary imperfections to first order about a machine.
struct Ordinary {
    /// Derivative `Z` of the whitened predictions with respect to each.
    slopes: DMatrix<f64>,
    /// `Z^T Z`.
    gram: DMatrix<f64>,
}

impl Fitted {
    /// Fit, from a guess of the vars (and of the other unknowns, if it is as long).
    ///
    /// # Errors
    /// [`FitError`].
    pub fn from_guess(data: &Data, hypothesis: &Hypothesis, guess: &DVector<f64>) -> Result<Self, FitError> {
        Self::against(data, hypothesis, guess, f64::INFINITY)
    }

    /// The same, abandoned after a few steps if the cost stays far above that of a rival.
    ///
    /// # Errors
    /// [`FitError`].
    pub fn against(data: &Data, hypothesis: &Hypothesis, guess: &DVector<f64>, rival: f64) -> Result<Self, FitError> {
        if let Some(given) = hypothesis.given.iter().find(|effect| effect.kind.moves_baselines()) {
            let drifting = data.drifting(given.amplitude.abs());
            let fitted = Self::minimise(&drifting, hypothesis, guess, rival)?;
            return Ok(Self { own: Some(Box::new(drifting)), ..fitted });
        }
        let fitted = Self::minimise(data, hypothesis, guess, rival)?;
        let Some(term) = hypothesis.terms.iter().position(|term| term.kind.moves_baselines()) else {
            return Ok(fitted);
        };
        // the drift of the baselines is as large as that of the quadrupoles
        let drifting = data.drifting(fitted.amplitude(data, term).0.abs());
        let fitted = Self::minimise(&drifting, hypothesis, &fitted.u, rival)?;
        Ok(Self { own: Some(Box::new(drifting)), ..fitted })
    }

    /// The hypothesis at the prior's mean, linearised and not fitted.
    pub(crate) fn unfitted(data: &Data, hypothesis: &Hypothesis) -> Result<Self, FitError> {
        let u = DVector::zeros(data.units.len() + hypothesis.unknowns(data).len());
        let problem = Problem::new(data, hypothesis, &u)?;
        let (cost, residual) = problem.evaluate(&u)?;
        let (quadratic, slopes) = problem.linearise(&u, &residual)?;
        let factor = quadratic.factor().ok_or(FitError::Degenerate)?;
        Self::from_point(&problem, u, residual, cost, factor, slopes)
    }

    /// The data as this fit has them.
    pub fn data<'d>(&'d self, data: &'d Data) -> &'d Data {
        self.own.as_deref().unwrap_or(data)
    }

    /// This fit, which was to some data, and is kept beside others; if it has data of its own, it keeps these.
    #[must_use]
    pub(super) fn keeping(self, data: &Data) -> Self {
        Self { own: self.own.or_else(|| Some(Box::new(data.clone()))), ..self }
    }

    fn minimise(data: &Data, hypothesis: &Hypothesis, guess: &DVector<f64>, rival: f64) -> Result<Self, FitError> {
        let size = data.units.len() + hypothesis.unknowns(data).len();
        let start = guess.clone().resize_vertically(size, 0.0);
        let problem = Problem::new(data, hypothesis, &start)?;
        let hopeful = |steps, cost| steps < TRIAL || cost <= HOPELESS * rival;
        let found = minimise(&problem, &start, &hypothesis.units(data).bounds(size), &LIMITS, hopeful);
        let found = found.map_err(|error| match error {
            OptimiseError::Start(error) => FitError::Effect(error),
            OptimiseError::Degenerate => FitError::Degenerate,
        })?;
        let factor = found.quadratic.factor().ok_or(FitError::Degenerate)?;
        Self::from_point(&problem, found.x, found.point, found.cost, factor, found.slopes)
    }

    fn from_point(
        problem: &Problem,
        u: DVector<f64>,
        residual: DVector<f64>,
        cost: f64,
        factor: Factor,
        slopes: DMatrix<f64>,
    ) -> Result<Self, FitError> {
        let (data, units) = (problem.data, problem.hypothesis.units(problem.data));
        let jacobian = beside(slopes, &problem.ordinary.slopes);
        let params = units.params(&u);
        let slope = jacobian.tr_mul(&residual) - &u;
        let within = BoundedGaussian::from_precision(&factor, &u, slope, &units);
        let BoundedGaussian { free, slope, log_det, log_inside } = within.ok_or(FitError::Degenerate)?;
        let log_prior = problem.hypothesis.log_prior();
        let log_evidence = -0.5 * (cost + log_det + data.whole_log_det()) + log_inside + log_prior;
        let hypothesis = problem.hypothesis.clone();
        Ok(Self {
            hypothesis,
            units,
            params,
            cost,
            log_evidence,
            residual,
            jacobian,
            factor,
            free,
            slope,
            u,
            own: None,
        })
    }

    /// `ln` posterior at another point, and its gradient.
    ///
    /// # Errors
    /// [`EffectError`] if there is no stable machine.
    pub fn density_at(&self, data: &Data, u: &DVector<f64>) -> Result<(f64, DVector<f64>), EffectError> {
        let problem = Problem::new(self.data(data), &self.hypothesis, u)?;
        let residual = problem.residual(u)?;
        let slope = beside(problem.jacobian(u)?, &problem.ordinary.slopes).tr_mul(&residual) - u;
        Ok((-0.5 * (residual.norm_squared() + u.norm_squared()), slope))
    }

    /// True where the fit is so poor that its vars are strongly biased.
    pub fn is_poor(&self) -> bool {
        self.chi2_per_number() > POOR
    }

    /// Mean square of the whitened residuals.
    pub fn chi2_per_number(&self) -> f64 {
        self.residual.norm_squared() / self.residual.len() as f64
    }

    /// `ln` posterior at the best point, up to a constant of the recording: the evidence without its determinant.
    pub fn log_posterior(&self, data: &Data) -> f64 {
        -0.5 * (self.cost + self.data(data).whole_log_det())
    }

    /// Amplitude and standard deviation of a term, the latter without the vars' range; (1, 0) for a switch, which has no amplitude.
    pub fn amplitude(&self, data: &Data, term: usize) -> (f64, f64) {
        self.unknown(data, term).map_or((1.0, 0.0), |(at, scale)| self.sized(at, scale))
    }

    /// An unknown and its standard deviation, by its prior one.
    fn sized(&self, at: usize, scale: f64) -> (f64, f64) {
        let mut unit = DVector::zeros(self.u.len());
        unit[at] = 1.0;
        (self.u[at] * scale, self.factor.solve(&unit)[at].sqrt() * scale)
    }

    /// Angle by which its unknown element turns the planes [rad], if that is what it does.
    pub(crate) fn turned(&self, data: &Data) -> Option<Measured> {
        let (at, scale) = self.find(data, |unknown| matches!(unknown.quantity, Quantity::Form(_, Form::Rotation)))?;
        let (value, sigma) = self.sized(at, scale);
        Some(Measured { value, sigma })
    }

    /// Index of the amplitude of a term among the unknowns, and its prior standard deviation.
    pub fn unknown(&self, data: &Data, term: usize) -> Option<(usize, f64)> {
        let amplitude = Quantity::Amplitude(self.hypothesis.terms[term]);
        self.find(data, |unknown| unknown.quantity == amplitude)
    }

    /// Index of an unknown, the first of a sort, and its prior standard deviation.
    fn find(&self, data: &Data, is_of_sort: impl Fn(&Unknown) -> bool) -> Option<(usize, f64)> {
        let unknowns = self.hypothesis.unknowns(data);
        let at = unknowns.iter().position(is_of_sort)?;
        Some((self.params.len() + at, unknowns[at].sigma))
    }

    /// The best point as the start of a fit of another hypothesis: unknowns that both have keep their values.
    pub fn guess(&self, data: &Data, other: &Hypothesis) -> DVector<f64> {
        let unknowns = self.hypothesis.unknowns(data);
        let value = |unknown: &Unknown| {
            let at = unknowns.iter().position(|one| one.quantity == unknown.quantity)?;
            Some(self.u[self.params.len() + at] * unknowns[at].sigma / unknown.sigma)
        };
        let others = other.unknowns(data);
        let units = other.units(data);
        let all = units.unknowns(&self.params);
        DVector::from_vec(all.chain(others.iter().map(|unknown| value(unknown).unwrap_or(0.0))).collect())
    }

    /// The machine at the best point in one of the recordings, and its drives.
    ///
    /// # Errors
    /// [`EffectError`].
    pub fn machine(&self, data: &Data, campaign: usize) -> Result<(Machine, Drives), EffectError> {
        self.hypothesis.machine(data, campaign, &self.params, &self.u.as_slice()[self.params.len()..])
    }

    /// The same on its orbit.
    ///
    /// # Errors
    /// [`EffectError`].
    pub fn machine_on_orbit(&self, data: &Data, campaign: usize) -> Result<(Machine, Drives), EffectError> {
        let (machine, drives) = self.machine(data, campaign)?;
        Ok((machine.on_orbit(&drives.orbit), drives))
    }

    /// That in each recording.
    pub(crate) fn machines_on_orbit(&self, data: &Data) -> Result<Vec<(Machine, Drives)>, EffectError> {
        (0..data.count()).map(|campaign| self.machine_on_orbit(data, campaign)).collect()
    }

    /// Change of the tunes by the unknown element, which is not in the machine; 0 without one.
    ///
    /// # Errors
    /// [`EffectError`].
    pub fn tunes_of_element(&self, data: &Data) -> Result<[f64; 2], EffectError> {
        let (machine, drives) = self.machine(data, 0)?;
        let prediction = of_element(self.data(data), &self.hypothesis, 0, (&machine, &drives), &self.u)?;
        Ok(prediction.map_or([0.0; 2], |prediction| prediction.tunes))
    }

    /// True if the exact machine at the best point keeps a beam, its ordinary imperfections not only to first order.
    pub(crate) fn is_stable(&self, data: &Data) -> bool {
        let keeps = |campaign: usize| {
            self.machine(data, campaign).is_ok_and(|(machine, drives)| machine.readings(&drives).is_ok())
        };
        (0..data.count()).all(keeps)
    }

    /// Predictions at the best point for one of the recordings, rows pools, columns monitors [m], then the two tunes [1].
    ///
    /// # Errors
    /// [`EffectError`].
    pub fn predicted(&self, data: &Data, campaign: usize) -> Result<DMatrix<f64>, EffectError> {
        Ok(predicted_by(data, &self.hypothesis, campaign, &self.u)?.by_frame())
    }

    /// Whitened residuals of some data at the best point of this fit, which may be of others.
    ///
    /// # Errors
    /// [`EffectError`].
    pub fn residual_of(&self, data: &Data) -> Result<DVector<f64>, EffectError> {
        data.stacked(|campaign, own| Ok(own.residual(&predicted_by(data, &self.hypothesis, campaign, &self.u)?)))
    }

    /// Its cost for other readings; infinite where its machine keeps no beam in them.
    pub(crate) fn cost_of(&self, data: &Data) -> f64 {
        self.residual_of(data).map_or(f64::INFINITY, |residual| residual.norm_squared() + self.u.norm_squared())
    }

    /// Sum of (residual/noise)^2 over the readings of monitors in state ok, about baselines that follow supplies and RF (and drift), per
    /// degree of freedom, as [`inference::BatchFit::chi2_per_dof`] counts it, but by the noise as learnt.
    ///
    /// # Errors
    /// [`EffectError`].
    pub fn chi2_per_dof(&self, data: &Data) -> Result<f64, EffectError> {
        let data = self.data(data);
        let (mut sum, mut degrees) = (0.0, 0.0);
        for (campaign, own) in data.campaigns().enumerate() {
            let (chi2, freedom) = own.chi_square(&self.predicted(data, campaign)?);
            (sum, degrees) = (sum + chi2, degrees + freedom);
        }
        Ok(sum / (degrees - self.params.len() as f64))
    }

    /// Step of `ln` of the vars, and its covariance, were the same unknowns as wide as those of another hypothesis and some families in the model
    /// besides: to first order. With `D` the ratios of the widths, `X` what the families do per width and `J' = (J D, X)`:
    /// `u' = (1 + J'^T J')^-1 J'^T (r + J u)`.
    pub(crate) fn widened(
        &self,
        data: &Data,
        other: &Hypothesis,
        more: &[Family],
    ) -> Result<(DVector<f64>, DMatrix<f64>), FitError> {
        let data = self.data(data);
        let (own, others) = (self.hypothesis.unknowns(data), other.unknowns(data));
        let ratios = own.iter().zip(&others).map(|(own, other)| other.sigma / own.sigma);
        let wider = DVector::from_iterator(self.u.len(), core::iter::repeat_n(1.0, self.params.len()).chain(ratios));
        let besides: Vec<Unknown> = more.iter().flat_map(|family| family.unknowns(data)).collect();
        let machine = |campaign: usize| machine_at(data, &self.hypothesis, campaign, &self.u);
        let none = DVector::zeros(besides.len());
        let mut all = beside(self.jacobian.clone(), &Ordinary::about(data, &besides, &none, machine)?.slopes);
        all.column_iter_mut().zip(&wider).for_each(|(mut column, wider)| column *= *wider);
        let left = &self.residual + &self.jacobian * &self.u;
        let identity = DMatrix::identity(all.ncols(), all.ncols());
        let factor = Factor::of(gram(&all) + identity).ok_or(FitError::Degenerate)?;
        let step = factor.solve(&all.tr_mul(&left)).rows(0, self.u.len()) - &self.u;
        Ok((self.units.step(&step), self.units.covariance(&factor.inverse())))
    }

    /// Covariance of `ln` of the vars.
    pub fn covariance(&self) -> DMatrix<f64> {
        self.units.covariance(&self.factor.inverse())
    }
}

impl<'d> Problem<'d> {
    /// With the imperfections of first order linearised about a start.
    fn new(data: &'d Data, hypothesis: &'d Hypothesis, start: &DVector<f64>) -> Result<Self, EffectError> {
        let unknowns = hypothesis.unknowns(data);
        let others = unknowns.iter().filter(|unknown| !unknown.is_of_first_order()).count();
        debug_assert!(unknowns[others..].iter().all(Unknown::is_of_first_order), "they are the last");
        let first = data.units.len() + others;
        let mut start = start.clone();
        for (unknown, u) in unknowns.iter().zip(start.iter_mut().skip(data.units.len())) {
            *u = u.max(unknown.least_start());
        }
        let machine = |campaign: usize| machine_at(data, hypothesis, campaign, &start);
        let of_ordinary = start.rows_range(first..).into_owned();
        let ordinary = Ordinary::about(data, &unknowns[others..], &of_ordinary, machine)?;
        Ok(Self { data, hypothesis, start: of_ordinary, unknowns, ordinary })
    }

    /// Number of the other unknowns, the first.
    fn others(&self) -> usize {
        self.data.units.len() + self.unknowns.len() - self.start.len()
    }

    /// The same point with those of first order at their start: the machine about which they are.
    fn held(&self, u: &DVector<f64>) -> DVector<f64> {
        let mut held = u.clone();
        held.rows_range_mut(self.others()..).copy_from(&self.start);
        held
    }

    /// Whitened residuals.
    fn residual(&self, u: &DVector<f64>) -> Result<DVector<f64>, EffectError> {
        let held = self.held(u);
        let moved = u.rows_range(self.others()..) - &self.start;
        let left = self.data.stacked(|campaign, own| {
            Ok::<_, EffectError>(own.residual(&predicted_by(self.data, self.hypothesis, campaign, &held)?))
        })?;
        Ok(left - &self.ordinary.slopes * moved)
    }

    /// Derivative of the predicted numbers with respect to the others.
    fn jacobian(&self, u: &DVector<f64>) -> Result<DMatrix<f64>, EffectError> {
        let (data, vars) = (self.data, self.data.units.len());
        let held = self.held(u);
        let sigma = self.hypothesis.units(data).sigma;
        let mut jacobian = data.stacked_columns(self.others(), |campaign, own, into| {
            let (machine, drives) = machine_at(data, self.hypothesis, campaign, &held)?;
            let machine = machine.on_orbit(&drives.orbit);
            let ends = machine.ends();
            let signatures = Signatures::of(&machine, &drives)?.between(ends.as_ref())?;
            let of_vars = signatures.of_vars().into_iter().zip(&sigma);
            let of_vars = of_vars.map(|(signature, sigma)| Ok(Some(signature * *sigma)));
            let of_others = self.unknowns[..self.others() - vars].iter();
            let of_others = of_others.zip(u.iter().skip(vars));
            let of_others = of_others.map(|(unknown, u)| of_linear(data, campaign, &signatures, unknown, *u));
            own.signatures(into, of_vars.chain(of_others))
        })?;
        let is_exact =
            |i: &usize| matches!(self.unknowns[i - vars].quantity, Quantity::Amplitude(_) | Quantity::Orbit(..));
        for i in (vars..self.others()).filter(is_exact) {
            let at = |step: f64| {
                let mut u = u.clone();
                u[i] += step;
                self.residual(&u)
            };
            // of the predictions, not of what they leave
            jacobian.set_column(i, &-difference(at)?);
        }
        Ok(jacobian)
    }
}

impl Ordinary {
    fn about(
        data: &Data,
        unknowns: &[Unknown],
        start: &DVector<f64>,
        machine: impl Fn(usize) -> Result<(Machine, Drives), EffectError>,
    ) -> Result<Self, EffectError> {
        let slopes = data.stacked_columns(unknowns.len(), |campaign, own, into| {
            let (machine, drives) = machine(campaign)?;
            let machine = machine.on_orbit(&drives.orbit);
            let ends = machine.ends();
            let signatures = Signatures::of(&machine, &drives)?.between(ends.as_ref())?;
            let prediction = |(unknown, u): (&Unknown, &f64)| of_linear(data, campaign, &signatures, unknown, *u);
            own.signatures(into, unknowns.iter().zip(start).map(prediction))
        })?;
        let gram = gram(&slopes);
        Ok(Self { slopes, gram })
    }
}

/// The machine of a recording at some unknowns, the vars first, and its drives.
fn machine_at(
    data: &Data,
    hypothesis: &Hypothesis,
    campaign: usize,
    u: &DVector<f64>,
) -> Result<(Machine, Drives), EffectError> {
    hypothesis.machine(data, campaign, &hypothesis.units(data).params(u), &u.as_slice()[data.units.len()..])
}

/// What a hypothesis predicts in a recording: its machine, and to first order about that its unknown element. How the vars change what the element does is
/// left out of the fit's derivatives, though not of its residuals: beside a solenoid of 40 mrad a fit that is begun again where it ended differs by 0.75 nat.
///
/// # Errors
/// [`EffectError`].
pub fn predicted_by(
    data: &Data,
    hypothesis: &Hypothesis,
    campaign: usize,
    u: &DVector<f64>,
) -> Result<Signature, EffectError> {
    let (machine, drives) = machine_at(data, hypothesis, campaign, u)?;
    let mut all = predicted(&machine, &drives)?;
    if let Some(own) = of_element(data, hypothesis, campaign, (&machine, &drives), u)? {
        all += own;
    }
    Ok(all)
}

/// What the unknown element of a hypothesis does in its machine, if it has one.
///
/// # Errors
/// [`EffectError`].
pub fn of_element(
    data: &Data,
    hypothesis: &Hypothesis,
    campaign: usize,
    (machine, drives): (&Machine, &Drives),
    u: &DVector<f64>,
) -> Result<Option<Signature>, EffectError> {
    if hypothesis.element.is_none() {
        return Ok(None);
    }
    let machine = machine.on_orbit(&drives.orbit);
    let signatures = Signatures::of(&machine, drives)?;
    let unknowns = hypothesis.unknowns(data);
    let forms = unknowns.iter().zip(u.iter().skip(data.units.len()));
    let forms = forms.filter(|(unknown, _)| matches!(unknown.quantity, Quantity::Form(..)));
    summed(forms.filter_map(|(unknown, u)| {
        let form = of_linear(data, campaign, &signatures, unknown, *u).transpose()?;
        Some(form.map(|form| form * *u))
    }))
}

/// The sum of some signatures, if there are any.
fn summed(mut each: impl Iterator<Item = Result<Signature, EffectError>>) -> Result<Option<Signature>, EffectError> {
    let Some(mut sum) = each.next().transpose()? else { return Ok(None) };
    for one in each {
        sum += one?;
    }
    Ok(Some(sum))
}

/// What a machine predicts.
///
/// # Errors
/// [`EffectError`].
pub fn predicted(machine: &Machine, drives: &Drives) -> Result<Signature, EffectError> {
    let (readings, tunes, tune_changes) = machine.readings(drives)?;
    Ok(Signature { readings, tunes: [tunes.x, tunes.y], tune_changes })
}

/// The derivative with respect to an ordinary imperfection, or a form of an unknown element, in a recording, per width, where the machine has it with `u`
/// widths; none of another unknown, or where it does not act. A signature is that of one more effect: of one more gain on what an instrument with a gain error
/// `a` reads or kicks, `(1 + a)` times the derivative (to first order in its other imperfections).
fn of_linear(
    data: &Data,
    campaign: usize,
    signatures: &Signatures,
    unknown: &Unknown,
    u: f64,
) -> Result<Option<Signature>, EffectError> {
    let Unknown { quantity, sigma } = unknown;
    match quantity {
        Quantity::Ordinary(member) if member.is_in(campaign) => {
            let of_term =
                |term: &Term| Ok(signatures.of_effect(term.kind, term.site)? * data.scale(campaign, term.kind));
            let one_more = summed(member.terms.iter().map(of_term))?;
            Ok(one_more.map(|one_more| one_more * (sigma / member.factor(u * sigma))))
        }
        Quantity::Form(quadrupole, form) => {
            // as a field that is no magnet of the ring
            let scale = data.scale(campaign, EffectKind::StrayGradient);
            Ok(Some(form.signature(signatures, &data.ring, *quadrupole) * (*sigma * scale)))
        }
        _ => Ok(None),
    }
}

impl Objective for Problem<'_> {
    /// Whitened residuals.
    type Point = DVector<f64>;
    /// Derivative of the predicted numbers.
    type Slopes = DMatrix<f64>;
    type Error = EffectError;

    fn evaluate(&self, u: &DVector<f64>) -> Result<(f64, DVector<f64>), EffectError> {
        let residual = self.residual(u)?;
        Ok((residual.norm_squared() + u.norm_squared(), residual))
    }

    /// With `A` the derivatives of the others and `Z` those of the imperfections of first order: `1 + (A Z)^T (A Z)` and `(A Z)^T r - u`.
    fn linearise(&self, u: &DVector<f64>, residual: &DVector<f64>) -> Result<(Quadratic, DMatrix<f64>), EffectError> {
        let (slopes, k) = (self.jacobian(u)?, self.others());
        let back = slopes.transpose();
        let cross = &back * &self.ordinary.slopes;
        let mut matrix = DMatrix::identity(u.len(), u.len());
        let mut of_others = matrix.view_mut((0, 0), (k, k));
        of_others += &back * &slopes;
        matrix.view_range_mut(..k, k..).copy_from(&cross);
        matrix.view_range_mut(k.., ..k).copy_from(&cross.transpose());
        let mut of_ordinary = matrix.view_range_mut(k.., k..);
        of_ordinary += &self.ordinary.gram;
        let mut slope = -u;
        let mut of_others = slope.rows_range_mut(..k);
        of_others += slopes.tr_mul(residual);
        let mut of_ordinary = slope.rows_range_mut(k..);
        of_ordinary += self.ordinary.slopes.tr_mul(residual);
        Ok((Quadratic { matrix, slope }, slopes))
    }
}

/// Derivative at 0. Next to a resonance one side has no stable machine, and the other one serves alone.
fn difference(at: impl Fn(f64) -> Result<DVector<f64>, EffectError>) -> Result<DVector<f64>, EffectError> {
    match (at(DIFFERENCE), at(-DIFFERENCE)) {
        (Ok(above), Ok(below)) => Ok((above - below) * (2.0 * DIFFERENCE).recip()),
        (Ok(above), Err(_)) => Ok((above - at(0.0)?) * DIFFERENCE.recip()),
        (Err(_), Ok(below)) => Ok((at(0.0)? - below) * DIFFERENCE.recip()),
        (Err(error), Err(_)) => Err(error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{template, whitened};

    /// Readings and kicks are linear in a gain, so that differences are its derivative to rounding; also beside instruments that are exchanged or reversed. Once the fit's machine
    /// had ordinary gains after the exchange and the derivative before it, so that a fit that was begun at its own end moved.
    #[test]
    fn the_derivative_of_a_gain_is_right_about_a_gain() {
        let (ring, recording) = template();
        let data = whitened(&ring, &recording);
        let beside = [
            "",
            "bpm_swap@y_C5,y_D5=1",
            "bpm_polarity@y_C5=1",
            "corrector_swap@V_D3,V_D7=1",
            "corrector_polarity@V_D3=1",
        ];
        for beside in beside {
            let effect = (!beside.is_empty()).then(|| twin::Effect::parse(beside, &ring).unwrap());
            let hypothesis = Hypothesis { terms: effect.into_iter().map(Term::from).collect(), ..Hypothesis::plain() };
            for (kind, instrument) in [(EffectKind::BpmGain, "y_C5"), (EffectKind::CorrectorGain, "V_D3")] {
                let off = off_by_differences(&data, &hypothesis, Term::at(kind, instrument, &ring).unwrap());
                assert!(off < 1e-9, "{kind:?} beside {beside:?}: {off}");
            }
        }
    }

    /// What is scored as one more effect is what the fit has with it, whatever was found before.
    #[test]
    fn one_more_effect_is_scored_as_it_is_fitted() {
        let (ring, recording) = template();
        let data = whitened(&ring, &recording);
        let term = |text: &str| Term::from(twin::Effect::parse(&format!("{text}=1"), &ring).unwrap());
        let (monitors, correctors) = ("bpm_swap@y_C5,y_D5", "corrector_swap@V_D3,V_D7");
        let after = [
            (monitors, ["bpm_gain@y_C5", "bpm_roll@y_D5", "bpm_swap@y_D5,y_E5"]),
            ("bpm_polarity@y_C5", ["bpm_roll@y_C5", "bpm_crosstalk@y_C3", "bpm_swap@y_D5,y_E5"]),
            (correctors, ["corrector_gain@V_D3", "corrector_crosstalk@V_D3", "corrector_swap@V_D7,V_E3"]),
            ("corrector_polarity@V_D3", ["corrector_gain@V_D3", "corrector_even@V_D3", "corrector_swap@V_D7,V_E3"]),
        ];
        for (first, others) in after {
            let before = Hypothesis::default().with(term(first));
            for other in others {
                let one = term(other);
                let off = off_by_one_more(&data, &before, one);
                assert!(off < 1e-6, "{other} after {first}: {off}");
            }
        }
    }

    /// Largest error of what one more effect does, per unit of its amplitude if it has one, over its largest element.
    fn off_by_one_more(data: &Data, before: &Hypothesis, one: Term) -> f64 {
        let predicted = |hypothesis: &Hypothesis, amplitude: f64| {
            let mut u = DVector::zeros(data.units.len() + hypothesis.unknowns(data).len());
            if let Some(last) = one.kind.prior_scale().filter(|_| amplitude != 0.0) {
                *u.as_mut_slice().last_mut().unwrap() = amplitude / last;
            }
            predicted_by(data, hypothesis, 0, &u).unwrap()
        };
        let step = if one.kind.is_switch() { 1.0 } else { 1e-6 };
        let exact = (predicted(&before.with(one), step) - predicted(before, 0.0)) * (1.0 / step);
        let (machine, drives) = machine_at(data, before, 0, &DVector::zeros(data.units.len())).unwrap();
        let machine = machine.on_orbit(&drives.orbit);
        let scored = Signatures::of(&machine, &drives).unwrap().of_effect(one.kind, one.site).unwrap();
        (&exact.readings - &scored.readings).amax() / exact.readings.amax()
    }

    /// Largest error of the derivative with respect to an ordinary gain, about one of -30 %, over its largest element.
    fn off_by_differences(data: &Data, hypothesis: &Hypothesis, gain: Term) -> f64 {
        let (vars, unknowns) = (data.units.len(), hypothesis.unknowns(data));
        let is_it =
            |unknown: &Unknown| matches!(&unknown.quantity, Quantity::Ordinary(member) if member.terms == [gain]);
        let at = vars + unknowns.iter().position(is_it).unwrap();
        let mut start = DVector::zeros(vars + unknowns.len());
        start[at] = -0.3 / unknowns[at - vars].sigma;
        let residual = |step: f64| {
            let mut u = start.clone();
            u[at] += step;
            Ok::<_, EffectError>(data.residual(&predicted_by(data, hypothesis, 0, &u)?))
        };
        let exact = -difference(residual).unwrap();
        let problem = Problem::new(data, hypothesis, &start).unwrap();
        let found = problem.ordinary.slopes.column(at - problem.others());
        (&exact - found).amax() / exact.amax()
    }
}
