//! The tests of an effect that was found.

use super::heldout::{CHANCE, SUPPORTED, VALIDATED};

/// How an effect predicts what it was not chosen by, and how often chance would find as much.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tested {
    /// Gain of held-out log predictive density with the amplitude fitted to the rest, and its standard error.
    pub gain: (f64, f64),
    /// The same where kind and place are chosen by the rest too; none beside a fit that is poor without the effect, about which nothing is of
    /// first order, and of an unknown element, whose place and form all readings have chosen.
    pub of_choice: Option<f64>,
    /// Probability of as good a candidate were nothing there.
    pub chance: Option<f64>,
    /// True of an instrument, if the fit without it has a learnt scatter of its kind: once one run shows it, that scatter predicts the other runs nearly as well, so
    /// that held-out readings tell little.
    pub is_of_family: bool,
}

impl Tested {
    /// True if held-out readings are predicted better by more than the standard errors asked for, and by the choice too; of an instrument beside the scatter of
    /// its like, if they are not predicted worse and chance is excluded.
    pub(crate) fn is_passed(&self) -> bool {
        let (gain, error) = self.gain;
        let Some(of_choice) = self.of_choice else { return gain > VALIDATED * error };
        match (self.chance.is_some_and(|chance| chance <= CHANCE), self.is_of_family) {
            (true, true) => gain > 0.0,
            (true, false) => of_choice > 0.0 && gain > SUPPORTED * error,
            (false, _) => of_choice > 0.0 && gain > VALIDATED * error,
        }
    }
}
