//! One pair of axes on the sheet: where a value lies, ticks, numbers, names, the line to compare with.

use core::ops::Range;

use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

use super::axes::{Axes, Reference, slots};
use super::canvas::{Drawn, LABEL, SMALL, Sheet, TICK, plain, px, text_width, upwards, write};
use super::pen::{Pen, Spot};
use super::ticks::Ticks;

/// Space on the left for numbers and a label [px].
pub const LEFT: f64 = 68.0;
/// Space on the right for half a number [px].
pub const RIGHT: f64 = 20.0;
/// Space below for numbers and a label [px].
pub const BELOW: f64 = 46.0;

/// Space for a number below the axes [px].
pub const NUMBER: f64 = 80.0;

const FRAME: RGBColor = BLACK;
const GRID: RGBColor = RGBColor(225, 225, 225);
const STRIPE: RGBColor = RGBColor(244, 244, 244);
const TICK_LENGTH: f64 = 4.0;

/// A rectangle of the sheet [px].
#[derive(Debug, Clone, Copy)]
pub struct Place {
    /// Left edge.
    pub left: f64,
    /// Upper edge.
    pub top: f64,
    /// Right edge.
    pub right: f64,
    /// Lower edge.
    pub bottom: f64,
}

/// A pair of axes in a place of the sheet.
pub struct Plot<'s, 'a> {
    /// The sheet drawn on.
    pub sheet: &'s Sheet<'a>,
    place: Place,
    /// Range of the horizontal axis.
    pub x: Range<f64>,
    y: Range<f64>,
    coordinates: Cartesian2d<RangedCoordf64, RangedCoordf64>,
}

impl<'s, 'a> Plot<'s, 'a> {
    /// Axes of these ranges.
    pub fn new(sheet: &'s Sheet<'a>, place: Place, x: Range<f64>, y: Range<f64>) -> Plot<'s, 'a> {
        let units = (px(place.left)..px(place.right), px(place.bottom)..px(place.top));
        let coordinates = Cartesian2d::new(x.clone(), y.clone(), units);
        Plot { sheet, place, x, y, coordinates }
    }

    /// Where a point lies.
    pub fn spot(&self, x: f64, y: f64) -> Spot {
        self.coordinates.translate(&(x, y))
    }

    /// The upper and the lower edge, in drawing units.
    pub fn heights(&self) -> [i32; 2] {
        [px(self.place.top), px(self.place.bottom)]
    }

    /// The frame: an edge on the left and one below.
    pub fn frame(&self) -> Drawn {
        let corners = [(self.x.start, self.y.end), (self.x.start, self.y.start), (self.x.end, self.y.start)];
        let path = corners.map(|(x, y)| self.spot(x, y));
        self.sheet.draw(&PathElement::new(path, FRAME.stroke_width(px(1.0) as u32)))
    }

    /// So many ticks on the vertical axis at most.
    pub fn y_ticks(&self, count: usize) -> Ticks {
        Ticks::new(&self.y, count)
    }

    /// Pale lines at the ticks of the vertical axis.
    pub fn grid(&self, ticks: &Ticks) -> Drawn {
        let style = GRID.stroke_width(px(0.8) as u32);
        ticks.values.iter().try_for_each(|&y| {
            self.sheet.draw(&PathElement::new([self.spot(self.x.start, y), self.spot(self.x.end, y)], style))
        })
    }

    /// A pale stripe behind every other name, to lead the eye down to it.
    fn stripes(&self, names: usize) -> Drawn {
        (1..names).step_by(2).map(|name| name as f64).try_for_each(|x| {
            let corners = [self.spot(x - 0.5, self.y.start), self.spot(x + 0.5, self.y.end)];
            self.sheet.draw(&Rectangle::new(corners, STRIPE.filled()))
        })
    }

    /// Numbers on the vertical axis, in text of a size [px].
    pub fn y_numbers(&self, ticks: &Ticks, size: f64) -> Drawn {
        ticks.values.iter().try_for_each(|&y| {
            let (left, height) = self.spot(self.x.start, y);
            self.tick((left, height), (-TICK_LENGTH, 0.0))?;
            let at = (left - px(TICK_LENGTH + 4.0), height);
            self.sheet.draw_text(&ticks.number(y), &plain(size, HPos::Right), at)
        })
    }

    /// Numbers on the horizontal axis, in text of a size [px].
    pub fn x_numbers(&self, ticks: usize, size: f64) -> Drawn {
        let ticks = Ticks::new(&self.x, ticks);
        ticks.values.iter().try_for_each(|&x| {
            let (left, height) = self.spot(x, self.y.start);
            self.tick((left, height), (0.0, TICK_LENGTH))?;
            let at = (left, height + px(TICK_LENGTH + 9.0));
            self.sheet.draw_text(&ticks.number(x), &plain(size, HPos::Center), at)
        })
    }

    /// Names below the slots, reading upwards; where they would touch, only every second, third, ... one.
    pub fn x_names(&self, names: &[String]) -> Drawn {
        let room = (self.place.right - self.place.left) / names.len().max(1) as f64;
        let step = (TICK / room).ceil().max(1.0) as usize;
        (0..names.len()).step_by(step).try_for_each(|index| {
            let (left, height) = self.spot(index as f64, self.y.start);
            self.tick((left, height), (0.0, TICK_LENGTH))?;
            let at = (left, height + px(TICK_LENGTH + 4.0));
            self.sheet.draw_text(&names[index], &upwards(TICK, HPos::Right), at)
        })
    }

    /// Label of the vertical axis, at the left edge of the sheet.
    pub fn y_label(&self, label: &str) -> Drawn {
        let middle = (self.place.top + self.place.bottom) / 2.0;
        write(self.sheet, label, (self.place.left - LEFT + 12.0, middle), &upwards(LABEL, HPos::Center))
    }

    /// Label of the horizontal axis, this far below it [px].
    pub fn x_label(&self, label: &str, below: f64) -> Drawn {
        let middle = (self.place.left + self.place.right) / 2.0;
        write(self.sheet, label, (middle, self.place.bottom + below), &plain(LABEL, HPos::Center))
    }

    /// The line to compare with, as far as it lies within the axes.
    pub fn reference(&self, reference: Option<Reference>) -> Drawn {
        let [from, to] = match reference {
            None => return Ok(()),
            Some(Reference::Level(y)) => [(self.x.start, y), (self.x.end, y)],
            Some(Reference::Diagonal) => {
                let (from, to) = (self.x.start.max(self.y.start), self.x.end.min(self.y.end));
                [(from, from), (to, to)]
            }
        };
        if from.0 >= to.0 {
            return Ok(());
        }
        Pen::reference().line(self.sheet, &[self.spot(from.0, from.1), self.spot(to.0, to.1)])
    }

    /// All that surrounds the data of a figure with one plot; the data is drawn on top.
    pub fn surround(&self, axes: &Axes) -> Drawn {
        self.stripes(axes.x_names.len())?;
        let ticks = if axes.is_logarithmic { Ticks::decades(&self.y, 9) } else { self.y_ticks(7) };
        self.grid(&ticks)?;
        self.frame()?;
        self.y_numbers(&ticks, TICK)?;
        self.y_label(&axes.y_label)?;
        if axes.x_names.is_empty() {
            self.x_numbers(((self.place.right - self.place.left) / NUMBER) as usize, TICK)?;
        } else {
            self.x_names(&axes.x_names)?;
        }
        self.x_label(&axes.x_label, below(&axes.x_names) - 10.0)?;
        self.events(&axes.events)?;
        self.reference(axes.reference)
    }

    /// A dashed line at each event, and left of it what it is, read upwards and ending at the top.
    fn events(&self, events: &[(f64, String)]) -> Drawn {
        events.iter().filter(|(x, _)| self.x.contains(x)).try_for_each(|(x, label)| {
            let [foot, top] = [self.y.start, self.y.end].map(|y| self.spot(*x, y));
            Pen::reference().line(self.sheet, &[foot, top])?;
            let at = (top.0 - px(0.6 * SMALL), top.1 + px(4.0));
            self.sheet.draw_text(label, &upwards(SMALL, HPos::Right), at)
        })
    }

    fn tick(&self, from: Spot, by: (f64, f64)) -> Drawn {
        let to = (from.0 + px(by.0), from.1 + px(by.1));
        self.sheet.draw(&PathElement::new([from, to], FRAME.stroke_width(px(1.0) as u32)))
    }
}

/// Space below the axes [px] for numbers, or for these names, and a label.
pub fn below(names: &[String]) -> f64 {
    let longest = names.iter().map(|name| text_width(name, TICK)).fold(0.0, f64::max);
    BELOW.max(longest + 2.0 * TICK_LENGTH + 24.0)
}

/// The horizontal range for these names, or else for these values.
pub fn x_range(names: &[String], values: Range<f64>) -> Range<f64> {
    if names.is_empty() { values } else { slots(names.len()) }
}
