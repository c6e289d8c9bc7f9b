//! The magnets and instruments along the beam, below a figure over the path length.

use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

use super::beamline::{Look, Spotted, Strip, Symbol};
use super::canvas::{Drawn, NARROW, SMALL, Sheet, bold, plain, px, text_width, write};
use super::pen::Pen;
use super::plot::Plot;

/// Height of the row of magnets, of the key below it on a page, and of each row of labels [px].
const MAGNETS: f64 = 46.0;
const KEY: f64 = 20.0;
const LABEL: f64 = 15.0;
/// Rows of labels; a mark that would need another one is a line alone.
const ROWS: usize = 5;
/// Space between two labels of one row [px].
const APART: f64 = 10.0;

const INK: RGBColor = RGBColor(60, 60, 60);
const PALE: RGBColor = RGBColor(165, 165, 165);

impl Strip {
    /// Height on a sheet of a width [px].
    pub(super) fn height(&self, sheet: f64) -> f64 {
        let labels = if self.marks.is_empty() { 0.0 } else { LABEL * self.marks.len().min(ROWS) as f64 };
        MAGNETS + labels + key_rows(sheet).len() as f64 * KEY
    }

    /// Below the axes of a plot, `away` from the top of the sheet [px]: its magnets in the range of the axes.
    pub(super) fn draw(&self, plot: &Plot, away: f64, sheet: f64) -> Drawn {
        let middle = away + 0.5 * MAGNETS;
        let at = |s: f64| f64::from(plot.spot(s, 0.0).0) / f64::from(px(1.0));
        let (from, to) = (at(plot.x.start), at(plot.x.end));
        line(plot.sheet, (from, middle), (to, middle), PALE, 1.0)?;
        let inside = |s: f64| (plot.x.start..=plot.x.end).contains(&s);
        for one in self.magnets.iter().filter(|one| one.s < plot.x.end && one.s + one.length > plot.x.start) {
            symbol(plot.sheet, one.symbol, [at(one.s).max(from), at(one.s + one.length).min(to)], middle)?;
        }
        let marks: Vec<&Spotted> = self.marks.iter().filter(|mark| inside(mark.s)).collect();
        let mut ends: Vec<f64> = Vec::new();
        for mark in marks {
            let (x, half) = (at(mark.s), 0.5 * text_width(&mark.label, SMALL));
            // one that is wider than the sheet begins at its left edge
            let x_label = x.min(sheet - half - 2.0).max(half + 2.0);
            let row = ends.iter().position(|end| x_label - half > end + APART).unwrap_or(ends.len());
            ends.resize(ends.len().max(row + 1), 0.0);
            ends[row] = x_label + half;
            let pen = if mark.look == Look::Finding { Pen::nth(1) } else { Pen::reference() };
            for ends in [plot.heights(), [px(away), px(away + MAGNETS)]] {
                pen.bar(plot.sheet, ends.map(|y| (px(x), y)), 1.2)?;
            }
            if row >= ROWS {
                continue;
            }
            let height = away + MAGNETS + LABEL * (row as f64 + 0.5);
            write(plot.sheet, &mark.label, (x_label, height), &bold(SMALL, HPos::Center))?;
        }
        let first = away + self.height(sheet) - key_rows(sheet).len() as f64 * KEY;
        key_rows(sheet)
            .iter()
            .enumerate()
            .try_for_each(|(row, key)| key_row(plot.sheet, key, (from, first + KEY * (row as f64 + 0.5))))
    }
}

/// Rows of the key.
fn key_rows(sheet: f64) -> Vec<&'static [(Symbol, &'static str)]> {
    const ALL: [(Symbol, &str); 6] = [
        (Symbol::Bend, "dipole"),
        (Symbol::Focusing, "quadrupole, focusing in x"),
        (Symbol::Defocusing, "defocusing"),
        (Symbol::Sextupole, "sextupole"),
        (Symbol::Monitor, "monitor"),
        (Symbol::Corrector, "corrector"),
    ];
    const { assert!(ALL.len() == 6, "three and three on a phone") };
    if sheet > NARROW { vec![&ALL] } else { vec![&ALL[..3], &ALL[3..]] }
}

fn key_row(sheet: &Sheet, key: &[(Symbol, &str)], (mut left, height): (f64, f64)) -> Drawn {
    for (one, text) in key {
        let width = if *one == Symbol::Bend { 12.0 } else { 2.0 };
        let up = match one {
            Symbol::Monitor => MONITOR,
            Symbol::Corrector => -CORRECTOR,
            Symbol::Focusing => QUADRUPOLE,
            Symbol::Defocusing => -QUADRUPOLE,
            _ => 0.0,
        };
        symbol(sheet, *one, [left + 6.0 - 0.5 * width, left + 6.0 + 0.5 * width], height + up)?;
        write(sheet, text, (left + 17.0, height), &plain(SMALL, HPos::Left))?;
        left += 17.0 + text_width(text, SMALL) + 12.0;
    }
    Ok(())
}

/// Distance of monitors above the beam, and of correctors below it [px].
const MONITOR: f64 = 16.0;
const CORRECTOR: f64 = 16.0;
/// Distance of the middle of a quadrupole from the beam [px].
const QUADRUPOLE: f64 = 5.5;

/// A symbol between two places of the sheet [px].
fn symbol(sheet: &Sheet, symbol: Symbol, [from, to]: [f64; 2], middle: f64) -> Drawn {
    let x = 0.5 * (from + to);
    let thick = (to - from).max(2.0);
    match symbol {
        Symbol::Bend => block(sheet, [from, to], [middle - 4.0, middle + 4.0], PALE),
        Symbol::Focusing => block(sheet, [x - 0.5 * thick, x + 0.5 * thick], [middle - 2.0 * QUADRUPOLE, middle], INK),
        Symbol::Defocusing => {
            block(sheet, [x - 0.5 * thick, x + 0.5 * thick], [middle, middle + 2.0 * QUADRUPOLE], INK)
        }
        Symbol::Monitor => sheet.draw(&Circle::new((px(x), px(middle - MONITOR)), px(1.8), INK.filled())),
        Symbol::UnreadMonitor => {
            let style = INK.stroke_width(px(0.7) as u32);
            sheet.draw(&Circle::new((px(x), px(middle - MONITOR)), px(1.9), style))
        }
        Symbol::Corrector => {
            let y = middle + CORRECTOR;
            let corners = [(x, y - 3.0), (x - 2.6, y + 2.5), (x + 2.6, y + 2.5)];
            sheet.draw(&Polygon::new(corners.map(|(x, y)| (px(x), px(y))).to_vec(), INK.filled()))
        }
        Symbol::Sextupole => {
            let corners = [(x, middle - 4.0), (x + 4.0, middle), (x, middle + 4.0), (x - 4.0, middle)];
            sheet.draw(&Polygon::new(corners.map(|(x, y)| (px(x), px(y))).to_vec(), INK.filled()))
        }
    }
}

fn block(sheet: &Sheet, [left, right]: [f64; 2], [top, bottom]: [f64; 2], colour: RGBColor) -> Drawn {
    sheet.draw(&Rectangle::new([(px(left), px(top)), (px(right), px(bottom))], colour.filled()))
}

fn line(sheet: &Sheet, from: (f64, f64), to: (f64, f64), colour: RGBColor, width: f64) -> Drawn {
    let ends = [from, to].map(|(x, y)| (px(x), px(y)));
    sheet.draw(&PathElement::new(ends, colour.stroke_width(px(width) as u32)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Axes, Figure, Magnet, Series};

    #[test]
    fn places_are_marked_where_they_are_within_the_axes() {
        let magnet = |symbol, s| Magnet { symbol, s, length: 1.0 };
        let mark = |label: &str, s| Spotted { label: label.into(), s, look: Look::Finding };
        let strip = Strip {
            magnets: vec![magnet(Symbol::Bend, 2.0), magnet(Symbol::Sextupole, 40.0)],
            // the last one is wider than the sheet
            marks: vec![mark("SLOT_B6", 5.0), mark("elsewhere", 50.0), mark(&"x_BPM.63 ".repeat(40), 9.0)],
        };
        let line = Series::line("l", vec![0.0, 10.0], vec![0.0, 1.0]);
        let figure = |strip: Option<Strip>| {
            Figure::lines(&Axes { strip, ..Axes::new("t", "s [m]", "y") }, core::slice::from_ref(&line))
        };
        let (with, without) = (figure(Some(strip)), figure(None));
        for (with, without) in [(with.svg, without.svg), (with.narrow.unwrap(), without.narrow.unwrap())] {
            assert!(with.contains(">\nSLOT_B6\n</text>") && !with.contains("elsewhere"));
            assert!(with.contains("sextupole") && with.len() > without.len());
        }
    }
}
