//! A figure and the numbers it shows.

use super::canvas::{NARROW, WIDTH};

/// A drawing and the numbers it was drawn from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Figure {
    /// The drawing: a whole SVG document without ids, scripts and references.
    pub svg: String,
    /// The same for a phone, with text of the same size on a narrower sheet, where there is one.
    pub narrow: Option<String>,
    /// The plotted numbers, one row per point, under a header.
    pub csv: String,
}

impl Figure {
    /// Some numbers drawn at the width of a page and at that of a phone [px].
    pub(super) fn drawn(csv: String, draw: impl Fn(f64) -> String) -> Self {
        Self { svg: draw(WIDTH), narrow: Some(draw(NARROW)), csv }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::DMatrix;

    use super::*;
    use crate::{Axes, Panel};

    #[test]
    fn a_figure_of_nothing_is_drawn() {
        let axes = Axes::new("t", "x", "y");
        let figures = [
            Figure::lines(&axes, &[]),
            Figure::densities(&axes, &[]),
            Figure::bands(&axes, &[]),
            Figure::heat_map("t", "v", &[], &DMatrix::zeros(0, 0)),
            Figure::small_multiples(&axes, &[]),
            Figure::small_multiples(&axes, &[Panel::default()]),
        ];
        for figure in figures {
            assert!(figure.svg.ends_with("</svg>\n"), "{}", figure.svg);
            assert_eq!(figure.csv.lines().count(), 1);
        }
    }
}
