//! The unknowns of a fit besides the vars.

use twin::{EffectKind, Plane};

use super::element::Form;
use super::term::Term;

/// One unknown besides the vars.
#[derive(Debug, Clone, PartialEq)]
pub struct Unknown {
    /// What it is.
    pub quantity: Quantity,
    /// Its prior standard deviation.
    pub sigma: f64,
}

/// What an unknown is, whatever its width.
#[derive(Debug, Clone, PartialEq)]
pub enum Quantity {
    /// The amplitude of a term.
    Amplitude(Term),
    /// The orbit of a recording at an element, in x or y [m].
    Orbit(usize, usize, Plane),
    /// The strength of a form of an unknown element near a quadrupole.
    Form(usize, Form),
    /// One ordinary imperfection.
    Ordinary(Member),
}

/// Effects that share an amplitude.
#[derive(Debug, Clone, PartialEq)]
pub struct Member {
    /// The family's name: two may hold the same effect.
    pub family: &'static str,
    /// The effects.
    pub terms: Vec<Term>,
    /// The recording in which they have it; none if they have it in all.
    pub campaign: Option<usize>,
}

/// Least gain error that a fit is linearised about: the derivative is the signature over `1 + a`, and both vanish at -1.
const LEAST_GAIN: f64 = -0.5;

impl Member {
    /// True for a gain of monitors or correctors.
    fn is_gain(&self) -> bool {
        self.terms.iter().all(|term| matches!(term.kind, EffectKind::BpmGain | EffectKind::CorrectorGain))
    }

    /// What its amplitude multiplies readings or kicks by, if it is a gain; 1 of another.
    pub(crate) fn factor(&self, amplitude: f64) -> f64 {
        if self.is_gain() { 1.0 + amplitude } else { 1.0 }
    }

    /// True if it acts in a recording.
    pub(crate) fn is_in(&self, campaign: usize) -> bool {
        self.campaign.is_none_or(|own| own == campaign)
    }
}

/// True for a kind of imperfection that vars absorb: a change of focusing.
pub fn is_absorbed(kind: EffectKind) -> bool {
    matches!(
        kind,
        EffectKind::DipoleGradient
            | EffectKind::DipoleEdge
            | EffectKind::DipoleSextupole
            | EffectKind::MomentumOffset
            | EffectKind::StrayGradient
    )
}

impl Unknown {
    /// True for an ordinary imperfection that does not change the focusing: of others the vars absorb most, and the two cancel only if both are
    /// evaluated for the same machine.
    pub(crate) fn is_of_first_order(&self) -> bool {
        matches!(&self.quantity, Quantity::Ordinary(member) if member.terms.iter().all(|term| !is_absorbed(term.kind)))
    }

    /// The least that it is where a fit is linearised about it, in prior standard deviations.
    pub(crate) fn least_start(&self) -> f64 {
        match &self.quantity {
            Quantity::Ordinary(member) if member.is_gain() => LEAST_GAIN / self.sigma,
            _ => f64::NEG_INFINITY,
        }
    }
}
