//! What a figure says around its data, and the ranges that hold the data.

use core::ops::Range;

use super::beamline::Strip;

/// Title, axis labels with their units, and what is drawn behind the data.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Axes {
    /// Title above the figure.
    pub title: String,
    /// Quantity and unit on the horizontal axis.
    pub x_label: String,
    /// Quantity and unit on the vertical axis.
    pub y_label: String,
    /// Names that stand for x = 0, 1, 2, ...; without them the axis carries numbers.
    pub x_names: Vec<String>,
    /// The line that perfect data would follow.
    pub reference: Option<Reference>,
    /// The magnets and instruments below, where the horizontal axis is the path length [m].
    pub strip: Option<Strip>,
    /// What happens where on the horizontal axis: a line from bottom to top, and a word beside it, above the data.
    pub events: Vec<(f64, String)>,
    /// The vertical axis of lines and points is logarithmic; values that are not above 0 leave a gap.
    pub is_logarithmic: bool,
}

/// A line to compare the data with, dashed in grey.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Reference {
    /// y is this value everywhere.
    Level(f64),
    /// y equals x.
    Diagonal,
}

impl Axes {
    /// Numbered axes without a reference.
    pub fn new(title: &str, x_label: &str, y_label: &str) -> Axes {
        Axes { title: title.into(), x_label: x_label.into(), y_label: y_label.into(), ..Axes::default() }
    }

    /// The same with names on the horizontal axis.
    #[must_use]
    pub fn named(self, names: &[String]) -> Axes {
        Axes { x_names: names.to_vec(), ..self }
    }

    /// The same with a reference line.
    #[must_use]
    pub fn compared(self, reference: Reference) -> Axes {
        Axes { reference: Some(reference), ..self }
    }

    /// The same with a logarithmic vertical axis.
    #[must_use]
    pub fn logarithmic(self) -> Axes {
        Axes { is_logarithmic: true, ..self }
    }

    /// The same along the beam.
    #[must_use]
    pub fn along(self, strip: Strip) -> Axes {
        Axes { strip: Some(strip), ..self }
    }

    /// The same with what happens on the way.
    #[must_use]
    pub fn marked(self, events: Vec<(f64, String)>) -> Axes {
        Axes { events, ..self }
    }

    /// As they are drawn: a level by its logarithm, where the axis is one of logarithms.
    pub(super) fn drawn(&self) -> Axes {
        let reference = self.reference.map(|reference| match reference {
            Reference::Level(level) if self.is_logarithmic => Reference::Level(level.log10()),
            reference => reference,
        });
        Axes { reference, ..self.clone() }
    }

    /// The level to keep in sight, if there is one.
    pub(super) fn level(&self) -> Option<f64> {
        match self.reference {
            Some(Reference::Level(level)) => Some(level),
            _ => None,
        }
    }
}

/// The range of the finite values; 0 to 1 without any, and never empty.
pub(super) fn span(values: impl IntoIterator<Item = f64>) -> Range<f64> {
    let finite = values.into_iter().filter(|value| value.is_finite());
    let range =
        finite.fold(f64::INFINITY..f64::NEG_INFINITY, |range, value| range.start.min(value)..range.end.max(value));
    if range.start > range.end {
        return 0.0..1.0;
    }
    if range.start == range.end {
        let room = if range.start == 0.0 { 1.0 } else { range.start.abs() * 0.1 };
        return range.start - room..range.end + room;
    }
    range
}

/// A range with a little air on both sides, so that no mark sits on the frame.
pub(super) fn aired(range: Range<f64>) -> Range<f64> {
    let air = 0.04 * (range.end - range.start);
    range.start - air..range.end + air
}

/// The range that gives each of the first `count` integers a slot of its own.
pub(super) fn slots(count: usize) -> Range<f64> {
    -0.5..count.max(1) as f64 - 0.5
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_span_holds_all_finite_values() {
        assert_eq!(span([2.0, f64::NAN, -1.0, f64::INFINITY]), -1.0..2.0);
    }

    #[test]
    fn a_span_is_never_empty() {
        for values in [vec![], vec![0.0], vec![-3.0, -3.0], vec![f64::NAN]] {
            let range = span(values);
            assert!(range.start < range.end, "{range:?}");
        }
    }
}
