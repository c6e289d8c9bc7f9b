//! What a fit or a diagnosis learnt of the machine besides missing physics: a table of its ordinary imperfections.

use twin::{Measured, Unit};

/// Unit of positions at the monitors [m], shown in mm.
pub const POSITION: Unit = Unit { symbol: "m", shown: "mm", factor: 1e3 };

/// How a sentence begins that names what all magnets or instruments are off by.
pub const THROUGHOUT: &str = "off throughout the ring";

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
    /// The instruments or magnets that have it: `x`, `y`, `H`, `V`, `all`, or the name of one.
    pub at: String,
    /// What the number is.
    pub measure: Measure,
    /// Value and standard deviation.
    pub measured: Measured,
    /// Unit.
    pub unit: Unit,
    /// Size up to which it is ordinary, 0 where none is.
    pub ordinary: f64,
}

/// Standard deviations from zero from which on one counts as seen.
const SEEN: f64 = 2.0;
/// The same for a property of the whole ring to be certain: chance makes one of ten as large in one recording of 1600.
const CERTAIN: f64 = 4.0;

impl Imperfection {
    /// True if the recording shows it.
    pub fn is_seen(&self) -> bool {
        self.measured.value.abs() > SEEN * self.measured.sigma
    }

    /// True if it is larger than twice what is ordinary.
    pub fn is_large(&self) -> bool {
        self.is_seen() && self.measured.value.abs() > 2.0 * self.ordinary
    }

    /// True if a sentence says it: it is large, or all have it in common beyond doubt.
    fn is_told(&self) -> bool {
        let is_certain = self.measured.value.abs() > CERTAIN * self.measured.sigma;
        self.is_large() || self.measure == Measure::Mean && is_certain
    }

    /// As a row of a table: what it is, its size, what is ordinary, and a remark.
    pub fn row(&self) -> [String; 4] {
        let remark = if self.is_large() { "large" } else { "" };
        let ordinary = if self.ordinary == 0.0 { "none".to_owned() } else { self.unit.rounded(self.ordinary) };
        [self.what(), self.size(), ordinary, remark.to_owned()]
    }

    /// In a sentence: what it is and its size.
    fn said(&self) -> String {
        format!("{} {}", self.what(), self.size())
    }

    /// Those that a sentence says, with their sizes: larger than ordinary, or certain in all of a kind; none without any.
    pub fn told(all: &[Self]) -> Option<String> {
        let said: Vec<String> = all.iter().filter(|one| one.is_told()).map(Self::said).collect();
        (!said.is_empty()).then(|| said.join(", "))
    }

    fn what(&self) -> String {
        if self.at == "all" { self.name.to_owned() } else { format!("{}, {}", self.name, self.at) }
    }

    fn size(&self) -> String {
        let Self { measured, unit, .. } = self;
        match self.measure {
            Measure::Mean => format!("{} {}", measured.signed(unit.factor), unit.shown),
            Measure::Scatter => format!("{} {} rms", measured.size(unit.factor), unit.shown),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_says_what_is_seen_and_what_is_large() {
        let one = |value: f64| Imperfection {
            name: "gains of monitors",
            kind: "bpm_gain",
            at: "all".into(),
            measure: Measure::Scatter,
            measured: Measured { value, sigma: 0.004 },
            unit: Unit::PERCENT,
            ordinary: 0.02,
        };
        assert_eq!(one(0.05).row(), ["gains of monitors", "5.00 ± 0.40 % rms", "2.0 %", "large"]);
        assert_eq!(one(0.05).said(), "gains of monitors 5.00 ± 0.40 % rms");
        assert!(!one(0.03).is_large() && one(0.03).is_seen() && !one(0.007).is_seen());
        let common = |value: f64| Imperfection { measure: Measure::Mean, ..one(value) };
        assert!(!one(0.03).is_told() && common(0.03).is_told() && !common(0.015).is_told());
    }
}
