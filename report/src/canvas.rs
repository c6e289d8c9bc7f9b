//! The sheet a figure is drawn on: its size, its title, its text.

use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

/// Width of every figure [px]; sizes of text and marks are chosen for it.
pub const WIDTH: f64 = 900.0;
/// Height that the title takes [px].
pub const TITLE: f64 = 28.0;
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

/// An SVG document of the given height [px] with its title, the rest painted by `paint`.
pub fn draw(title: &str, height: f64, paint: impl FnOnce(&Sheet) -> Drawn) -> String {
    let (mut svg, height) = (String::new(), height.ceil());
    {
        let size = (px(WIDTH) as u32, px(height) as u32);
        let sheet = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        sheet
            .fill(&WHITE)
            .and_then(|()| write(&sheet, title, (8.0, TITLE / 2.0), &bold(15.0, HPos::Left)))
            .and_then(|()| paint(&sheet))
            .and_then(|()| sheet.present())
            .expect("a string takes every drawing");
    }
    in_pixels(&svg, height)
}

/// The document with its width and height in pixels; the view box stays in drawing units.
fn in_pixels(svg: &str, height: f64) -> String {
    let units = format!("width=\"{}\" height=\"{}\"", px(WIDTH), px(height));
    svg.replacen(&units, &format!("width=\"{WIDTH}\" height=\"{height}\""), 1)
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
        let svg = draw("Title", 100.0, |_| Ok(()));
        assert!(svg.contains("width=\"900\" height=\"100\""), "{svg}");
        assert!(svg.contains("viewBox=\"0 0 3600 400\""), "{svg}");
    }

    #[test]
    fn text_is_as_large_as_asked() {
        let svg = draw("Title", 100.0, |sheet| write(sheet, "x", (9.0, 9.0), &plain(10.0, HPos::Left)));
        assert!(svg.contains("font-size=\"40\""), "{svg}");
    }
}
