//! Ranges of named quantities on a logarithmic axis: a bar from the least to the largest value, a marker between, the value in words.

use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

use super::axes::{Axes, slots, span};
use super::canvas::{TICK, draw, plain, px, text_width, write};
use super::figure::Figure;
use super::numbers::{csv, number};
use super::pen::Pen;
use super::plot::{BELOW, Place, Plot, RIGHT};

/// Height of a row [px].
const ROW: f64 = 24.0;
/// Space above the axes [px].
const ABOVE: f64 = 34.0;
/// Grey of the lines of the decades.
const DECADE: RGBColor = RGBColor(225, 225, 225);

/// One quantity.
#[derive(Debug, Clone, PartialEq)]
pub struct Range {
    /// Its name.
    pub label: String,
    /// Least, middle and largest value, above zero.
    pub values: [f64; 3],
    /// The middle one in words, with its unit.
    pub text: String,
}

impl Figure {
    /// Ranges from the top in the order given, on a logarithmic axis; a line stands at 1.
    pub fn ranges(axes: &Axes, entries: &[Range]) -> Figure {
        let row = |entry: &Range| {
            let [low, middle, high] = entry.values.map(number);
            [entry.label.clone(), low, middle, high, entry.text.clone()]
        };
        let csv = csv(["name", "low", "middle", "high", "in words"], entries.iter().map(row));
        Figure::drawn(csv, |width| chart(axes, entries, width))
    }
}

fn chart(axes: &Axes, entries: &[Range], width: f64) -> String {
    let widest = |of: fn(&Range) -> &str| entries.iter().map(|one| text_width(of(one), TICK)).fold(0.0, f64::max);
    let left = widest(|one| &one.label) + 20.0;
    let right = width - RIGHT - widest(|one| &one.text) - 4.0;
    let place = Place { left, top: ABOVE, right, bottom: ABOVE + ROW * entries.len().max(1) as f64 };
    let logs = span(entries.iter().flat_map(|one| one.values).map(f64::log10).chain([0.0]));
    let decades = logs.start.floor()..logs.end.ceil().max(logs.start.floor() + 1.0);
    draw(&axes.title, (width, place.bottom + BELOW), |sheet| {
        let plot = Plot::new(sheet, place, decades.clone(), slots(entries.len()));
        let (top, bottom) = (entries.len().max(1) as f64 - 0.5, -0.5);
        for decade in decades.start as i32..=decades.end as i32 {
            let ends = [plot.spot(f64::from(decade), bottom), plot.spot(f64::from(decade), top)];
            sheet.draw(&PathElement::new(ends, DECADE.stroke_width(px(0.8) as u32)))?;
            let at = (ends[0].0, ends[0].1 + px(13.0));
            sheet.draw_text(&power_of_ten(decade), &plain(TICK, HPos::Center), at)?;
        }
        Pen::reference().line(sheet, &[plot.spot(0.0, bottom), plot.spot(0.0, top)])?;
        plot.frame()?;
        plot.x_label(&axes.x_label, BELOW - 10.0)?;
        entries.iter().enumerate().try_for_each(|(index, entry)| {
            let row = entries.len() as f64 - 1.0 - index as f64;
            let [from, middle, to] = entry.values.map(|value| plot.spot(value.log10(), row));
            Pen::nth(0).pale_bar(sheet, [from, to], 6.0)?;
            Pen::nth(0).mark(sheet, middle)?;
            sheet.draw_text(&entry.label, &plain(TICK, HPos::Right), (px(left - 8.0), middle.1))?;
            let at = (width - RIGHT + 6.0, place.top + (index as f64 + 0.5) * ROW);
            write(sheet, &entry.text, at, &plain(TICK, HPos::Right))
        })
    })
}

fn power_of_ten(decade: i32) -> String {
    let value = 10f64.powi(decade);
    if decade < 0 { format!("{value:.*}", decade.unsigned_abs() as usize) } else { format!("{value:.0}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_range_has_its_row_of_numbers_and_its_words() {
        let entry = |i: usize| Range {
            label: format!("kind {i}"),
            values: [0.02, 0.3, 4.0 + i as f64],
            text: format!("{i} mrad"),
        };
        let figure = Figure::ranges(&Axes::new("t", "limit [1]", ""), &[entry(0), entry(1)]);
        assert_eq!(figure.csv.lines().last(), Some("kind 1,0.02,0.3,5.0,1 mrad"));
        for text in ["kind 0", "1 mrad", "0.01", "10"] {
            assert!(figure.svg.contains(&format!(">\n{text}\n</text>")), "{text}");
        }
    }

    #[test]
    fn no_range_is_drawn() {
        assert!(Figure::ranges(&Axes::new("t", "x", ""), &[]).svg.ends_with("</svg>\n"));
    }
}
