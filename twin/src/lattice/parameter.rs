//! What powers a quadrupole, and what of it is fitted.

use super::LatticeError;
use crate::limits::Range;

/// A quadrupole of a ring.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Quadrupole {
    /// Index of its element.
    pub element: usize,
    /// Index of its supply; `None` in series with the dipoles.
    pub supply: Option<usize>,
    /// Index of the param that scales it; `None` stays at its design strength.
    pub parameter: Option<usize>,
}

/// A main supply of quadrupoles, with a read-back of its own.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Supply {
    /// Name in the machine file.
    pub name: String,
}

/// What is fitted: `theta = ln` of a factor on the gradients of some quadrupoles, one magnet or a family.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameter {
    /// Label of the quadrupole, or name of the family.
    pub name: String,
    /// The quadrupoles it scales, indices into [`Ring::quadrupoles`](crate::Ring::quadrupoles).
    pub quadrupoles: Vec<usize>,
    /// What is known of the factor beforehand.
    pub prior: ParameterPrior,
}

/// What is known of a factor before any data: lognormal of mean 1 and a width, within a range.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ParameterPrior {
    /// Standard deviation of the factor [1].
    pub width: f64,
    /// Smallest and largest factor [1].
    pub range: [f64; 2],
}

impl Default for ParameterPrior {
    /// 3 %, within 0.94 to 1.06: the published analysis of the Booster (docs/model.md).
    fn default() -> Self {
        Self { width: 0.03, range: [0.94, 1.06] }
    }
}

impl ParameterPrior {
    /// Widths that are told from none, and from no prior at all.
    pub const WIDTHS: Range = Range::new(1e-6, 1.0, "");

    /// This one, but for a width and a range that `name` states.
    pub(super) fn or(self, name: &str, width: Option<f64>, range: Option<[f64; 2]>) -> Result<Self, LatticeError> {
        let refused = |field, found| Err(LatticeError::Field { name: name.into(), field, found });
        let Self { width, range } = Self { width: width.unwrap_or(self.width), range: range.unwrap_or(self.range) };
        if Self::WIDTHS.check(width).is_err() {
            return refused("a prior_width from 1e-6 to 1", format!("{width:?}"));
        }
        if !(0.0 < range[0] && range[0] < 1.0 && 1.0 < range[1]) {
            return refused("a range of two factors, one between 0 and 1 and one above 1", format!("{range:?}"));
        }
        Ok(Self { width, range })
    }
}
