//! Rectangles of numbers of both signs as colours, side by side on one scale.

use nalgebra::DMatrix;
use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

use super::axes::{Axes, slots};
use super::canvas::{Drawn, LABEL, NARROW, TICK, TITLE, bold, draw, px, text_width, upwards, write};
use super::figure::Figure;
use super::heat_map::{AWAY, BAR, cells, colour_bar, outline, row_names};
use super::numbers::{csv, number};
use super::plot::{Place, Plot};

/// Width of a cell at most, and height of each [px].
const CELL: f64 = 16.0;
const ROW: f64 = 13.0;
/// Space between two maps, and for the name above each [px].
const GAP: f64 = 22.0;
const NAME: f64 = 20.0;

/// One of some maps with the same rows and columns.
#[derive(Debug, Clone, PartialEq)]
pub struct Map {
    /// What it shows, written above it.
    pub name: String,
    /// Its values; what is not a number is missing.
    pub values: DMatrix<f64>,
}

impl Figure {
    /// Maps beside each other, on a phone below each other: `axes` names the columns and labels both sides, `rows` names the rows from the top; colours run
    /// from `-limit` to `limit` and end there. Where the first letter of a name changes, a line divides the map.
    ///
    /// # Panics
    /// When a map has not one row and one column for each name.
    pub fn maps(axes: &Axes, value: &str, limit: f64, rows: &[String], maps: &[Map]) -> Figure {
        for map in maps {
            assert_eq!(map.values.shape(), (rows.len(), axes.x_names.len()), "one row and one column for each name");
        }
        Figure::drawn(numbers(axes, rows, maps), |width| sheet_of(axes, (value, limit), rows, maps, width))
    }
}

fn sheet_of(axes: &Axes, (value, limit): (&str, f64), rows: &[String], maps: &[Map], sheet: f64) -> String {
    let widest = |names: &[String]| names.iter().map(|name| text_width(name, TICK)).fold(0.0, f64::max) + 14.0;
    let (names, count) = (&axes.x_names, maps.len().max(1));
    let beside = if sheet > NARROW { count } else { 1 };
    let first = 22.0 + widest(rows);
    let room = (sheet - first - AWAY - BAR - 62.0 - (beside - 1) as f64 * GAP) / beside as f64;
    let (width, height) = (room.min(CELL * names.len() as f64), ROW * rows.len() as f64);
    let each = NAME + height + widest(names) + 22.0;
    let place = |index: usize| {
        let left = first + (index % beside) as f64 * (width + GAP);
        let top = TITLE + NAME + (index / beside) as f64 * each;
        Place { left, top, right: left + width, bottom: top + height }
    };
    draw(&axes.title, (sheet, TITLE + count.div_ceil(beside) as f64 * each), |sheet| {
        for (index, map) in maps.iter().enumerate() {
            let place = place(index);
            let plot = Plot::new(sheet, place, slots(names.len()), slots(rows.len()));
            cells(&plot, &map.values, limit)?;
            divide(&plot, names, rows)?;
            outline(sheet, place)?;
            plot.x_names(names)?;
            plot.x_label(&axes.x_label, widest(names) + 8.0)?;
            write(sheet, &map.name, ((place.left + place.right) / 2.0, place.top - 9.0), &bold(TICK, HPos::Center))?;
        }
        for place in (0..count).step_by(beside).map(place) {
            row_names(sheet, place, rows)?;
            write(sheet, &axes.y_label, (10.0, place.top + height / 2.0), &upwards(LABEL, HPos::Center))?;
        }
        let last = place(beside - 1);
        let bar = Place { left: last.right + AWAY, right: last.right + AWAY + BAR, ..last };
        colour_bar(sheet, bar, value, limit)
    })
}

/// Lines between names of different first letters: planes are told apart.
fn divide(plot: &Plot, columns: &[String], rows: &[String]) -> Drawn {
    let (right, up) = (columns.len() as f64 - 0.5, rows.len() as f64 - 0.5);
    let line = |from: (f64, f64), to: (f64, f64)| {
        let ends = [plot.spot(from.0, from.1), plot.spot(to.0, to.1)];
        plot.sheet.draw(&PathElement::new(ends, BLACK.stroke_width(px(0.8) as u32)))
    };
    changes(columns).try_for_each(|x| line((x, -0.5), (x, up)))?;
    changes(rows).try_for_each(|y| line((-0.5, up - y - 0.5), (right, up - y - 0.5)))
}

/// Where the first letter changes, half-way between two names.
fn changes(names: &[String]) -> impl Iterator<Item = f64> + '_ {
    let differ = |i: &usize| names[*i].chars().next() != names[i + 1].chars().next();
    (0..names.len().saturating_sub(1)).filter(differ).map(|i| i as f64 + 0.5)
}

fn numbers(axes: &Axes, rows: &[String], maps: &[Map]) -> String {
    let of = |map: &Map| -> Vec<[String; 4]> {
        let cell = |(i, j): (usize, usize)| {
            [map.name.clone(), rows[i].clone(), axes.x_names[j].clone(), number(map.values[(i, j)])]
        };
        (0..rows.len()).flat_map(|i| (0..axes.x_names.len()).map(move |j| (i, j))).map(cell).collect()
    };
    csv(["map", "row", "column", "value"], maps.iter().flat_map(of))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_cell_of_every_map_has_its_row_of_numbers() {
        let name = |letter: char, i: usize| format!("{letter}{i}");
        let rows: Vec<String> = (0..3).map(|i| name('x', i)).chain((0..2).map(|i| name('y', i))).collect();
        let columns: Vec<String> = (0..4).map(|i| name('H', i)).collect();
        let map = |name: &str| Map { name: name.into(), values: DMatrix::from_element(5, 4, 1.5) };
        let axes = Axes::new("t", "corrector", "monitor").named(&columns);
        let figure = Figure::maps(&axes, "v", 4.0, &rows, &[map("before"), map("after")]);
        assert_eq!(figure.csv.lines().count(), 1 + 2 * 20);
        assert!(figure.csv.contains("after,y1,H3,1.5"));
        assert!(rows.iter().all(|name| figure.svg.contains(&format!(">\n{name}\n</text>"))));
        assert_eq!(changes(&rows).collect::<Vec<_>>(), [2.5]);
    }
}
