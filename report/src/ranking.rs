//! Values in order of size: a horizontal bar each, groups told apart, and a tick for what each has to exceed.

use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

use super::axes::{Axes, aired, slots, span};
use super::canvas::{Drawn, TICK, draw, plain, px, text_width, write};
use super::figure::Figure;
use super::legend::{Legend, Sample};
use super::numbers::{csv, number};
use super::pen::Pen;
use super::plot::{BELOW, NUMBER, Place, Plot, RIGHT};
use super::series::Mark;

/// Height of a bar's row, and share of it that the bar fills [px].
const ROW: f64 = 22.0;
const BAR: f64 = 11.0;
/// Space on the right for the values in figures [px].
const FIGURES: f64 = 56.0;

/// One value.
#[derive(Debug, Clone, PartialEq)]
pub struct Ranked {
    /// Its name.
    pub label: String,
    /// Which of the groups it is in.
    pub group: usize,
    /// How large it is.
    pub value: f64,
    /// What it has to exceed, if anything.
    pub threshold: Option<f64>,
}

impl Figure {
    /// Bars from the top in the order given; the vertical label says what the tick on a bar is.
    pub fn ranking(axes: &Axes, groups: &[&str], entries: &[Ranked]) -> Figure {
        let rows = entries.iter().map(|entry| {
            let group = groups.get(entry.group).copied().unwrap_or_default();
            [entry.label.clone(), group.into(), number(entry.value), entry.threshold.map_or(String::new(), number)]
        });
        let csv = csv(["name", "group", "value", "threshold"], rows);
        Figure::drawn(csv, |width| chart(axes, groups, entries, width))
    }
}

fn chart(axes: &Axes, groups: &[&str], entries: &[Ranked], width: f64) -> String {
    let samples = groups.iter().map(|group| (*group, Sample::Series(Mark::Points, false)));
    let legend = Legend::new(samples, width);
    let left = entries.iter().map(|entry| text_width(&entry.label, TICK)).fold(0.0, f64::max) + 20.0;
    let top = legend.bottom() + if axes.y_label.is_empty() { 0.0 } else { 20.0 };
    let place = Place { left, top, right: width - RIGHT - FIGURES, bottom: top + ROW * entries.len().max(1) as f64 };
    let values = entries.iter().flat_map(|entry| [Some(entry.value), entry.threshold]).flatten();
    let range = span(values.chain([0.0]));
    let range = if range.start < 0.0 { aired(range) } else { range.start..aired(range).end };
    draw(&axes.title, (width, place.bottom + BELOW), |sheet| {
        legend.draw(sheet)?;
        let plot = Plot::new(sheet, place, range, slots(entries.len()));
        if !axes.y_label.is_empty() {
            let at = legend.bottom() + 4.0;
            tick(&plot, (px(21.0), px(at)))?;
            write(sheet, &axes.y_label, (40.0, at), &plain(TICK, HPos::Left))?;
        }
        plot.frame()?;
        plot.x_numbers(((place.right - place.left) / NUMBER).max(2.0) as usize, TICK)?;
        plot.x_label(&axes.x_label, BELOW - 10.0)?;
        entries.iter().enumerate().try_for_each(|(index, entry)| {
            let row = entries.len() as f64 - 1.0 - index as f64;
            bar(&plot, (left, width), row, entry)
        })
    })
}

/// A bar whose name ends left of the axes, its value in figures at the edge of the sheet.
fn bar(plot: &Plot, (left, width): (f64, f64), row: f64, entry: &Ranked) -> Drawn {
    let (pen, from, to) = (Pen::nth(entry.group), plot.spot(0.0, row), plot.spot(entry.value, row));
    plot.sheet.draw_text(&entry.label, &plain(TICK, HPos::Right), (px(left - 8.0), from.1))?;
    pen.pale_bar(plot.sheet, [from, to], BAR)?;
    pen.mark(plot.sheet, to)?;
    let figures = format!("{:.1}", entry.value).replace('-', "\u{2212}");
    plot.sheet.draw_text(&figures, &plain(TICK, HPos::Right), (px(width - 8.0), from.1))?;
    entry.threshold.map_or(Ok(()), |threshold| tick(plot, plot.spot(threshold, row)))
}

fn tick(plot: &Plot, (x, y): (i32, i32)) -> Drawn {
    let half = px(BAR / 2.0 + 3.0);
    plot.sheet.draw(&PathElement::new([(x, y - half), (x, y + half)], BLACK.stroke_width(px(2.0) as u32)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_bar_has_its_row_of_numbers() {
        let entry = |i: usize| Ranked {
            label: format!("cause {i}"),
            group: i % 2,
            value: 9.0 - i as f64,
            threshold: Some(7.0),
        };
        let entries: Vec<Ranked> = (0..6).map(entry).collect();
        let figure = Figure::ranking(&Axes::new("t", "ln Bayes factor", "threshold"), &["one", "other"], &entries);
        assert_eq!(figure.csv.lines().count(), 1 + 6);
        assert_eq!(figure.csv.lines().nth(2), Some("cause 1,other,8.0,7.0"));
        assert!(entries.iter().all(|entry| figure.svg.contains(&format!(">\n{}\n</text>", entry.label))));
    }

    #[test]
    fn nothing_ranked_is_drawn() {
        assert!(Figure::ranking(&Axes::new("t", "x", ""), &[], &[]).svg.ends_with("</svg>\n"));
    }
}
