//! What a diagnosis learnt of the machine besides missing physics: a table of its ordinary imperfections.

use twin::{Measured, Unit};

/// What a number is of a family.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Measure {
    /// What all its members have in common.
    Mean,
    /// Standard deviation of the members, or of the frames.
    Scatter,
}

/// One row of the table.
#[derive(Debug, Clone, PartialEq)]
pub struct Imperfection {
    /// What it is.
    pub name: &'static str,
    /// A word for it: that of the kind of effect where there is one.
    pub kind: &'static str,
    /// The instruments or magnets that have it: `x`, `y`, `H`, `V` or `all`.
    pub at: &'static str,
    /// What the number is.
    pub measure: Measure,
    /// Value and standard deviation.
    pub measured: Measured,
    /// Unit.
    pub unit: Unit,
    /// Size up to which it is ordinary.
    pub ordinary: f64,
}

/// Standard deviations from zero from which on one counts as seen.
const SEEN: f64 = 2.0;

impl Imperfection {
    /// True if the recording shows it.
    pub fn is_seen(&self) -> bool {
        self.measured.value.abs() > SEEN * self.measured.sigma
    }

    /// True if it is larger than twice what is ordinary.
    pub fn is_large(&self) -> bool {
        self.is_seen() && self.measured.value.abs() > 2.0 * self.ordinary
    }
}
