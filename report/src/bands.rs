//! Intervals of named quantities: a marker, the inner interval thick, the outer one thin, groups side by side.

use super::axes::{Axes, aired, slots, span};
use super::canvas::{Drawn, draw};
use super::figure::Figure;
use super::legend::{Legend, Sample};
use super::numbers::{csv, number};
use super::pen::Pen;
use super::plot::{LEFT, Place, Plot, RIGHT, below};

/// Space for a name with several groups [px], 24 to a row of a page; more of them take further rows of panels.
const NAME: f64 = 33.8;
/// Height of one row's axes [px].
const HEIGHT: f64 = 260.0;
/// Space between two rows [px].
const GAP: f64 = 12.0;
/// Share of a name's slot that its groups may spread over.
const SPREAD: f64 = 0.78;
/// Distance between groups at most [px]: what belongs to a name stays together.
const APART: f64 = 14.0;

/// One group of intervals, an entry for each name.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Band {
    /// What it is, for the legend.
    pub label: String,
    /// Most probable or mean values.
    pub centre: Vec<f64>,
    /// Thick bar, usually 68 %.
    pub inner: Vec<(f64, f64)>,
    /// Thin bar, usually 95 %.
    pub outer: Vec<(f64, f64)>,
}

impl Figure {
    /// Intervals over the names of the horizontal axis, at most 24 names (9 on a phone) in a row of panels with a common scale.
    ///
    /// # Panics
    /// When a group has not one entry for each name.
    pub fn bands(axes: &Axes, groups: &[Band]) -> Figure {
        for group in groups {
            let lengths = [group.centre.len(), group.inner.len(), group.outer.len()];
            assert_eq!(lengths, [axes.x_names.len(); 3], "one entry of {} for each name", group.label);
        }
        Figure::drawn(numbers(axes, groups), |width| panels(axes, groups, width))
    }
}

fn panels(axes: &Axes, groups: &[Band], width: f64) -> String {
    let legend = Legend::new(groups.iter().map(|group| (group.label.as_str(), Sample::Bands)), width);
    let per_row = names_a_row(axes.x_names.len(), width);
    let rows: Vec<&[String]> = axes.x_names.chunks(per_row).collect();
    let (first, row_height) = (legend.bottom(), HEIGHT + below(&axes.x_names) + GAP);
    draw(&axes.title, (width, first + rows.len() as f64 * row_height - GAP), |sheet| {
        legend.draw(sheet)?;
        rows.iter().enumerate().try_for_each(|(row, names)| {
            let top = first + row as f64 * row_height;
            let place = Place { left: LEFT, top, right: width - RIGHT, bottom: top + HEIGHT };
            let plot = Plot::new(sheet, place, slots(names.len()), aired(scale(axes, groups)));
            plot.surround(&axes.clone().named(names))?;
            panel(&plot, row * per_row, (names.len(), place.right - place.left), groups)
        })
    })
}

/// Rows as few as possible, and equally long.
fn names_a_row(names: usize, width: f64) -> usize {
    let most = ((width - LEFT - RIGHT) / NAME) as usize;
    names.div_ceil(names.div_ceil(most).max(1)).max(1)
}

/// Range of everything that is drawn.
fn scale(axes: &Axes, groups: &[Band]) -> core::ops::Range<f64> {
    let bounds =
        groups.iter().flat_map(|group| group.inner.iter().chain(&group.outer)).flat_map(|&(low, high)| [low, high]);
    span(groups.iter().flat_map(|group| group.centre.iter().copied()).chain(bounds).chain(axes.level()))
}

/// The intervals of `count` names from number `first` on, in axes of a width [px].
fn panel(plot: &Plot, first: usize, (count, width): (usize, f64), groups: &[Band]) -> Drawn {
    let slot = width / count as f64;
    let apart = (SPREAD / groups.len() as f64).min(APART / slot);
    groups.iter().enumerate().try_for_each(|(index, group)| {
        let offset = apart * (index as f64 - (groups.len() as f64 - 1.0) / 2.0);
        (0..count).try_for_each(|slot| interval(plot, Pen::nth(index), slot as f64 + offset, group, first + slot))
    })
}

fn interval(plot: &Plot, pen: Pen, x: f64, group: &Band, entry: usize) -> Drawn {
    let bar = |(low, high): (f64, f64)| {
        let finite = low.is_finite() && high.is_finite();
        finite.then(|| [plot.spot(x, low), plot.spot(x, high)])
    };
    bar(group.outer[entry]).map_or(Ok(()), |ends| pen.bar(plot.sheet, ends, 1.2))?;
    bar(group.inner[entry]).map_or(Ok(()), |ends| pen.pale_bar(plot.sheet, ends, 4.5))?;
    let centre = group.centre[entry];
    if centre.is_finite() { pen.mark(plot.sheet, plot.spot(x, centre)) } else { Ok(()) }
}

fn numbers(axes: &Axes, groups: &[Band]) -> String {
    let rows = groups.iter().flat_map(|group| {
        axes.x_names.iter().enumerate().map(|(entry, name)| {
            let (inner, outer) = (group.inner[entry], group.outer[entry]);
            let [centre, a, b, c, d] = [group.centre[entry], inner.0, inner.1, outer.0, outer.1].map(number);
            [group.label.clone(), name.clone(), centre, a, b, c, d]
        })
    });
    csv(["group", "name", "centre", "inner_low", "inner_high", "outer_low", "outer_high"], rows)
}

#[cfg(test)]
mod tests {
    use super::super::canvas::WIDTH;
    use super::*;

    fn group(label: &str, names: usize) -> Band {
        let bars = |half: f64| vec![(1.0 - half, 1.0 + half); names];
        Band { label: label.into(), centre: vec![1.0; names], inner: bars(0.1), outer: bars(0.2) }
    }

    fn figure(names: usize) -> Figure {
        let names: Vec<String> = (0..names).map(|index| format!("M{index}")).collect();
        let axes = Axes::new("t", "magnet", "ratio [1]").named(&names);
        Figure::bands(&axes, &[group("before", names.len()), group("after", names.len())])
    }

    #[test]
    fn every_interval_has_its_row_of_numbers() {
        let csv = figure(48).csv;
        assert_eq!(csv.lines().count(), 1 + 2 * 48);
        assert_eq!(csv.lines().last(), Some("after,M47,1.0,0.9,1.1,0.8,1.2"));
    }

    #[test]
    fn every_name_stands_below_its_panel() {
        let svg = figure(48).svg;
        assert!((0..48).all(|name| svg.contains(&format!(">\nM{name}\n</text>"))));
    }

    #[test]
    fn more_names_than_fit_take_another_row() {
        assert_eq!(figure(24).svg.matches("magnet").count(), 1);
        assert_eq!(figure(25).svg.matches("magnet").count(), 2);
        assert_eq!([24, 25, 48, 60].map(|names| names_a_row(names, WIDTH)), [24, 13, 24, 20]);
    }
}
