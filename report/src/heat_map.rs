//! A square of numbers between -1 and 1, such as a correlation matrix, as colours.

use nalgebra::DMatrix;
use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

use super::axes::slots;
use super::canvas::{Drawn, LABEL, Sheet, TICK, TITLE, WIDTH, draw, plain, px, text_width, upwards, write};
use super::figure::Figure;
use super::numbers::{csv, number};
use super::plot::{Place, Plot};

/// Side of the square at most, and of a cell at most [px].
const SIDE: f64 = 720.0;
/// See [`SIDE`].
const CELL: f64 = 40.0;
/// Width of the colour bar and its distance from the square [px].
pub(super) const BAR: f64 = 18.0;
/// See [`BAR`].
pub(super) const AWAY: f64 = 24.0;
/// Steps of the colour bar.
const STEPS: usize = 80;

/// Colours of -1, -0.5, 0, 0.5 and 1: blue over white to orange, apart for every common colour vision; the blue end
/// is darker than the orange one, so that the signs stay apart in grey.
const COLOURS: [[f64; 3]; 5] =
    [[0.0, 40.0, 110.0], [70.0, 140.0, 200.0], [255.0, 255.0, 255.0], [250.0, 190.0, 90.0], [205.0, 85.0, 0.0]];
/// Colour of a value that is missing.
const MISSING: RGBColor = RGBColor(150, 150, 150);

impl Figure {
    /// The matrix with its names on both sides, rows from the top, and a colour bar labelled with what the values are.
    ///
    /// # Panics
    /// When the matrix is not square with one row for each name.
    pub fn heat_map(title: &str, value: &str, names: &[String], matrix: &DMatrix<f64>) -> Figure {
        assert_eq!(matrix.shape(), (names.len(), names.len()), "one row and one column for each name");
        Figure { svg: map(title, value, names, matrix), narrow: None, csv: numbers(names, matrix) }
    }
}

fn map(title: &str, value: &str, names: &[String], matrix: &DMatrix<f64>) -> String {
    // whole pixels: cells meet without seams
    let side = (SIDE / names.len().max(1) as f64).min(CELL).floor().max(1.0) * names.len() as f64;
    let margin = names.iter().map(|name| text_width(name, TICK)).fold(0.0, f64::max) + 14.0;
    let left = (WIDTH - side - AWAY - BAR - 60.0 + margin) / 2.0;
    let place = Place { left, top: TITLE + 6.0, right: left + side, bottom: TITLE + 6.0 + side };
    draw(title, (WIDTH, place.bottom + margin), |sheet| {
        let plot = Plot::new(sheet, place, slots(names.len()), slots(names.len()));
        cells(&plot, matrix, 1.0)?;
        outline(sheet, place)?;
        plot.x_names(names)?;
        row_names(sheet, place, names)?;
        colour_bar(sheet, Place { left: place.right + AWAY, right: place.right + AWAY + BAR, ..place }, value, 1.0)
    })
}

/// Cells of a matrix, the first row at the top; the colours end at `limit` on both sides.
pub(super) fn cells(plot: &Plot, matrix: &DMatrix<f64>, limit: f64) -> Drawn {
    let last = matrix.nrows() as f64 - 1.0;
    (0..matrix.nrows()).flat_map(|row| (0..matrix.ncols()).map(move |column| (row, column))).try_for_each(
        |(row, column)| {
            let (x, y) = (column as f64, last - row as f64);
            let corners = [plot.spot(x - 0.5, y + 0.5), plot.spot(x + 0.5, y - 0.5)];
            plot.sheet.draw(&Rectangle::new(corners, colour(matrix[(row, column)] / limit).filled()))
        },
    )
}

/// Names on the left, the first at the top.
pub(super) fn row_names(sheet: &Sheet, place: Place, names: &[String]) -> Drawn {
    let cell = (place.bottom - place.top) / names.len().max(1) as f64;
    names.iter().enumerate().try_for_each(|(row, name)| {
        let at = (place.left - 6.0, place.top + (row as f64 + 0.5) * cell);
        write(sheet, name, at, &plain(TICK, HPos::Right))
    })
}

/// The key to the colours, labelled with what the values are.
pub(super) fn colour_bar(sheet: &Sheet, place: Place, value: &str, limit: f64) -> Drawn {
    let height = |value: f64| place.bottom + (place.top - place.bottom) * (value + 1.0) / 2.0;
    for step in (0..STEPS).rev() {
        let [low, high] = [step, step + 1].map(|edge| 2.0 * edge as f64 / STEPS as f64 - 1.0);
        let corners = [(px(place.left), px(height(high))), (px(place.right), px(place.bottom))]; // over the one above: no seams
        sheet.draw(&Rectangle::new(corners, colour((low + high) / 2.0).filled()))?;
    }
    outline(sheet, place)?;
    for tick in [-1.0, -0.5, 0.0, 0.5, 1.0] {
        let text = format!("{}", tick * limit).replace('-', "\u{2212}");
        write(sheet, &text, (place.right + 6.0, height(tick)), &plain(TICK, HPos::Left))?;
    }
    write(sheet, value, (place.right + 46.0, height(0.0)), &upwards(LABEL, HPos::Center))
}

/// A thin black frame.
pub(super) fn outline(sheet: &Sheet, place: Place) -> Drawn {
    let corners = [(px(place.left), px(place.top)), (px(place.right), px(place.bottom))];
    sheet.draw(&Rectangle::new(corners, BLACK))
}

/// Colour of a value, straight between the five given ones.
fn colour(value: f64) -> RGBColor {
    if value.is_nan() {
        return MISSING;
    }
    let place = (value.clamp(-1.0, 1.0) + 1.0) * 2.0;
    let below = place.floor().min(3.0) as usize;
    let share = place - below as f64;
    let mixed = |part: usize| (COLOURS[below][part] * (1.0 - share) + COLOURS[below + 1][part] * share).round() as u8;
    RGBColor(mixed(0), mixed(1), mixed(2))
}

fn numbers(names: &[String], matrix: &DMatrix<f64>) -> String {
    let rows = names.iter().enumerate().flat_map(|(row, one)| {
        let cell = move |(column, other): (usize, &String)| [one.clone(), other.clone(), number(matrix[(row, column)])];
        names.iter().enumerate().map(cell)
    });
    csv(["row", "column", "value"], rows)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_cell_has_its_row_of_numbers() {
        let names: Vec<String> = (0..7).map(|index| format!("A{index}")).collect();
        let matrix = DMatrix::from_fn(7, 7, |row, column| if row == column { 1.0 } else { -0.25 });
        let figure = Figure::heat_map("t", "correlation [1]", &names, &matrix);
        assert_eq!(figure.csv.lines().count(), 1 + 49);
        assert!(names.iter().all(|name| figure.svg.matches(&format!(">\n{name}\n</text>")).count() == 2));
    }

    #[test]
    fn colours_run_from_blue_over_white_to_orange() {
        assert_eq!(colour(0.0), RGBColor(255, 255, 255));
        assert_eq!(colour(-1.0), RGBColor(0, 40, 110));
        assert_eq!(colour(1.0), RGBColor(205, 85, 0));
        assert_eq!(colour(7.0), colour(1.0));
    }
}
