//! Missing physics: where the model and a recording differ, which effect explains it, and whether a model with that effect predicts
//! better.
//!
//! [`Diagnosis::of`] is the path from top to bottom: columns that are not what the header says are refused ([`wiring`]); the recording is
//! whitened ([`data`]), fitted by the exact twin without any
//! effect ([`fit`]), every effect of the library is tried at every place ([`scan`]), and so is an unmodelled discrepancy
//! ([`discrepancy`]); the leading candidates are refitted and compete ([`search`]); what is found has to predict frames that it was
//! not fitted to ([`heldout`]); [`verdict`] puts the result into one word and one sentence.

pub mod alternatives;
pub mod average;
pub mod baseline;
pub mod data;
pub mod discrepancy;
pub mod error;
pub mod evidence;
pub mod experiment;
pub mod fit;
pub mod heldout;
pub mod hypothesis;
pub mod imperfection;
mod jitter;
mod laplace;
pub mod location;
mod memory;
mod modes;
pub mod noise;
pub mod ordinary;
pub mod page;
pub mod place_scan;
mod repeats;
pub mod sample;
mod scale;
pub mod scan;
pub mod score;
pub mod search;
pub mod settings;
pub mod slow;
pub mod validation;
pub mod verdict;
pub mod wiring;

#[cfg(test)]
mod forward;
#[cfg(test)]
mod testing;

use twin::{Effect, Ring};

use average::Vars;
use data::{Data, DataError};
use heldout::Score;
use hypothesis::Term;
use imperfection::Imperfection;
use inference::Campaign;
use inference::recording::Recording;
use search::{Found, Search};
pub use verdict::{Finding, Verdict};
use wiring::Miswired;

/// What is missing in the model of a recording.
#[derive(Debug, Clone)]
pub struct Diagnosis {
    /// All that was found, with its fits.
    pub found: Found,
    /// The verdict.
    pub verdict: Verdict,
    /// The verdict as a sentence.
    pub sentence: String,
    /// One finding for each effect, strongest first.
    pub findings: Vec<Finding>,
    /// Held-out frames, predicted without any effect.
    pub before: Score,
    /// Held-out frames, predicted with all effects.
    pub after: Score,
    /// Held-out correctors without and with the effects, where none is a corrector's own.
    pub correctors: Option<(Score, Score)>,
    /// Strength factors of the quadrupoles (vars), fitted without any effect.
    pub vars_before: Vars,
    /// Vars, averaged over the competing causes.
    pub vars_after: Vars,
    /// The measurement that would best separate the leading causes, for an ambiguous verdict.
    pub next_measurement: Option<String>,
}

impl Diagnosis {
    /// Diagnose a recording; `progress` is called with the name of each step.
    ///
    /// # Errors
    /// [`DataError`].
    pub fn of(ring: &Ring, recording: &Recording, mut progress: impl FnMut(&str)) -> Result<Self, DataError> {
        progress("reading");
        if let Some(wiring) = Miswired::of(ring, recording)? {
            return Err(DataError::Miswired { recording: recording.name.clone(), wiring });
        }
        let campaign = Campaign::of(ring, recording)?;
        let data = Data::of(&campaign)?;
        let candidates = scan::candidates(&data, recording.header.radial_loop_monitors.as_ref());
        progress("searching");
        let found = Search::new(candidates).run(data)?;
        let data = &found.data;
        progress("held-out frames");
        let folds = heldout::by_repeat(&campaign.settings);
        let bare = if found.competitions.is_empty() { found.null.clone() } else { heldout::bare(data, &found.best)? };
        let before = Score::of(data, &bare, &folds)?;
        let after = if found.competitions.is_empty() { before.clone() } else { Score::of(data, &found.best, &folds)? };
        let gains = verdict::gains(data, &found, &before, &after, &folds)?;
        let verdict = Verdict::of(&found, &gains);
        let findings = verdict::findings(data, &found, &gains, verdict)?;
        progress("held-out correctors");
        let whole =
            !found.competitions.is_empty() && !found.best.hypothesis.terms.iter().any(|t| t.kind.is_of_a_corrector());
        let folds = heldout::by_corrector(recording);
        let correctors = if whole && !folds.is_empty() {
            let scored = |fitted| Score::of(data, fitted, &folds).ok();
            scored(&bare).zip(scored(&found.best))
        } else {
            None
        };
        progress("what to measure next");
        // the proposal is no part of the verdict, so its failure is not one of the diagnosis
        let next_measurement = verdict::next_measurement(data, &found, verdict).unwrap_or_default();
        let sentence = verdict::sentence(data, &found, verdict, &findings);
        let (vars_before, vars_after) = (Vars::of(&found.null), Vars::averaged(&found).widened(&found)?);
        Ok(Self {
            found,
            verdict,
            sentence,
            findings,
            before,
            after,
            correctors,
            vars_before,
            vars_after,
            next_measurement,
        })
    }

    /// The effects in the fitted model, at their most likely amplitudes.
    pub fn effects(&self) -> Vec<Effect> {
        let best = &self.found.best;
        let of = |(i, term): (usize, &Term)| term.effect(best.amplitude(&self.found.data, i).0);
        best.hypothesis.terms.iter().enumerate().map(of).collect()
    }

    /// What was learnt of the machine besides.
    pub fn imperfections(&self) -> Vec<Imperfection> {
        let Found { data, best, .. } = &self.found;
        ordinary::rows(data, best).into_iter().chain(data.noise.rows()).collect()
    }

    /// Gain of held-out log predictive density by all effects, and its standard error.
    pub fn gain(&self) -> (f64, f64) {
        if self.found.competitions.is_empty() { (0.0, 0.0) } else { self.after.gain_over(&self.before) }
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    /// A recording of format 2 need not name the correctors that were set: held-out settings are those of the read-backs, and no
    /// corrector is held out.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn without_names_of_correctors_none_is_held_out() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/ten-cells");
        let ring = Ring::read(&folder.join("ring.json")).unwrap();
        let mut recording = Recording::read(&folder.join("gain"), &ring).unwrap();
        let named = Diagnosis::of(&ring, &recording, |_| ()).unwrap();
        recording.rows.iter_mut().for_each(|row| row.correctors.clear());
        let unnamed = Diagnosis::of(&ring, &recording, |_| ()).unwrap();
        assert!(named.correctors.is_some() && unnamed.correctors.is_none());
        assert!(named.gain().0 > 10.0 && (unnamed.gain().0 / named.gain().0 - 1.0).abs() < 1e-6);
    }
}
