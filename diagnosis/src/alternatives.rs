//! The alternatives of one finding, given the other findings, with their posterior probabilities.

use nalgebra::DVector;

use super::data::Data;
use super::discrepancy::Discrepancy;
use super::fit::Fitted;
use super::location::Location;
use super::noise::Noise;
use super::odds::{SUSPICIOUS, UNMODELLED};
use super::scan::Candidate;
use super::term::Term;

/// Share of the causes that the library does not hold which pass for one of its effects at their place, and show nothing else: in two validations 11 of 171
/// that could be seen.
const ALIKE: f64 = 0.06;
/// Probability of such a cause over that of it or the effect that it looks like: both explain the readings as well, so that it is the ratio of the priors.
const IMITATED: f64 = UNMODELLED * ALIKE / (1.0 - UNMODELLED + UNMODELLED * ALIKE);

/// A possible cause.
#[derive(Debug, Clone)]
pub enum Cause {
    /// An effect of the library.
    Effect(Term),
    /// Physics that the library does not hold.
    Unmodelled(Discrepancy),
}

/// One of the competing causes.
#[derive(Debug, Clone)]
pub struct Alternative {
    /// The cause.
    pub cause: Cause,
    /// `ln` evidence over the fit without it.
    pub log_gain: f64,
    /// Posterior probability within the competition.
    pub probability: f64,
    /// Amplitude and its standard deviation, in the unit of the kind.
    pub amplitude: (f64, f64),
    /// Change of the vars and other unknowns that it causes, to first order, in units of their prior standard deviations.
    pub adapting: DVector<f64>,
    /// The exact fit with it, for the leading causes.
    pub fitted: Option<Fitted>,
}

/// The alternatives of one effect, given the other effects.
#[derive(Debug, Clone)]
pub struct Competition {
    /// Most likely first; those of negligible probability are left out.
    pub alternatives: Vec<Alternative>,
    /// Probability that none of them is needed.
    pub nothing: f64,
    /// Probability of physics that the library does not hold and that is too small to be seen.
    pub too_small: f64,
    /// `ln` posterior odds of any of the alternatives over none.
    pub log_odds: f64,
    /// All candidates of the library, to first order.
    pub scanned: Vec<Candidate>,
    /// The fit without the effect.
    pub without: Fitted,
}

impl Cause {
    /// True for the same effect at the same place, or the same unmodelled place.
    pub fn is(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Effect(one), Self::Effect(other)) => one == other,
            (Self::Unmodelled(one), Self::Unmodelled(other)) => one.at == other.at,
            _ => false,
        }
    }

    /// The effect of the library, if it is one.
    pub fn term(&self) -> Option<&Term> {
        match self {
            Self::Effect(term) => Some(term),
            Self::Unmodelled(_) => None,
        }
    }
}

impl Alternative {
    /// A candidate, to first order.
    pub(super) fn from_candidate(candidate: &Candidate) -> Self {
        let scale = candidate.term.kind.prior_scale();
        let sigma = scale.map_or(0.0, |scale| scale / (1.0 + candidate.power).sqrt());
        let amplitude = (candidate.amplitude * scale.unwrap_or(1.0), sigma);
        let adapting = &candidate.adapting * candidate.amplitude;
        Self { adapting, ..Self::unfitted(Cause::Effect(candidate.term), candidate.log_bayes, amplitude) }
    }

    /// One of the terms of a fit, compared with the fit without it.
    pub(super) fn exact(data: &Data, without: &Fitted, fitted: Fitted, term: usize) -> Self {
        let cause = Cause::Effect(fitted.hypothesis.terms[term]);
        let log_gain = fitted.log_evidence - without.log_evidence;
        let amplitude = fitted.amplitude(data, term);
        Self { fitted: Some(fitted), ..Self::unfitted(cause, log_gain, amplitude) }
    }

    /// A cause without a fit of its own, its probability still open.
    pub(super) fn unfitted(cause: Cause, log_gain: f64, amplitude: (f64, f64)) -> Self {
        Self { cause, log_gain, probability: 0.0, amplitude, adapting: DVector::zeros(0), fitted: None }
    }

    /// An unmodelled discrepancy.
    pub(super) fn unmodelled(discrepancy: Discrepancy) -> Self {
        let (log_gain, amplitude) = (discrepancy.log_bayes, (discrepancy.size, 0.0));
        Self::unfitted(Cause::Unmodelled(discrepancy), log_gain, amplitude)
    }

    /// What varies from frame to frame in the noise of a campaign and is not ordinary, if anything does.
    pub(super) fn from_frame_to_frame(noise: &Noise, campaign: usize) -> Option<Self> {
        let (one, probability) = noise.unordinary()?;
        let (at, log_bayes, size) = (Location::FrameToFrame, one.log_bayes, one.rms.value);
        let found = Self::unmodelled(Discrepancy { at, campaign, log_bayes, size, sites: 1, adapted: None });
        Some(Self { probability, amplitude: (size, one.rms.sigma), ..found })
    }

    /// The effect of the library, if it is one.
    pub fn term(&self) -> Option<&Term> {
        self.cause.term()
    }

    /// True for an effect of the library.
    pub fn is_of_library(&self) -> bool {
        self.term().is_some()
    }
}

/// Probability of what looks like one of some effects, from the sum of theirs.
pub fn imitating(library: f64) -> f64 {
    library * IMITATED / (1.0 - IMITATED)
}

/// Probability below which an alternative that was not refitted is not listed.
const LISTED: f64 = 1e-4;

/// `ln` posterior weight below which one is not listed beside others, nothing (0) among them.
pub(super) fn least_weight(others: &[(Alternative, f64)]) -> f64 {
    others.iter().map(|(_, weight)| *weight).fold(0.0, f64::max) + LISTED.ln()
}

/// Alternatives with their probabilities, and nothing as one of them.
pub(super) struct Weighed {
    /// Most likely first; those of negligible probability are left out.
    pub alternatives: Vec<Alternative>,
    /// Probability that none of them is needed.
    pub nothing: f64,
    /// Probability of what is too small to be seen.
    pub too_small: f64,
    /// `ln` posterior odds of any of the alternatives over none.
    pub log_odds: f64,
}

impl Weighed {
    /// Normalise posterior weights (`ln`; that of no effect is 0); a share [`IMITATED`] of an effect's is that of what only looks like it. What is too
    /// small to be seen explains the readings as no effect does, so that its odds over none, `too_small`, are those of the prior.
    pub fn from_log_weights(mut weights: Vec<(Alternative, f64)>, too_small: f64) -> Self {
        weights.retain(|(_, weight)| weight.is_finite());
        weights.sort_by(|(_, one), (_, other)| other.total_cmp(one));
        let largest = weights.first().map_or(0.0, |(_, weight)| weight.max(0.0));
        let nothing = (-largest).exp();
        let something: f64 = weights.iter().map(|(_, weight)| (weight - largest).exp()).sum();
        let sum = nothing * (1.0 + too_small) + something;
        let normalised = |(alternative, weight): (Alternative, f64)| {
            let itself = if alternative.is_of_library() { 1.0 - IMITATED } else { 1.0 };
            let probability = itself * (weight - largest).exp() / sum;
            Alternative { probability, ..alternative }
        };
        let listed = |one: &Alternative| one.probability > LISTED || one.fitted.is_some();
        let alternatives = weights.into_iter().map(normalised).filter(listed).collect();
        let nothing = nothing / sum;
        Self { alternatives, nothing, too_small: nothing * too_small, log_odds: largest + something.ln() }
    }
}

impl Competition {
    /// Of posterior weights (`ln`; that of no effect is 0), and the odds of what is too small to be seen.
    pub(super) fn from_log_weights(
        weights: Vec<(Alternative, f64)>,
        too_small: f64,
        without: Fitted,
        scanned: Vec<Candidate>,
    ) -> Self {
        let Weighed { alternatives, nothing, too_small, log_odds } = Weighed::from_log_weights(weights, too_small);
        Self { alternatives, nothing, too_small, log_odds, scanned, without }
    }

    /// With fits that keep the data which they are to, for a place beside other data.
    #[must_use]
    pub(super) fn keeping(self, data: &Data) -> Self {
        let keeping = |one: Alternative| Alternative { fitted: one.fitted.map(|fitted| fitted.keeping(data)), ..one };
        let alternatives = self.alternatives.into_iter().map(keeping).collect();
        Self { alternatives, without: self.without.keeping(data), ..self }
    }

    /// True if an effect is likely to be needed.
    pub(crate) fn is_suspicious(&self) -> bool {
        1.0 - self.nothing - self.too_small > SUSPICIOUS
    }

    /// Probability of an effect of the library.
    pub fn library(&self) -> f64 {
        self.alternatives.iter().filter(|a| a.is_of_library()).map(|a| a.probability).sum()
    }

    /// Probability of physics that the library does not hold, `unknown` in the JSON.
    pub fn unknown(&self) -> f64 {
        self.unknown_seen() + self.too_small
    }

    /// The same without what is too small to be seen, which is no evidence of anything.
    pub(crate) fn unknown_seen(&self) -> f64 {
        let listed = self.alternatives.iter().filter(|a| !a.is_of_library());
        imitating(self.library()) + listed.map(|a| a.probability).sum::<f64>()
    }

    /// The exact fit with the most likely effect of the library.
    pub(super) fn leader(&self) -> Option<Fitted> {
        self.alternatives.iter().filter(|a| a.is_of_library()).find_map(|a| a.fitted.clone())
    }
}

#[cfg(test)]
mod tests {
    use twin::{EffectKind, Site};

    use super::*;

    /// All probabilities add up to 1, no effect is more certain than that nothing looks like it, and what is too small to be seen keeps its odds over nothing.
    #[test]
    fn an_effect_is_at_most_as_likely_as_that_nothing_unknown_looks_like_it() {
        let of = |log_gain: f64, corrector: usize| {
            let term = Term { kind: EffectKind::CorrectorGain, site: Site::Corrector(corrector) };
            (Alternative::unfitted(Cause::Effect(term), log_gain, (0.1, 0.01)), log_gain)
        };
        for (first, least) in [(40.0, 0.985), (2.0, 0.6)] {
            let all = Weighed::from_log_weights(vec![of(first, 0), of(0.0, 1)], 0.06);
            let library: f64 = all.alternatives.iter().map(|one| one.probability).sum();
            assert!((all.nothing + all.too_small + library + imitating(library) - 1.0).abs() < 1e-12);
            assert!((all.too_small - 0.06 * all.nothing).abs() < 1e-12);
            let leading = all.alternatives[0].probability;
            assert!(leading > least && leading <= 1.0 - IMITATED, "{leading}");
        }
        assert!((IMITATED - 0.0105).abs() < 5e-4, "0.06 of 15 in 100, beside 85");
    }
}
