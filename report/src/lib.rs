//! Results on paper: figures with the numbers behind them, and one HTML page that holds them all.
//!
//! A [`Figure`] is drawn as SVG and carries what it shows as CSV, both made from the same values. A [`Page`] is a
//! single file without scripts and without anything fetched from elsewhere: it can be mailed, archived and printed.
//! Colours are those of Okabe and Ito, and what they tell apart is told apart by dashes and markers too.
//!
//! ```
//! use report::{Axes, Figure, Page, Section, Series};
//!
//! let axes = Axes::new("Closed orbit", "path length [m]", "position [mm]");
//! let orbit = Series::line("made-up orbit", vec![0.0, 1.0, 2.0], vec![0.1, -0.2, 0.3]);
//! let figure = Figure::lines(&axes, &[orbit]);
//! assert!(figure.csv.contains("made-up orbit,1.0,-0.2"));
//!
//! let section = Section { heading: "Orbit".into(), figures: vec![("Three readings.".into(), figure)], ..Section::default() };
//! let page = Page { title: "A report".into(), lead: "One orbit.".into(), sections: vec![section] };
//! assert!(page.render().starts_with("<!DOCTYPE html>"));
//! ```

mod axes;
mod bands;
mod beamline;
mod canvas;
mod figure;
mod heat_map;
mod legend;
mod lines;
mod maps;
mod numbers;
mod page;
mod pen;
mod plot;
mod ranges;
mod ranking;
mod ring_map;
mod series;
mod small_multiples;
mod strip;
mod ticks;

pub use axes::{Axes, Reference};
pub use bands::Band;
pub use beamline::{Look, Magnet, Spotted, Strip, Symbol};
pub use figure::Figure;
pub use maps::Map;
pub use page::{Page, Section, Table};
pub use ranges::Range;
pub use ranking::Ranked;
pub use ring_map::RingMap;
pub use series::{Mark, Series};
pub use small_multiples::Panel;
