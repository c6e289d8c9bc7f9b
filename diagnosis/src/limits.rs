//! Detection limits: the amplitudes that a recording would have shown.
//!
//! An effect of `a` prior standard deviations gives a `ln` Bayes factor of `h a^2/2`, `h = d P d` its power ([`super::scan`]); the limit is where
//! that is [`SEEN`], which pays for the candidates tried.

use twin::EffectKind;

use super::scan::Candidate;
use super::term::Term;

/// `ln` Bayes factor at the limit.
pub const SEEN: f64 = 12.0;

/// The limits of one kind over its places, in the unit of the kind.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// The kind.
    pub kind: EffectKind,
    /// At the place where it is seen best.
    pub least: f64,
    /// At half of the places it is seen from this amplitude on.
    pub median: f64,
    /// At nine places in ten it is seen from this amplitude on.
    pub at_most: f64,
}

impl Limits {
    /// Of a kind among scanned candidates; none of a kind without an amplitude.
    pub fn from_scan(kind: EffectKind, scanned: &[Candidate]) -> Option<Self> {
        let mut all: Vec<f64> = at_places(kind, scanned).map(|(_, limit)| limit).collect();
        all.sort_by(f64::total_cmp);
        let last = all.len().checked_sub(1)?;
        Some(Self { kind, least: all[0], median: all[last - all.len() / 2], at_most: all[9 * last / 10] })
    }
}

/// The limit at each place of a kind.
pub fn at_places(kind: EffectKind, scanned: &[Candidate]) -> impl Iterator<Item = (&Term, f64)> {
    let scale = kind.prior_scale();
    let limit = move |one: &Candidate| Some(scale? * (2.0 * SEEN / one.power.max(f64::MIN_POSITIVE)).sqrt());
    scanned.iter().filter(move |one| one.term.kind == kind).filter_map(move |one| Some((&one.term, limit(one)?)))
}

#[cfg(test)]
mod tests {
    use nalgebra::DVector;
    use twin::Ring;

    use super::*;
    use crate::scan::expected;

    #[test]
    fn an_effect_at_its_limit_has_the_evidence_asked_for() {
        let ring = Ring::paper_booster();
        let terms = EffectKind::BpmGain.sites(&ring).into_iter().map(|site| Term { kind: EffectKind::BpmGain, site });
        let of = |(i, term): (usize, Term)| Candidate {
            term,
            amplitude: 0.0,
            log_bayes: 0.0,
            power: 10.0 * (i + 1) as f64,
            adapting: DVector::zeros(0),
        };
        let scanned: Vec<Candidate> = terms.enumerate().map(of).collect();
        let limits = Limits::from_scan(EffectKind::BpmGain, &scanned).unwrap();
        assert!(limits.least < limits.median && limits.median < limits.at_most);
        for (candidate, (_, limit)) in scanned.iter().zip(at_places(EffectKind::BpmGain, &scanned)) {
            let amplitude = limit / EffectKind::BpmGain.prior_scale().unwrap();
            let gain = expected(amplitude, [candidate.power, 0.0, 0.0], [true, false]);
            // the limit is stated before the correction for the free amplitude
            assert!((gain + 0.5 * candidate.power.ln_1p() - SEEN).abs() < 1e-9, "{gain}");
        }
        assert!(Limits::from_scan(EffectKind::BpmSwap, &scanned).is_none(), "an exchange has no amplitude");
    }
}
