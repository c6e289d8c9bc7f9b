//! The key to the series: a sample of each with its label, in rows below the title.

use plotters::style::text_anchor::HPos;

use super::canvas::{Drawn, Sheet, TICK, TITLE, plain, px, text_width, write};
use super::pen::{Pen, Spot};
use super::series::Mark;

const ROW: f64 = 20.0;
const LEFT: f64 = 8.0;
const SAMPLE: f64 = 32.0;
const GAP: f64 = 18.0;

/// What a sample shows.
#[derive(Debug, Clone, Copy)]
pub enum Sample {
    /// A line, an area behind it when there is a band; or a marker, a bar through it when there is one.
    Series(Mark, bool),
    /// A marker on a thick and a thin bar.
    Bands,
}

/// A label, its sample and the place of the sample [px].
struct Entry<'l> {
    label: &'l str,
    sample: Sample,
    left: f64,
    row: usize,
}

/// Labels laid out in rows.
pub struct Legend<'l>(Vec<Entry<'l>>);

impl<'l> Legend<'l> {
    /// Rows filled from the left, a new one where the next label would not fit the width of the sheet [px].
    pub fn new(entries: impl IntoIterator<Item = (&'l str, Sample)>, sheet: f64) -> Legend<'l> {
        let (mut left, mut row) = (LEFT, 0);
        let place = |(label, sample)| {
            let width = SAMPLE + text_width(label, TICK) + GAP;
            if left > LEFT && left + width > sheet {
                (left, row) = (LEFT, row + 1);
            }
            left += width;
            Entry { label, sample, left: left - width, row }
        };
        Legend(entries.into_iter().map(place).collect())
    }

    /// Where the plot below may begin [px].
    pub fn bottom(&self) -> f64 {
        TITLE + self.0.last().map_or(0.0, |last| (last.row + 1) as f64 * ROW) + 8.0
    }

    /// Draws it; sample number i with pen number i.
    pub fn draw(&self, sheet: &Sheet) -> Drawn {
        self.0.iter().enumerate().try_for_each(|(index, entry)| {
            let height = TITLE + (entry.row as f64 + 0.5) * ROW;
            sample(sheet, Pen::nth(index), entry.sample, (entry.left, height))?;
            write(sheet, entry.label, (entry.left + SAMPLE, height), &plain(TICK, HPos::Left))
        })
    }
}

/// Draws a sample whose left end is at a place [px].
fn sample(sheet: &Sheet, pen: Pen, sample: Sample, (left, height): (f64, f64)) -> Drawn {
    let spot = |right: f64, up: f64| -> Spot { (px(left + right), px(height - up)) };
    match sample {
        Sample::Series(Mark::Line, band) => {
            if band {
                pen.area(sheet, vec![spot(0.0, 6.0), spot(26.0, 6.0), spot(26.0, -6.0), spot(0.0, -6.0)])?;
            }
            pen.line(sheet, &[spot(0.0, 0.0), spot(26.0, 0.0)])
        }
        Sample::Series(Mark::Points, band) => {
            if band {
                pen.bar(sheet, [spot(13.0, 8.0), spot(13.0, -8.0)], 1.2)?;
            }
            pen.mark(sheet, spot(13.0, 0.0))
        }
        Sample::Bands => {
            pen.bar(sheet, [spot(0.0, 0.0), spot(26.0, 0.0)], 1.2)?;
            pen.pale_bar(sheet, [spot(5.0, 0.0), spot(21.0, 0.0)], 5.0)?;
            pen.mark(sheet, spot(13.0, 0.0))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::canvas::WIDTH;
    use super::*;

    #[test]
    fn long_legends_take_more_rows() {
        let label = "a label of some forty characters in all";
        let bottom = |count| Legend::new([(label, Sample::Bands)].repeat(count), WIDTH).bottom();
        assert_eq!(bottom(2), bottom(1));
        assert_eq!(bottom(5), bottom(1) + 2.0 * ROW);
    }
}
