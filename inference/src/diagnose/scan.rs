//! Every candidate at once, to first order: what each would gain over a fit, vars and all other unknowns adapting.
//!
//! With `d` the whitened signature of a candidate in units of its prior standard deviation, and `P` the projection that takes away
//! what the fit's own unknowns can imitate, `g = d P r` and `h = d P d`:
//!
//! `ln Bayes factor = g^2/(1 + h)/2 - ln(1 + h)/2`, or `g - h/2` for an effect without an amplitude.
//!
//! Source: C. R. Rao's score test; A. E. Raftery, Biometrika 83 (1996) 251, for its Bayes factor.

use nalgebra::{DMatrix, DVector};
use twin::{EffectError, EffectKind, Signatures};

use super::data::Data;
use super::fit::Fitted;
use super::hypothesis::{Term, members};

/// One candidate.
#[derive(Debug, Clone)]
pub struct Candidate {
    /// The effect.
    pub term: Term,
    /// First-order amplitude, in units of its prior standard deviation; 1 without one.
    pub amplitude: f64,
    /// `ln` Bayes factor over the fit.
    pub log_bayes: f64,
    /// What the fit cannot imitate: `d P d`, per prior standard deviation.
    pub power: f64,
    /// How the fit's unknowns adapt to an amplitude of one prior standard deviation.
    pub adapting: DVector<f64>,
}

const BATCH: usize = 64;

/// All candidates that the data can say anything about.
pub fn candidates(data: &Data, radial_loop: Option<&[String; 2]>) -> Vec<Term> {
    let of_kind = |&kind: &EffectKind| members(kind, data);
    let radial = radial_loop.map(|pair| Term::new(EffectKind::RadialLoop, &pair.join(",")));
    EffectKind::ALL.iter().flat_map(of_kind).chain(radial).collect()
}

/// Scan them.
///
/// # Errors
/// [`EffectError`].
pub fn scan(data: &Data, fitted: &Fitted, terms: &[Term]) -> Result<Vec<Candidate>, EffectError> {
    let vars = fitted.params.len();
    let (machine, drives) = fitted.hypothesis.machine(data, &fitted.params, &fitted.u.as_slice()[vars..])?;
    let signatures = Signatures::of(&machine, &drives)?;
    let back = fitted.jacobian.transpose();
    let mut all = Vec::with_capacity(terms.len());
    for batch in terms.chunks(BATCH) {
        let columns: Vec<DVector<f64>> = batch
            .iter()
            .map(|term| {
                let scale = term.kind.prior_scale().unwrap_or(1.0);
                Ok(data.signature(&signatures.of_effect(term.kind, &term.place)?) * scale)
            })
            .collect::<Result<_, EffectError>>()?;
        let columns = DMatrix::from_columns(&columns);
        let shared = &back * &columns;
        let taken = fitted.free.solve(&shared);
        for (i, term) in batch.iter().enumerate() {
            let column = columns.column(i);
            let g = column.dot(&fitted.residual) - taken.column(i).dot(&fitted.slope);
            let h = (column.norm_squared() - taken.column(i).dot(&shared.column(i))).max(0.0);
            let (amplitude, log_bayes) = match term.kind.prior_scale() {
                Some(_) => (g / (1.0 + h), 0.5 * g * g / (1.0 + h) - 0.5 * h.ln_1p()),
                None => (1.0, g - 0.5 * h),
            };
            all.push(Candidate { term: term.clone(), amplitude, log_bayes, power: h, adapting: -taken.column(i) });
        }
    }
    Ok(all)
}

/// `ln` Bayes factor of all members of a family having amplitudes of one of some standard deviations, to first order.
///
/// # Errors
/// [`EffectError`].
pub fn family(data: &Data, fitted: &Fitted, members: &[Term], widths: &[f64]) -> Result<Vec<f64>, EffectError> {
    let vars = fitted.params.len();
    let (machine, drives) = fitted.hypothesis.machine(data, &fitted.params, &fitted.u.as_slice()[vars..])?;
    let signatures = Signatures::of(&machine, &drives)?;
    let columns: Vec<DVector<f64>> = members
        .iter()
        .map(|term| Ok(data.signature(&signatures.of_effect(term.kind, &term.place)?)))
        .collect::<Result<_, EffectError>>()?;
    let columns = DMatrix::from_columns(&columns);
    let shared = fitted.jacobian.transpose() * &columns;
    let taken = fitted.free.solve(&shared);
    let pull = columns.tr_mul(&fitted.residual) - taken.tr_mul(&fitted.slope);
    let gram = columns.transpose() * &columns - shared.transpose() * taken;
    Ok(widths.iter().map(|&width| super::discrepancy::marginal(&pull, &gram, width)).collect())
}
