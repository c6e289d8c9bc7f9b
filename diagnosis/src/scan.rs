//! First-order scan of all candidates: the gain of each over a fit, vars and all other unknowns adapting.
//!
//! With `d` the whitened signature of a candidate in units of its prior standard deviation, and `P` the projection that removes
//! what the fit's own unknowns can absorb, `g = d P r` and `h = d P d`:
//!
//! `ln Bayes factor = g^2/(1 + h)/2 - ln(1 + h)/2` ([`Evidence`]), or `g - h/2` for an effect without an amplitude.
//!
//! Source: C. R. Rao's score test; A. E. Raftery, Biometrika 83 (1996) 251, for its Bayes factor.

use core::convert::Infallible;

use evidence::{Evidence, Factor, gram};
use nalgebra::{DMatrix, DVector, DVectorView};
use twin::{Drives, EffectKind, Machine, Signatures, Site};

use super::data::Data;
use super::family::members;
use super::fit::{FitError, Fitted};
use super::term::Term;

/// One candidate.
#[derive(Debug, Clone)]
pub struct Candidate {
    /// The effect.
    pub term: Term,
    /// First-order amplitude, in units of its prior standard deviation; 1 without one.
    pub amplitude: f64,
    /// `ln` Bayes factor over the fit.
    pub log_bayes: f64,
    /// Norm squared of what the fit cannot absorb: `d P d`, per prior standard deviation.
    pub power: f64,
    /// Change of the fit's unknowns for an amplitude of one prior standard deviation.
    pub adapting: DVector<f64>,
}

/// Share of the square of a whitened signature that is taken to stay when a fit's unknowns absorb what they can: of exchanged instruments more than a
/// half does. Not so of reversed and dead ones: where gains scatter widely, ordinary gains absorb nearly all of their signature.
const STAYS: f64 = 0.05;

/// Signatures that are scored together.
pub const BATCH: usize = 64;

/// A fit, prepared to score further signatures.
pub struct Projection {
    residual: DVector<f64>,
    /// `J^T`.
    back: DMatrix<f64>,
    factor: Factor,
    /// `J^T r - u`, zero at the best point.
    slope: DVector<f64>,
}

/// The score of one signature.
#[derive(Debug, Clone, Copy)]
pub struct SignatureScore {
    /// `d P r`.
    pub pull: f64,
    /// `d P d`.
    pub power: f64,
}

impl Projection {
    /// About a fit at its best.
    pub fn from_fit(fitted: &Fitted) -> Self {
        Self {
            residual: fitted.residual.clone(),
            back: fitted.jacobian.transpose(),
            factor: fitted.free.clone(),
            slope: fitted.slope.clone(),
        }
    }

    /// About the same point without one of its unknowns: the residuals are those with it at zero.
    pub fn without(fitted: &Fitted, unknown: usize) -> Result<Self, FitError> {
        let residual = &fitted.residual + fitted.jacobian.column(unknown) * fitted.u[unknown];
        let back = fitted.jacobian.transpose().remove_row(unknown);
        let normal = &back * back.transpose() + DMatrix::identity(back.nrows(), back.nrows());
        let factor = Factor::of(normal).ok_or(FitError::Degenerate)?;
        let slope = &back * &residual - fitted.u.clone().remove_row(unknown);
        Ok(Self { residual, back, factor, slope })
    }

    /// `P r`, whose product with a whitened signature is its pull.
    fn pulling(&self) -> DVector<f64> {
        &self.residual - self.back.tr_mul(&self.factor.solve(&self.slope))
    }

    /// Pull of whitened signatures, one a column, and their whole squares, which bound their power.
    pub fn bounds(&self, columns: &DMatrix<f64>) -> Vec<SignatureScore> {
        let pulling = self.pulling();
        let bound =
            |column: DVectorView<f64>| SignatureScore { pull: column.dot(&pulling), power: column.norm_squared() };
        columns.column_iter().map(bound).collect()
    }

    /// Score some terms by their whitened signatures, one a column. Of an exchange whose pull is below half of the power that stays at least, which makes it
    /// less likely than nothing, the power is not worked out: the whole square stands for it.
    fn scan(&self, terms: &[Term], columns: &DMatrix<f64>) -> Vec<Candidate> {
        let bounds = self.bounds(columns);
        let is_hopeless = |i: usize| terms[i].is_exchange() && bounds[i].is_below_half_of_least();
        let (hopeless, scored): (Vec<usize>, Vec<usize>) = (0..terms.len()).partition(|&i| is_hopeless(i));
        let (scores, taken) = self.score(&columns.select_columns(&scored));
        let mut candidates = vec![None; terms.len()];
        let candidate = |i: usize, score: SignatureScore, adapting: DVector<f64>| {
            let term = terms[i];
            let (amplitude, log_bayes) = score.judged(term.kind.is_switch());
            Some(Candidate { term, amplitude, log_bayes, power: score.power, adapting })
        };
        for (at, (&i, &score)) in scored.iter().zip(&scores).enumerate() {
            candidates[i] = candidate(i, score, -taken.column(at));
        }
        for i in hopeless {
            candidates[i] = candidate(i, bounds[i], DVector::zeros(self.slope.len()));
        }
        candidates.into_iter().flatten().collect()
    }

    /// `d_i P d_j` of whitened signatures, one a column.
    pub(crate) fn gram(&self, columns: &DMatrix<f64>) -> DMatrix<f64> {
        let shared = &self.back * columns;
        gram(columns) - gram(&self.factor.whiten(&shared))
    }

    /// Score whitened signatures, one a column, in units of their prior standard deviations; and the fit's unknowns that absorb each, rows unknowns.
    pub fn score(&self, columns: &DMatrix<f64>) -> (Vec<SignatureScore>, DMatrix<f64>) {
        let shared = &self.back * columns;
        let taken = self.factor.solve(&shared);
        let score = |i: usize| {
            let (column, taken) = (columns.column(i), taken.column(i));
            let pull = column.dot(&self.residual) - taken.dot(&self.slope);
            SignatureScore { pull, power: (column.norm_squared() - taken.dot(&shared.column(i))).max(0.0) }
        };
        ((0..columns.ncols()).map(score).collect(), taken)
    }
}

impl SignatureScore {
    /// Of a bound: the power that stays at least.
    pub fn least(self) -> f64 {
        STAYS * self.power
    }

    /// Of a bound: an exchange is less likely than nothing.
    pub(crate) fn is_below_half_of_least(self) -> bool {
        self.pull < 0.5 * self.least()
    }

    /// Amplitude in prior standard deviations and `ln` Bayes factor; a switch has no amplitude but 1.
    pub fn judged(self, is_switch: bool) -> (f64, f64) {
        if is_switch {
            return (1.0, self.pull - 0.5 * self.power);
        }
        let Evidence { amplitude, log_bayes_factor, .. } = Evidence::from_score(self.pull, self.power, 1.0);
        (amplitude, log_bayes_factor)
    }
}

/// All candidates that affect the means of settings; what passes within them was taken out before.
pub fn candidates(data: &Data, radial_loop: Option<&[String; 2]>) -> Vec<Term> {
    let lasting = EffectKind::ALL.iter().filter(|kind| !kind.is_transient());
    let of_kind = |&kind: &EffectKind| members(kind, data);
    let held = |pair: &[String; 2]| Term::at(EffectKind::RadialLoop, &pair.join(","), &data.ring).ok();
    let is_read = |term: &Term| match term.site {
        Site::MonitorPair(one, other) => [one, other].iter().all(|at| data.ring.read_monitors.contains(at)),
        _ => false,
    };
    let radial = radial_loop.and_then(held).filter(is_read);
    let is_believed = |term: &Term| data.campaigns().any(|own| own.believed.kind() == Some(term.kind));
    lasting.flat_map(of_kind).chain(radial).filter(|term| !is_believed(term)).collect()
}

/// What the effects do on some machines.
pub(super) fn of_each(machines: &[(Machine, Drives)]) -> Result<Vec<Signatures<'_>>, FitError> {
    machines.iter().map(|(machine, drives)| Ok(Signatures::of(machine, drives)?)).collect()
}

/// Whitened signatures of some terms about a fit, one a column, per prior standard deviation.
pub fn signatures(data: &Data, fitted: &Fitted, terms: &[Term]) -> Result<DMatrix<f64>, FitError> {
    let data = fitted.data(data);
    let machines = fitted.machines_on_orbit(data)?;
    Ok(whitened(data, &of_each(&machines)?, terms))
}

/// The same by the signatures of the machine in each recording.
fn whitened(data: &Data, of_each: &[Signatures], terms: &[Term]) -> DMatrix<f64> {
    let columns = data.stacked_columns(terms.len(), |campaign, own, into| {
        let signature = |term: &Term| {
            let scale = term.kind.prior_scale().unwrap_or(1.0) * data.scale(campaign, term.kind);
            // none if there is no stable machine with it
            Ok(of_each[campaign].of_effect(term.kind, term.site).ok().map(|one| one * scale))
        };
        own.signatures::<Infallible>(into, terms.iter().map(signature))
    });
    let Ok(columns) = columns;
    columns
}

/// Scan them.
///
/// # Errors
/// [`FitError`].
pub fn scan(data: &Data, fitted: &Fitted, terms: &[Term]) -> Result<Vec<Candidate>, FitError> {
    let (data, projection) = (fitted.data(data), Projection::from_fit(fitted));
    let machines = fitted.machines_on_orbit(data)?;
    let of_each = of_each(&machines)?;
    // all at once would be gigabytes for a ring of 150 monitors
    let of_batch = |batch: &[Term]| projection.scan(batch, &whitened(data, &of_each, batch));
    Ok(terms.chunks(BATCH).flat_map(of_batch).collect())
}

/// Expected `ln` Bayes factor of a cause over its rival, if it is true and `amplitude` prior standard deviations large (known, as far as the
/// prior goes): with the rival's amplitude at its best, `(h - both^2/(1 + h_rival)) a^2/2` or half of `|a d - d_rival|^2` by P, less the difference of
/// their corrections for a free amplitude, `ln((1 + h)/(1 + h_rival))/2`.
///
/// `h = d P d` of what a fit cannot absorb of the cause, per prior standard deviation, `both = d P d_rival`, and `h_rival`, 0 of nothing; whether cause and
/// rival have an amplitude.
pub fn expected(amplitude: f64, [power, both, rival]: [f64; 3], [cause_is_free, rival_is_free]: [bool; 2]) -> f64 {
    let left = if rival_is_free {
        amplitude * amplitude * (power - both * both / (1.0 + rival))
    } else {
        amplitude * amplitude * power - 2.0 * amplitude * both + rival
    };
    let correction = |is_free: bool, power: f64| if is_free { power.max(0.0).ln_1p() } else { 0.0 };
    0.5 * (left.max(0.0) - correction(cause_is_free, power) + correction(rival_is_free, rival))
}

/// [`expected`] of a term of some amplitude (in the unit of its kind) over each of some others, beside a fit.
pub fn separations(
    data: &Data,
    fitted: &Fitted,
    (term, amplitude): (&Term, f64),
    others: &[&Term],
) -> Result<Vec<f64>, FitError> {
    let all: Vec<Term> = core::iter::once(term).chain(others.iter().copied()).copied().collect();
    let gram = Projection::from_fit(fitted).gram(&signatures(data, fitted, &all)?);
    let amplitude = amplitude / term.kind.prior_scale().unwrap_or(1.0);
    let separation = |(i, other): (usize, &&Term)| {
        let free = [term, other].map(|term| !term.kind.is_switch());
        expected(amplitude, [gram[(0, 0)], gram[(0, i + 1)], gram[(i + 1, i + 1)]], free)
    };
    Ok(others.iter().enumerate().map(separation).collect())
}
