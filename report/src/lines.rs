//! Series on one pair of axes: lines with bands, points with error bars, probability densities.

use core::ops::Range;

use super::axes::{Axes, aired};
use super::canvas::{SMALL, draw, text_width};
use super::figure::Figure;
use super::legend::{Legend, Sample};
use super::numbers;
use super::plot::{BELOW, LEFT, Place, Plot, RIGHT, below, x_range};
use super::series::{Series, draw_all, spans};

/// Height of the plot [px].
const HEIGHT: f64 = 320.0;

impl Figure {
    /// Lines and points on common axes, each as its [`Series`] says.
    pub fn lines(axes: &Axes, series: &[Series]) -> Figure {
        let drawn: Vec<Series> = series.iter().map(|one| one.on(axes)).collect();
        let numbers = numbers::of_series(axes, series);
        let axes = &axes.drawn();
        let [x, y] = spans(drawn.iter(), axes).map(aired);
        let y = below_words(axes, y);
        Figure::drawn(numbers, |width| chart(axes, &drawn, [&x, &y], width))
    }

    /// Probability densities: curves on a common ground at zero, with a pale area below each.
    pub fn densities(axes: &Axes, curves: &[Series]) -> Figure {
        let grounded: Vec<_> = curves.iter().cloned().map(on_ground).collect();
        let [x, y] = spans(grounded.iter(), axes);
        let top = aired(y.clone()).end;
        let y = y.start..top;
        Figure::drawn(numbers::of_series(axes, curves), |width| chart(axes, &grounded, [&x, &y], width))
    }
}

/// The vertical range with room above the data for the words of the events: at most half of the height.
fn below_words(axes: &Axes, y: Range<f64>) -> Range<f64> {
    let longest = axes.events.iter().map(|(_, word)| text_width(word, SMALL) + 8.0).fold(0.0, f64::max);
    y.start..y.start + (y.end - y.start) / (1.0 - (longest / HEIGHT).min(0.5))
}

fn on_ground(curve: Series) -> Series {
    let band = curve.y.iter().map(|&density| (0.0, density)).collect();
    curve.within(band)
}

fn chart(axes: &Axes, series: &[Series], [x, y]: [&Range<f64>; 2], width: f64) -> String {
    let samples = series.iter().map(|one| (one.label.as_str(), Sample::Series(one.mark, one.band.is_some())));
    let legend = Legend::new(samples, width);
    let (top, bottom) = (legend.bottom(), legend.bottom() + HEIGHT);
    let place = Place { left: LEFT, top, right: width - RIGHT, bottom };
    let strip = axes.strip.as_ref().map_or(0.0, |strip| strip.height(width));
    draw(&axes.title, (width, bottom + below(&axes.x_names) + strip), |sheet| {
        legend.draw(sheet)?;
        let plot = Plot::new(sheet, place, x_range(&axes.x_names, x.clone()), y.clone());
        plot.surround(axes)?;
        axes.strip.as_ref().map_or(Ok(()), |strip| strip.draw(&plot, bottom + BELOW, width))?;
        draw_all(&plot, series)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Reference;

    fn series() -> Vec<Series> {
        let x: Vec<f64> = (0..30).map(f64::from).collect();
        let y = |slope: f64| x.iter().map(|x| slope * x).collect::<Vec<_>>();
        let band = y(2.0).iter().map(|y| (y - 1.0, y + 1.0)).collect();
        vec![Series::line("line", x.clone(), y(2.0)).within(band), Series::points("points", x.clone(), y(1.0))]
    }

    #[test]
    fn every_point_has_its_row_of_numbers() {
        let figure = Figure::lines(&Axes::new("t", "x", "y"), &series());
        assert_eq!(figure.csv.lines().count(), 1 + 2 * 30);
        assert!(figure.csv.contains("line,3.0,6.0,5.0,7.0"), "{}", figure.csv);
    }

    #[test]
    fn a_logarithmic_axis_has_the_numbers_themselves() {
        let decay = Series::line("decay", vec![0.0, 1.0, 2.0, 3.0], vec![2.0, 0.2, 0.02, 0.0]);
        let axes = Axes::new("t", "x", "error [mm]").logarithmic().compared(Reference::Level(0.05));
        let figure = Figure::lines(&axes, &[decay.within(vec![(1.0, 3.0), (0.1, 0.3), (0.0, 0.03), (0.0, 0.0)])]);
        assert!(figure.csv.contains("decay,1.0,0.2,0.1,0.3"), "{}", figure.csv);
        for number in ["0.02", "0.1", "2"] {
            assert!(figure.svg.contains(&format!(">\n{number}\n</text>")), "{number}");
        }
        assert!(!figure.svg.contains("NaN"));
    }

    #[test]
    fn names_and_labels_are_text_in_the_figure() {
        let names: Vec<String> = (0..30).map(|index| format!("A{index}")).collect();
        let axes = Axes::new("t", "magnet", "ratio [1]").named(&names).compared(Reference::Level(1.0));
        let svg = Figure::lines(&axes, &series()).svg;
        for text in names.iter().map(String::as_str).chain(["magnet", "ratio [1]", "line", "points"]) {
            assert!(svg.contains(&format!(">\n{text}\n</text>")), "{text}");
        }
    }

    #[test]
    fn an_event_is_a_line_with_its_word_and_none_beyond_the_axis() {
        let plain = Axes::new("t", "x", "y");
        let marked = plain.clone().marked(vec![(10.0, "step".into()), (99.0, "beyond".into())]);
        let [before, after] = [plain, marked].map(|axes| Figure::lines(&axes, &series()).svg);
        assert!(after.contains(">\nstep\n</text>") && !after.contains("beyond"), "{after}");
        assert!(after.matches("<polyline").count() > before.matches("<polyline").count());
    }

    #[test]
    fn a_missing_value_leaves_a_gap() {
        let gap = Series::line("gap", vec![0.0, 1.0, 2.0, 3.0, 4.0], vec![0.0, 1.0, f64::NAN, 1.0, 0.0]);
        let whole = Series::line("gap", gap.x.clone(), vec![0.0, 1.0, 1.0, 1.0, 0.0]);
        let paths = |series| Figure::lines(&Axes::default(), &[series]).svg.matches("<polyline").count();
        assert_eq!(paths(gap), paths(whole) + 1);
    }

    #[test]
    fn densities_stand_on_zero() {
        let curve = Series::line("curve", vec![0.0, 1.0, 2.0], vec![1.0, 3.0, 1.0]);
        let figure = Figure::densities(&Axes::new("t", "x", "density"), &[curve]);
        assert!(figure.svg.contains(">\n0.0\n</text>"), "{}", figure.svg);
        assert_eq!(figure.csv.lines().last(), Some("curve,2.0,1.0,,"));
    }
}
