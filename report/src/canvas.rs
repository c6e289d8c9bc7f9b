//! The sheet a figure is drawn on: its size, its title, its text.

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

/// Width of a figure on a page, and of one on a phone [px]; sizes of text and marks are the same on both.
pub const WIDTH: f64 = 900.0;
/// See [`WIDTH`].
pub const NARROW: f64 = 420.0;
/// Height that a title of one line takes, size of its text, and height of each further line [px].
pub const TITLE: f64 = 28.0;
const TITLE_TEXT: f64 = 15.0;
const TITLE_LINE: f64 = 19.0;
/// Text sizes [px]: what labels an axis, what numbers it, and the least that stays legible on paper.
pub const LABEL: f64 = 13.0;
/// See [`LABEL`].
pub const TICK: f64 = 12.0;
/// See [`LABEL`].
pub const SMALL: f64 = 11.0;

/// The sheet, or a part of it, in drawing units.
pub type Sheet<'a> = DrawingArea<SVGBackend<'a>, Shift>;
/// What drawing returns.
pub type Drawn = Result<(), DrawingAreaErrorKind<std::io::Error>>;

/// Drawing units in a pixel. Plotters rounds to whole units; a quarter of a pixel is less than a printer shows.
const UNITS: f64 = 4.0;

/// Pixels in drawing units.
pub fn px(pixels: f64) -> i32 {
    (pixels * UNITS).round() as i32
}

/// An SVG document of the given width and height [px] with its title, the rest painted by `paint`. A title that needs more than one line
/// makes the document higher, and the rest stands below it.
pub fn draw(title: &str, (width, height): (f64, f64), paint: impl FnOnce(&Sheet) -> Drawn) -> String {
    let title = lines_of(title, TITLE_TEXT, width - 16.0);
    let further = TITLE_LINE * (title.len().max(1) - 1) as f64;
    let (mut svg, height) = (String::new(), (height + further).ceil());
    {
        let size = (px(width) as u32, px(height) as u32);
        let sheet = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        let line = |(i, text): (usize, &String)| {
            let at = (8.0, 0.5 * TITLE + TITLE_LINE * i as f64);
            write(&sheet, text, at, &bold(TITLE_TEXT, HPos::Left))
        };
        let (_, below) = sheet.split_vertically(px(further));
        sheet
            .fill(&WHITE)
            .and_then(|()| title.iter().enumerate().try_for_each(line))
            .and_then(|()| paint(&below))
            .and_then(|()| sheet.present())
            .expect("a string takes every drawing");
    }
    in_pixels(&svg, width, height)
}

/// The document with its width and height in pixels; the view box stays in drawing units.
fn in_pixels(svg: &str, width: f64, height: f64) -> String {
    let units = format!("width=\"{}\" height=\"{}\"", px(width), px(height));
    svg.replacen(&units, &format!("width=\"{width}\" height=\"{height}\""), 1)
}

/// A text in lines of at most a width [px], broken between words.
pub fn lines_of(text: &str, size: f64, width: f64) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split(' ') {
        match lines.last_mut() {
            Some(line) if text_width(line, size) + text_width(word, size) + 0.55 * size <= width => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

/// Writes text at a place [px].
pub fn write(sheet: &Sheet, text: &str, at: (f64, f64), style: &TextStyle) -> Drawn {
    sheet.draw_text(text, style, (px(at.0), px(at.1)))
}

/// Upright text of a size [px], centred on its height.
pub fn plain(size: f64, side: HPos) -> TextStyle<'static> {
    styled(FontStyle::Normal, size, side)
}

/// The same in bold.
pub fn bold(size: f64, side: HPos) -> TextStyle<'static> {
    styled(FontStyle::Bold, size, side)
}

/// Text that reads upwards.
pub fn upwards(size: f64, side: HPos) -> TextStyle<'static> {
    plain(size, side).transform(FontTransform::Rotate270)
}

/// The SVG backend divides sizes of fonts by 1.24; this takes it back.
fn styled(style: FontStyle, size: f64, side: HPos) -> TextStyle<'static> {
    let font = FontDesc::new(FontFamily::SansSerif, 1.24 * size * UNITS, style);
    TextStyle::from(font).pos(Pos::new(side, VPos::Center))
}

/// Width that a text may take [px]: the viewer's font is unknown, so a wide one is assumed.
pub fn text_width(text: &str, size: f64) -> f64 {
    0.55 * size * text.chars().count() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sheet_is_measured_in_pixels_and_drawn_finer() {
        let svg = draw("Title", (WIDTH, 100.0), |_| Ok(()));
        assert!(svg.contains("width=\"900\" height=\"100\""), "{svg}");
        assert!(svg.contains("viewBox=\"0 0 3600 400\""), "{svg}");
    }

    #[test]
    fn text_is_as_large_as_asked() {
        let svg = draw("Title", (WIDTH, 100.0), |sheet| write(sheet, "x", (9.0, 9.0), &plain(10.0, HPos::Left)));
        assert!(svg.contains("font-size=\"40\""), "{svg}");
    }

    #[test]
    fn a_long_title_takes_more_lines_and_hides_nothing() {
        let title = "a title of more words than one line of a narrow sheet can hold";
        let svg = draw(title, (NARROW, 100.0), |sheet| write(sheet, "x", (9.0, 40.0), &plain(10.0, HPos::Left)));
        assert_eq!(lines_of(title, TITLE_TEXT, NARROW - 16.0).len(), 2);
        assert!(svg.contains("height=\"119\"") && svg.contains("y=\"236\""), "{svg}");
    }
}
