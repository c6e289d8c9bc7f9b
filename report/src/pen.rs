//! How one series among several looks: a colour, a dash and a marker of its own.

use core::f64::consts::{PI, TAU};

use plotters::element::DashedPathElement;
use plotters::prelude::*;

use super::canvas::{Drawn, Sheet, px};

/// A place on the sheet, in drawing units.
pub type Spot = (i32, i32);

/// Colours that are told apart with every common colour vision; the palette's yellow is too pale for white paper.
///
/// Source: M. Okabe and K. Ito, Color Universal Design (2008).
const COLOURS: [RGBColor; 6] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(0, 0, 0),
    RGBColor(230, 159, 0),
];
/// Dash and gap [px]; the first line is solid.
const DASHES: [Option<(f64, f64)>; 6] =
    [None, Some((9.0, 4.0)), Some((2.0, 2.5)), Some((16.0, 5.0)), Some((5.0, 2.0)), Some((5.0, 8.0))];
/// Markers as regular polygons: corners, angle of the first one from straight up, circumscribed radius [px].
const MARKERS: [(u32, f64, f64); 6] =
    [(24, 0.0, 3.6), (4, PI / 4.0, 4.4), (3, 0.0, 5.0), (4, 0.0, 5.0), (3, PI, 5.0), (6, 0.0, 4.2)];

/// Grey of what stands behind the data.
const GREY: RGBColor = RGBColor(110, 110, 110);

/// The look of one series.
#[derive(Debug, Clone, Copy)]
pub struct Pen {
    colour: RGBColor,
    dash: Option<(f64, f64)>,
    marker: (u32, f64, f64),
}

impl Pen {
    /// The look of series number `index`.
    pub fn nth(index: usize) -> Pen {
        let turn = index % COLOURS.len();
        Pen { colour: COLOURS[turn], dash: DASHES[turn], marker: MARKERS[turn] }
    }

    /// Short grey dashes, for what the data is compared with.
    pub fn reference() -> Pen {
        Pen { colour: GREY, dash: Some((4.0, 3.0)), marker: MARKERS[0] }
    }

    /// A line through spots.
    pub fn line(self, sheet: &Sheet, spots: &[Spot]) -> Drawn {
        let style = self.colour.stroke_width(px(1.6) as u32);
        match self.dash {
            None => sheet.draw(&PathElement::new(spots, style)),
            Some((dash, gap)) => sheet.draw(&DashedPathElement::new(spots.iter().copied(), px(dash), px(gap), style)),
        }
    }

    /// A pale area inside an outline.
    pub fn area(self, sheet: &Sheet, outline: Vec<Spot>) -> Drawn {
        sheet.draw(&Polygon::new(outline, self.colour.mix(0.18).filled()))
    }

    /// A straight bar of a width [px].
    pub fn bar(self, sheet: &Sheet, ends: [Spot; 2], width: f64) -> Drawn {
        sheet.draw(&PathElement::new(ends, self.colour.stroke_width(px(width) as u32)))
    }

    /// The same in a paler colour, for what lies under a marker.
    pub fn pale_bar(self, sheet: &Sheet, ends: [Spot; 2], width: f64) -> Drawn {
        sheet.draw(&PathElement::new(ends, self.colour.mix(0.45).stroke_width(px(width) as u32)))
    }

    /// The marker.
    pub fn mark(self, sheet: &Sheet, spot: Spot) -> Drawn {
        let (corners, first, radius) = self.marker;
        let corner = |number| {
            let angle = first + TAU * f64::from(number) / f64::from(corners);
            (spot.0 + px(radius * angle.sin()), spot.1 - px(radius * angle.cos()))
        };
        sheet.draw(&Polygon::new((0..corners).map(corner).collect::<Vec<_>>(), self.colour.filled()))
    }
}

#[cfg(test)]
mod tests {
    use super::super::canvas;
    use super::*;

    fn drawn(index: usize) -> [String; 2] {
        let pen = Pen::nth(index);
        [
            canvas::draw("", (90.0, 50.0), |sheet| pen.line(sheet, &[(0, 0), (900, 0)])),
            canvas::draw("", (90.0, 50.0), |sheet| pen.mark(sheet, (0, 0))),
        ]
    }

    #[test]
    fn pens_differ_without_their_colours() {
        let shapes = |index| drawn(index).map(|svg| svg.replace(&hex(COLOURS[index]), "#colour"));
        for (first, second) in (0..6).flat_map(|first| (0..first).map(move |second| (first, second))) {
            for (one, other) in shapes(first).iter().zip(shapes(second)) {
                assert_ne!(*one, other, "pens {first} and {second}");
            }
        }
    }

    fn hex(colour: RGBColor) -> String {
        format!("#{:02X}{:02X}{:02X}", colour.0, colour.1, colour.2)
    }
}
