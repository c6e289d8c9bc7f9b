//! The decisive picture of an effect: what is measured of it against its predicted signature, per unit of its amplitude.
//!
//! With `d` the change of the readings that the effect makes (at the amplitude `a`, in standard deviations of their noise) and `r` the
//! residuals of the same fit with the effect taken out, every reading is one point `(d/a, r)`, and the amplitude is the slope. Both are
//! shown in um, each number times the noise of its monitor; readings of one monitor at one setting are averaged, and averages in turn
//! where there are many.

use std::collections::BTreeMap;

use diagnosis::{Finding, Shown, capitalised};
use report::{Axes, Figure, Series};
use twin::median;

use super::partial::Partial;
use super::signed;

/// Share of the largest signature below which a setting tells nothing by itself.
const TELLS: f64 = 0.02;
/// Settings that are shown one by one, and groups of others.
const ONE_BY_ONE: usize = 80;
const GROUPS: usize = 17;
/// Noise, over that of most, from which on a point is left out where they are shown one by one.
const NOISY: f64 = 3.0;
/// Largest residual that is shown in um [um].
const LARGE: f64 = 3000.0;

/// A weighted mean of readings.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Point {
    /// Sums, by the inverse of the variance [1/um^2], of signature and residual [um], and of 1.
    signature: f64,
    residual: f64,
    weight: f64,
}

impl Point {
    fn x(self) -> f64 {
        self.signature / self.weight
    }

    fn y(self) -> f64 {
        self.residual / self.weight
    }

    fn sigma(self) -> f64 {
        self.weight.sqrt().recip()
    }

    fn plus(self, other: Self) -> Self {
        Self {
            signature: self.signature + other.signature,
            residual: self.residual + other.residual,
            weight: self.weight + other.weight,
        }
    }
}

/// How the amplitude of a finding is shown: value and error bar in steps of a round size, such as 0.001 /m.
struct Steps {
    value: f64,
    sigma: f64,
    name: String,
}

impl Steps {
    fn of(finding: &Finding) -> Self {
        let unit = finding.unit();
        let (value, sigma) = (finding.amplitude.0 * unit.factor, finding.amplitude.1 * unit.factor);
        let size = value.abs().max(f64::MIN_POSITIVE);
        let step = if (0.1..1000.0).contains(&size) { 1.0 } else { 10f64.powf(size.log10().floor()) };
        Self { value: value / step, sigma: sigma / step, name: format!("{step} {}", unit.shown).trim_end().to_owned() }
    }
}

/// The figure of a finding, of which `partial` is the fit without it.
pub fn figure(finding: &Finding, partial: &Partial) -> (String, Figure) {
    let is_switch = finding.term().is_some_and(|term| term.kind.is_switch());
    let steps = Steps::of(finding);
    let per = if is_switch { 1.0 } else { steps.value };
    let settings = of_settings(partial, per);
    let largest = settings.iter().map(|point| point.x().abs()).fold(0.0, f64::max);
    let telling: Vec<Point> = settings.iter().copied().filter(|point| point.x().abs() > TELLS * largest).collect();
    let one_by_one = telling.len() <= ONE_BY_ONE;
    let shown = if one_by_one { sharp(telling) } else { grouped(&settings, largest) };
    let (scale, unit) = match shown.iter().any(|point| point.y().abs() > LARGE) {
        true => (1e-3, "mm"),
        false => (1.0, "µm"),
    };
    let x: Vec<f64> = shown.iter().map(|point| point.x() * scale).collect();
    let y: Vec<f64> = shown.iter().map(|point| point.y() * scale).collect();
    let bars = shown.iter().map(|point| ((point.y() - point.sigma()) * scale, (point.y() + point.sigma()) * scale));
    let what = if one_by_one { "one monitor at one setting" } else { "the mean of many settings" };
    let points = Series::points(&format!("measured ± 1 σ: {what}"), x.clone(), y).within(bars.collect());
    let (slope, sigma) = if is_switch { (1.0, 0.0) } else { (steps.value, steps.sigma) };
    let line = line(&x, slope, sigma, finding, is_switch);
    let (title, x_label, note) = match is_switch {
        true => {
            let (fitted, error) = regression(&settings);
            let fitted = format!("{fitted:.3} ± {error:.3}");
            (
                format!("{}: slope {fitted} where 1 is expected", capitalised(&finding.phrase)),
                format!("predicted change of the reading [{unit}]"),
                format!(
                    "The effect has no amplitude; a slope of 1, here {fitted}, is the effect as it is in the library."
                ),
            )
        }
        false => (
            format!("{}: {:.1} standard deviations from zero", capitalised(&finding.phrase), significance(finding)),
            format!("predicted change of the reading per {} [{unit}]", steps.name),
            "The slope is the amplitude; its error band is that of the fit, in which all other unknowns adapt."
                .to_owned(),
        ),
    };
    let axes = Axes::new(&title, &x_label, &format!("measured less model without it [{unit}]"));
    let caption = format!(
        "Readings less the prediction of the model without this effect, everything else as fitted, against what the effect should do to them. \
         {note} Each point is {what}, about the monitor's baseline, its error bar the noise of the mean{}.",
        if one_by_one { "; monitors of three times the usual noise are left out" } else { "" }
    );
    (caption, Figure::lines(&axes, &[points, line]))
}

/// The figure of an unknown element, of which `partial` is the fit without it: what it leaves against what the fitted element does.
pub fn of_element(what: &str, partial: &Partial) -> (String, Figure) {
    let settings = of_settings(partial, 1.0);
    let (measured, [from, to]) = means(&settings, "measured ± 1 σ: the mean of many settings");
    let line = Series::line("fitted: slope 1", vec![from, to], vec![from, to]);
    let (slope, error) = regression(&settings);
    let title = format!("{}: slope {slope:.2} ± {error:.2}", capitalised(what));
    let axes =
        Axes::new(&title, "change of the reading by the fitted element [µm]", "measured less model without it [µm]");
    let caption = "Readings less the prediction of the model without the element, everything else as fitted, against what it does to them. Its strengths \
                   are fitted to the same readings and held small by their prior, so that the slope is somewhat above 1.";
    (caption.into(), Figure::lines(&axes, &[measured, line]))
}

/// Readings in um, weighted by their noise, against signatures in a unit that is `factor` to the metre.
fn points_of(shown: &[Shown], factor: f64) -> Vec<Point> {
    let point = |one: &Shown| {
        let weight = (one.sigma * 1e6).powi(-2);
        Point { signature: factor * one.predicted * weight, residual: 1e6 * one.measured * weight, weight }
    };
    shown.iter().map(point).collect()
}

/// The figure of a corrector that is unsteady: each frame against what the kick that suits it best should make of the readings.
pub fn of_each_frame(finding: &Finding, shown: &[Shown]) -> (String, Figure) {
    let (measured, [from, to]) = means(&points_of(shown, 1e6), "measured ± 1 σ: the mean of many readings");
    let line = Series::line("slope 1", vec![from, to], vec![from, to]);
    let (x_label, y_label) =
        ("change by the best kick of each frame [µm]", "reading less the mean of its setting [µm]");
    let caption = "Readings in which the corrector is on, less the mean of the frames of the same setting, against what one more kick of this corrector should \
                   make of them by its measured response; of each reading it is fitted to the other monitors of the frame. Were the corrector steady, no change would be larger than the noise makes it.";
    (caption.into(), Figure::lines(&Axes::new(&capitalised(&finding.phrase), x_label, y_label), &[measured, line]))
}

/// The figure of what passes within settings: first frames against the frames before the change.
pub fn of_first_frames(finding: &Finding, shown: &[Shown]) -> (String, Figure) {
    // the signature per percent of the share
    let points = points_of(shown, 1e4);
    let (measured, [from, to]) = means(&points, "measured ± 1 σ: the mean of many readings");
    let (slope, sigma) = match finding.term() {
        Some(_) => (100.0 * finding.amplitude.0, 100.0 * finding.amplitude.1),
        None => regression(&points),
    };
    let ends = vec![from, 0.0, to];
    let band = ends.iter().map(|x| (slope * x - sigma * x.abs(), slope * x + sigma * x.abs())).collect();
    let line = Series::line(
        &format!("slope: {} ± {sigma:.2} %", signed(slope, 2)),
        ends.clone(),
        ends.iter().map(|x| slope * x).collect(),
    )
    .within(band);
    let title = capitalised(&finding.phrase);
    let axes =
        Axes::new(&title, "predicted difference per 1 % [µm]", "first frame less the later ones of its setting [µm]");
    let caption = "The first reading after a change less the mean of the later readings of the same setting, against the difference that one \
                   percent of the cause should make, by the orbits as measured; the slope is its size.";
    (caption.into(), Figure::lines(&axes, &[measured, line]))
}

/// Means of points over equal steps of the signature, with their error bars, and the range of it that they and 0 span.
fn means(points: &[Point], label: &str) -> (Series, [f64; 2]) {
    let largest = points.iter().map(|point| point.x().abs()).fold(0.0, f64::max);
    let groups = grouped(points, largest);
    let (x, y): (Vec<f64>, Vec<f64>) = groups.iter().map(|point| (point.x(), point.y())).unzip();
    let bars = groups.iter().map(|point| (point.y() - point.sigma(), point.y() + point.sigma())).collect();
    (Series::points(label, x.clone(), y).within(bars), range(&x))
}

/// From the least to the largest of some numbers and 0.
fn range(x: &[f64]) -> [f64; 2] {
    x.iter().fold([0.0, 0.0], |[from, to]: [f64; 2], &x| [from.min(x), to.max(x)])
}

/// Name of a finding.
pub fn name(finding: &Finding) -> String {
    let word = finding.word().replace('_', " ");
    if finding.at.is_empty() { word } else { format!("{word} at {}", finding.at) }
}

/// Amplitude and error bar with the unit.
pub fn amplitude(finding: &Finding) -> String {
    let unit = finding.unit();
    let (value, sigma) = (finding.amplitude.0 * unit.factor, finding.amplitude.1 * unit.factor);
    let decimals = (1.0 - sigma.max(1e-9).log10().floor()).clamp(0.0, 7.0) as usize;
    format!("{} ± {sigma:.decimals$} {}", signed(value, decimals), unit.shown).trim_end().to_owned()
}

fn significance(finding: &Finding) -> f64 {
    (finding.amplitude.0 / finding.amplitude.1).abs()
}

/// The line through the origin, with its error band.
fn line(x: &[f64], slope: f64, sigma: f64, finding: &Finding, is_switch: bool) -> Series {
    let [from, to] = range(x);
    let x = vec![from, 0.0, to];
    let y: Vec<f64> = x.iter().map(|x| slope * x).collect();
    if is_switch {
        return Series::line("predicted: slope 1", x, y);
    }
    let band = x.iter().map(|x| (slope * x - sigma * x.abs(), slope * x + sigma * x.abs())).collect();
    Series::line(&format!("slope: {}", amplitude(finding)), x, y).within(band)
}

/// Means over the readings of each monitor at each setting, the signature per so many steps of the amplitude.
fn of_settings(partial: &Partial, per: f64) -> Vec<Point> {
    let data = partial.data;
    let settings = &data.settings;
    let mut all: BTreeMap<(usize, usize), Point> = BTreeMap::new();
    for (i, ((pool, monitor), noise)) in data.places().into_iter().zip(data.noise_of_means()).enumerate() {
        if monitor >= data.monitors() {
            continue;
        }
        // of one with variance 1 the number that it is the mean of, in um
        let weight = (noise * 1e6).powi(-2);
        let (signature, residual) = (partial.predicted[i] / per, partial.measured[i]);
        let point = Point { signature: signature * weight.sqrt(), residual: residual * weight.sqrt(), weight };
        let sum = all.entry((monitor, settings.of_frame[pool])).or_default();
        *sum = sum.plus(point);
    }
    all.into_values().collect()
}

/// Those that are not much noisier than most.
fn sharp(mut points: Vec<Point>) -> Vec<Point> {
    let median = median(points.iter().map(|point| point.sigma())).unwrap_or(f64::INFINITY);
    points.retain(|point| point.sigma() <= NOISY * median);
    points
}

/// Means over equal steps of the signature.
fn grouped(settings: &[Point], largest: f64) -> Vec<Point> {
    let mut groups = vec![Point::default(); GROUPS];
    for point in settings {
        let share = 0.5 + 0.5 * point.x() / largest.max(f64::MIN_POSITIVE);
        let group = &mut groups[((share * GROUPS as f64) as usize).min(GROUPS - 1)];
        *group = group.plus(*point);
    }
    groups.retain(|group| group.weight > 0.0);
    groups
}

/// Slope through the origin by least squares, and its standard deviation.
fn regression(points: &[Point]) -> (f64, f64) {
    let (top, bottom) = points.iter().fold((0.0, 0.0), |(top, bottom), point| {
        (top + point.weight * point.x() * point.y(), bottom + point.weight * point.x().powi(2))
    });
    (top / bottom, bottom.sqrt().recip())
}
