//! A series of points: its numbers, and how they are drawn.

use core::ops::Range;

use super::axes::{Axes, span};
use super::canvas::Drawn;
use super::pen::{Pen, Spot};
use super::plot::Plot;

/// Points that belong together.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Series {
    /// What it is, for the legend.
    pub label: String,
    /// Horizontal values; with named axes the places of the names, from 0.
    pub x: Vec<f64>,
    /// Vertical values, one for each x; values that are not finite leave a gap.
    pub y: Vec<f64>,
    /// Lower and upper bound at each x: an area around a line, error bars on points.
    pub band: Option<Vec<(f64, f64)>>,
    /// Whether the points are joined.
    pub mark: Mark,
}

/// How the points of a series are shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Mark {
    /// Joined by a line.
    #[default]
    Line,
    /// Each by a marker.
    Points,
}

impl Series {
    /// Points joined by a line.
    ///
    /// # Panics
    /// When x and y differ in length.
    pub fn line(label: &str, x: Vec<f64>, y: Vec<f64>) -> Series {
        assert_eq!(x.len(), y.len(), "one y for each x of {label}");
        Series { label: label.into(), x, y, ..Series::default() }
    }

    /// Points with a marker each.
    ///
    /// # Panics
    /// When x and y differ in length.
    pub fn points(label: &str, x: Vec<f64>, y: Vec<f64>) -> Series {
        Series { mark: Mark::Points, ..Series::line(label, x, y) }
    }

    /// The same between bounds.
    ///
    /// # Panics
    /// When there is not one pair of bounds for each x.
    #[must_use]
    pub fn within(self, band: Vec<(f64, f64)>) -> Series {
        assert_eq!(band.len(), self.x.len(), "one pair of bounds for each x of {}", self.label);
        Series { band: Some(band), ..self }
    }

    /// As it is drawn on axes: by its logarithms, where the vertical axis is one of logarithms.
    pub(super) fn on(&self, axes: &Axes) -> Series {
        if !axes.is_logarithmic {
            return self.clone();
        }
        let log = |value: &f64| if *value > 0.0 { value.log10() } else { f64::NAN };
        let band = self.band.as_ref().map(|band| band.iter().map(|(low, high)| (log(low), log(high))).collect());
        Series { y: self.y.iter().map(log).collect(), band, ..self.clone() }
    }

    /// Draws what lies behind the data: the area of a line. It is drawn for all series before any data, to hide none.
    fn draw_ground(&self, plot: &Plot, pen: Pen) -> Drawn {
        match self.mark {
            Mark::Line => self.draw_area(plot, pen),
            Mark::Points => Ok(()),
        }
    }

    /// Draws the data: a line, or markers on their error bars.
    fn draw_data(&self, plot: &Plot, pen: Pen) -> Drawn {
        match self.mark {
            Mark::Line => self.draw_line(plot, pen),
            Mark::Points => self.draw_bars(plot, pen).and_then(|()| self.draw_marks(plot, pen)),
        }
    }

    fn draw_area(&self, plot: &Plot, pen: Pen) -> Drawn {
        let bounds: Vec<_> = self.bounds().collect();
        bounds.split(|(x, low, high)| !(x + low + high).is_finite()).filter(|run| run.len() > 1).try_for_each(|run| {
            let upper = run.iter().map(|&(x, _, high)| plot.spot(x, high));
            let lower = run.iter().rev().map(|&(x, low, _)| plot.spot(x, low));
            pen.area(plot.sheet, upper.chain(lower).collect())
        })
    }

    fn draw_line(&self, plot: &Plot, pen: Pen) -> Drawn {
        let points: Vec<_> = self.points_in_order().collect();
        points.split(|(x, y)| !(x + y).is_finite()).filter(|run| !run.is_empty()).try_for_each(|run| {
            let spots: Vec<Spot> = run.iter().map(|&(x, y)| plot.spot(x, y)).collect();
            pen.line(plot.sheet, &spots)
        })
    }

    fn draw_bars(&self, plot: &Plot, pen: Pen) -> Drawn {
        self.bounds()
            .filter(|(x, low, high)| (x + low + high).is_finite())
            .try_for_each(|(x, low, high)| pen.bar(plot.sheet, [plot.spot(x, low), plot.spot(x, high)], 1.2))
    }

    fn draw_marks(&self, plot: &Plot, pen: Pen) -> Drawn {
        self.points_in_order()
            .filter(|(x, y)| (x + y).is_finite())
            .try_for_each(|(x, y)| pen.mark(plot.sheet, plot.spot(x, y)))
    }

    fn points_in_order(&self) -> impl Iterator<Item = (f64, f64)> {
        self.x.iter().copied().zip(self.y.iter().copied())
    }

    fn bounds(&self) -> impl Iterator<Item = (f64, f64, f64)> {
        self.x.iter().zip(self.band.iter().flatten()).map(|(&x, &(low, high))| (x, low, high))
    }
}

/// Draws series on common axes, number i with pen number i.
pub(super) fn draw_all(plot: &Plot, series: &[Series]) -> Drawn {
    let numbered = || series.iter().enumerate();
    numbered().try_for_each(|(index, one)| one.draw_ground(plot, Pen::nth(index)))?;
    numbered().try_for_each(|(index, one)| one.draw_data(plot, Pen::nth(index)))
}

/// Horizontal and vertical range of all series, with the level they are compared with.
pub(super) fn spans<'a>(series: impl Iterator<Item = &'a Series> + Clone, axes: &Axes) -> [Range<f64>; 2] {
    let x = series.clone().flat_map(|one| one.x.iter().copied());
    let bounds = series.clone().flat_map(|one| one.band.iter().flatten()).flat_map(|&(low, high)| [low, high]);
    let y = series.flat_map(|one| one.y.iter().copied()).chain(bounds).chain(axes.level());
    [span(x), span(y)]
}
