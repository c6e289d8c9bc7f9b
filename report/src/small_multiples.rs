//! Many small plots on the same axes.

use super::axes::{Axes, aired};
use super::canvas::{Drawn, LABEL, SMALL, WIDTH, bold, draw, plain, upwards, write};
use super::figure::Figure;
use super::legend::{Legend, Sample};
use super::numbers::{self, csv};
use super::plot::{BELOW, LEFT, Place, Plot};
use super::series::{Series, draw_all, spans};
use plotters::style::text_anchor::HPos;

const COLUMNS: usize = 6;
/// Height of a panel with its name [px].
const HEIGHT: f64 = 132.0;
/// Space between panels; above them it holds the name [px].
const GAP: f64 = 20.0;
/// See [`GAP`].
const NAME: f64 = 18.0;
const TICKS: usize = 4;

/// One of many plots.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Panel {
    /// What it shows, written above it.
    pub name: String,
    /// Its series; the same number in every panel means the same pen.
    pub series: Vec<Series>,
}

impl Figure {
    /// A grid of panels with common ranges, numbers only on its left and lower edge; names of the axes are seen in
    /// the CSV alone.
    pub fn small_multiples(axes: &Axes, panels: &[Panel]) -> Figure {
        let rows = panels.iter().flat_map(|panel| {
            let row = |[label, x, y, low, high]: [String; 5]| [panel.name.clone(), label, x, y, low, high];
            panel.series.iter().flat_map(|series| numbers::rows(axes, series)).map(row)
        });
        let csv = csv(["panel", "series", "x", "y", "low", "high"], rows);
        Figure { svg: grid(axes, panels), narrow: None, csv }
    }
}

fn grid(axes: &Axes, panels: &[Panel]) -> String {
    let fullest =
        panels.iter().map(|panel| panel.series.as_slice()).max_by_key(|series| series.len()).unwrap_or_default();
    let samples = fullest.iter().map(|one| (one.label.as_str(), Sample::Series(one.mark, one.band.is_some())));
    let legend = Legend::new(samples, WIDTH);
    let [x, y] = spans(panels.iter().flat_map(|panel| &panel.series), axes).map(aired);
    let top = legend.bottom();
    let bottom = top + panels.len().div_ceil(COLUMNS) as f64 * HEIGHT;
    draw(&axes.title, (WIDTH, bottom + BELOW - 6.0), |sheet| {
        legend.draw(sheet)?;
        write(sheet, &axes.y_label, (12.0, (top + bottom) / 2.0), &upwards(LABEL, HPos::Center))?;
        write(sheet, &axes.x_label, ((LEFT + WIDTH - GAP) / 2.0, bottom + BELOW - 18.0), &plain(LABEL, HPos::Center))?;
        panels.iter().enumerate().try_for_each(|(index, panel)| {
            let plot = Plot::new(sheet, place(index, top), x.clone(), y.clone());
            surround(&plot, axes, index, panels.len())?;
            panel_on(&plot, panel, place(index, top))
        })
    })
}

fn place(index: usize, first: f64) -> Place {
    let width = (WIDTH - LEFT + GAP - 8.0) / COLUMNS as f64;
    let left = LEFT + (index % COLUMNS) as f64 * width;
    let top = first + (index / COLUMNS) as f64 * HEIGHT;
    Place { left, top: top + NAME, right: left + width - GAP, bottom: top + HEIGHT - 4.0 }
}

/// Numbers stand where there is no panel to the left, or none below.
fn surround(plot: &Plot, axes: &Axes, index: usize, count: usize) -> Drawn {
    plot.grid(&plot.y_ticks(TICKS))?;
    plot.frame()?;
    if index.is_multiple_of(COLUMNS) {
        plot.y_numbers(&plot.y_ticks(TICKS), SMALL)?;
    }
    if index + COLUMNS >= count {
        plot.x_numbers(TICKS, SMALL)?;
    }
    plot.reference(axes.reference)
}

fn panel_on(plot: &Plot, panel: &Panel, place: Place) -> Drawn {
    let middle = (place.left + place.right) / 2.0;
    write(plot.sheet, &panel.name, (middle, place.top - 9.0), &bold(SMALL, HPos::Center))?;
    draw_all(plot, &panel.series)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Reference;

    #[test]
    fn every_point_of_every_panel_has_its_row_of_numbers() {
        let series = Series::line("rank", vec![0.0, 0.5, 1.0], vec![0.0, 0.6, 1.0]);
        let panels: Vec<_> =
            (0..33).map(|index| Panel { name: format!("R{index}"), series: vec![series.clone()] }).collect();
        let axes = Axes::new("t", "nominal [1]", "observed [1]").compared(Reference::Diagonal);
        let figure = Figure::small_multiples(&axes, &panels);
        assert_eq!(figure.csv.lines().count(), 1 + 33 * 3);
        assert!(panels.iter().all(|panel| figure.svg.contains(&format!(">\n{}\n</text>", panel.name))));
    }
}
