//! An ordinary imperfection in the JSON.

use inference::{Imperfection, Measure};
use schemars::JsonSchema;
use serde::Serialize;

/// One imperfection of a recording's machine.
#[derive(Debug, Clone, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct ImperfectionResult {
    pub kind: &'static str,
    pub at: String,
    /// What the members have in common, in the unit.
    pub mean: f64,
    /// Rms of the members about it.
    pub scatter: f64,
    /// Standard deviation of whichever of the two is not 0.
    pub sigma: f64,
    pub unit: &'static str,
    /// For a person, of one that is seen.
    #[serde(skip)]
    pub(crate) row: Option<[String; 4]>,
}

impl From<&Imperfection> for ImperfectionResult {
    fn from(one: &Imperfection) -> Self {
        let Imperfection { kind, measure, measured, unit, .. } = *one;
        let [mean, scatter] = match measure {
            Measure::Mean => [measured.value, 0.0],
            Measure::Scatter => [0.0, measured.value],
        };
        let row = one.is_seen().then(|| one.row());
        Self { kind, at: one.at.clone(), mean, scatter, sigma: measured.sigma, unit: unit.symbol, row }
    }
}
