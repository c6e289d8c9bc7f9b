//! What all outcomes together say.

use serde::Serialize;

use super::Outcome;

/// The tables.
#[derive(Debug, Clone, Serialize)]
pub struct Tables {
    outcomes: Vec<Outcome>,
}

impl Tables {
    /// Count.
    pub fn of(outcomes: &[Outcome]) -> Self {
        Self { outcomes: outcomes.to_vec() }
    }

    /// As Markdown.
    pub fn markdown(&self) -> String {
        String::new()
    }
}
