//! The candidates of a search beside a fit without them, as the tests of a choice need them: how it predicts what it was not chosen by
//! ([`super::heldout`]), and how often chance chooses as well ([`super::chance`]).

use nalgebra::DMatrix;

use super::data::Data;
use super::fit::{FitError, Fitted};
use super::scan::{Projection, SignatureScore, signatures};
use super::term::Term;

/// Candidates beside a fit, to first order.
pub struct Choice<'d> {
    /// The recording, as the fit whitens it.
    pub data: &'d Data,
    /// The fit.
    pub without: &'d Fitted,
    terms: Vec<Term>,
    /// Of each term the `ln` Bayes factor that pays for the search.
    penalty: Vec<f64>,
    /// Whitened signatures `d`, one a column.
    pub columns: DMatrix<f64>,
    /// What the fit cannot absorb of them, `P d`.
    pub left: DMatrix<f64>,
    /// By all readings.
    pub scores: Vec<SignatureScore>,
}

/// Power from which on chance cannot choose an exchange: that needs a pull of half the power, five standard deviations.
const BEYOND_CHANCE: f64 = 100.0;

impl<'d> Choice<'d> {
    /// Of some terms and their penalties. Exchanged instruments that neither the recording nor chance can choose are left out.
    pub fn from_terms(data: &'d Data, without: &'d Fitted, terms: &[Term], penalty: &[f64]) -> Result<Self, FitError> {
        let columns = signatures(data, without, terms)?;
        let projection = Projection::from_fit(without);
        let bounds = projection.bounds(&columns);
        let is_open = |&i: &usize| {
            let bound = bounds[i];
            !terms[i].is_exchange() || !bound.is_below_half_of_least() || bound.least() < BEYOND_CHANCE
        };
        let open: Vec<usize> = (0..terms.len()).filter(is_open).collect();
        let columns = columns.select_columns(&open);
        let (scores, taken) = projection.score(&columns);
        let left = &columns - &without.jacobian * taken;
        let (terms, penalty) = open.iter().map(|&i| (terms[i], penalty[i])).unzip();
        Ok(Self { data: without.data(data), without, terms, penalty, columns, left, scores })
    }

    /// `ln` weight of each over that of none, by some scores.
    pub(crate) fn log_weights<'c>(
        &'c self,
        scores: impl Iterator<Item = SignatureScore> + 'c,
    ) -> impl Iterator<Item = f64> + 'c {
        let all = scores.zip(&self.terms).zip(&self.penalty);
        all.map(|((score, term), penalty)| score.judged(term.kind.is_switch()).1 - penalty)
    }
}
