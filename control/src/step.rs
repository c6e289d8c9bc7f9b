//! One setting of the machine that frames are taken at.

use core::fmt;

use serde::{Deserialize, Serialize};

/// One setting; everything that it does not name is as it was before the measurement.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Step {
    /// A corrector is set.
    Corrector {
        /// Its name in recordings.
        corrector: String,
        /// Its current [A].
        #[serde(rename = "setting_A")]
        current: f64,
    },
    /// The RF frequency is set.
    Rf {
        /// Its relative offset from what it was [1].
        #[serde(rename = "drf_rel")]
        offset: f64,
    },
}

impl fmt::Display for Step {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Corrector { corrector, current: 0.0 } => write!(f, "{corrector} at 0 A"),
            Self::Corrector { corrector, current } => write!(f, "{corrector} at {current:+} A"),
            Self::Rf { offset: 0.0 } => write!(f, "RF frequency as it was"),
            Self::Rf { offset } => write!(f, "RF frequency at {offset:+e}"),
        }
    }
}
