//! Why a hypothesis cannot be fitted.

use twin::{EffectError, OrbitError};

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
