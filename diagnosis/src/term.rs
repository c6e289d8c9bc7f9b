//! An effect at a place, its amplitude unknown.

use twin::{Effect, EffectError, EffectKind, Ring, Site};

/// One effect that a hypothesis holds, its amplitude unknown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct Term {
    /// Kind of effect.
    pub kind: EffectKind,
    /// Its place.
    pub site: Site,
}

impl Term {
    /// An effect at a named place.
    ///
    /// # Errors
    /// [`EffectError::Place`].
    pub fn at(kind: EffectKind, place: &str, ring: &Ring) -> Result<Self, EffectError> {
        Effect::at(kind, place, 1.0, ring).map(Self::from)
    }

    /// The effect, of an amplitude.
    pub fn effect(self, amplitude: f64) -> Effect {
        Effect { kind: self.kind, site: self.site, amplitude }
    }

    /// True of two exchanged instruments.
    pub(crate) fn is_exchange(self) -> bool {
        self.kind.is_switch() && self.site.is_pair()
    }

    /// `kind@place`.
    pub fn label(self, ring: &Ring) -> String {
        let place = self.site.name(ring);
        if place.is_empty() { self.kind.word().into() } else { format!("{}@{place}", self.kind) }
    }

    /// Position along the beam [m], the first of two places; none for the whole ring.
    pub fn position(self, ring: &Ring) -> Option<f64> {
        self.site.positions(ring).first().copied()
    }
}

impl From<Effect> for Term {
    fn from(effect: Effect) -> Self {
        Self { kind: effect.kind, site: effect.site }
    }
}
