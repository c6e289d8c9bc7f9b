//! What a diagnosis states as the most likely cause, and with which probability.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::case::Class;

/// What may be the matter: nothing, an effect of the library, or other physics.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
#[allow(missing_docs)] // named after what they are
pub enum Sort {
    Nothing,
    Library,
    Unknown,
}

/// Number of sorts.
pub const SORTS: usize = 3;

/// The most likely cause of the least certain finding.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
pub struct Stated {
    /// Kind and place, `nothing` or `unknown`.
    pub cause: String,
    /// Its sort.
    pub sort: Sort,
    /// Its probability.
    pub probability: f64,
    /// Probability of each sort, beside the other findings.
    pub of_sorts: [f64; SORTS],
    /// Whether it is true.
    pub is_true: bool,
}

impl Stated {
    /// Of a finding.
    pub fn of(cause: String, sort: Sort, probability: f64, of_sorts: [f64; SORTS], is_true: bool) -> Self {
        Self { cause, sort, probability, of_sorts, is_true }
    }
}

impl Sort {
    /// What a class of campaigns holds.
    pub fn of(class: Class) -> Self {
        match class {
            Class::Empty => Self::Nothing,
            Class::Single | Class::Pair => Self::Library,
            Class::Unknown => Self::Unknown,
        }
    }
}
