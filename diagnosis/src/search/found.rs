//! The result of the search.

use crate::alternatives::Competition;
use crate::data::Data;
use crate::fit::Fitted;

/// The result of the search.
#[derive(Debug, Clone)]
pub struct Found {
    /// The recording, linearised about the machine that was found.
    pub data: Data,
    /// The fit without any effect.
    pub null: Fitted,
    /// The fit with all effects found.
    pub best: Fitted,
    /// The alternatives of each effect of `best`, in its order.
    pub competitions: Vec<Competition>,
    /// The alternatives of one more effect.
    pub next: Competition,
}

impl Found {
    /// Probability that the model without effects is complete.
    pub fn nothing(&self) -> f64 {
        self.competitions.iter().fold(self.next.nothing, |least, competition| least.min(competition.nothing))
    }

    /// True if the best fit has anything that the one without effects has not.
    pub fn has_more(&self) -> bool {
        !self.competitions.is_empty() || self.best.hypothesis.element.is_some()
    }
}
