//! Place scans of normal and skew gradients.

use diagnosis::{Diagnosis, Finding, FitError, Interval, PlaceScan, Verdict};
use report::{Axes, Figure, Reference, Section, Series};
use twin::{Element, Ring, Thin};

use super::lattice::{STRIP, strip};
use super::signed;

/// Share of the posterior that an interval holds.
const SHARE: f64 = 0.95;
/// Most stretches that are listed one by one.
const STRETCHES: usize = 4;
/// Density, relative to the peak, below which it is not shown, and the margin on both sides [m].
const NEGLIGIBLE: f64 = 1e-3;
const AROUND: f64 = 2.5;

/// The scans for normal and skew gradients, where a cause acts like one or is not known.
pub fn section(diagnosis: &Diagnosis) -> Result<Option<Section>, FitError> {
    let mut section = Section {
        heading: "Place scan".into(),
        text: vec![
            "ln Bayes factor of one thin gradient at every place of the ring, given all other findings, vars adapting, to first \
             order, with the widths of what is ordinary as in that fit: it exceeds the gain of the table where ordinary imperfections would grow without the effect. Below zero the readings disfavour a gradient there; a flat curve means that they contain no information on it. The credible interval has a \
             prior uniform along the beam, and assumes one thin gradient in a model that is otherwise correct."
                .into(),
        ],
        ..Section::default()
    };
    let found = &diagnosis.found;
    for (kind, word, symbol) in [(Thin::Normal, "normal", "K1L"), (Thin::Skew, "skew", "K1sL")] {
        let terms = &found.best.hypothesis.terms;
        let own = terms.iter().position(|term| term.kind.thin() == Some(kind));
        let scan = PlaceScan::from_fit(&found.data, &found.best, own, kind)?;
        let acts = |one: &Finding| one.term().is_some_and(|term| term.kind.thin() == Some(kind));
        let asked = diagnosis.findings.iter().any(|one| acts(one) || one.alternatives.iter().any(acts));
        if !asked && diagnosis.verdict != Verdict::Unexplained {
            continue;
        }
        let settled = matches!(diagnosis.verdict, Verdict::Identified | Verdict::Ambiguous);
        let interval = own.filter(|_| settled).map(|_| scan.credible(SHARE));
        if let (Some(own), Some(interval)) = (own, &interval) {
            section.text.push(stated(&scan, interval, word, symbol, &terms[own].label(&found.data.ring)));
        }
        section.figures.push(figure(diagnosis, &scan, word));
        if let Some(interval) = &interval {
            section.figures.push(density(diagnosis, &scan, interval, word));
        }
    }
    Ok(Some(section).filter(|section| !section.figures.is_empty()))
}

fn stated(scan: &PlaceScan, interval: &[Interval], word: &str, symbol: &str, label: &str) -> String {
    let peak = scan.segments[scan.peak()];
    let list = if interval.len() > STRETCHES {
        let whole: f64 = interval.iter().map(|one| (one.to_m - one.from_m).max(0.0)).sum();
        format!("{} stretches of the ring, {whole:.0} m in all", interval.len())
    } else {
        let of = |one: &Interval| format!("{:.2} to {:.2} m", one.from_m, one.to_m);
        interval.iter().map(of).collect::<Vec<_>>().join(" or ")
    };
    format!(
        "In place of {label}, a thin {word} gradient is most likely at s = {:.2} m, with {symbol} = {} /m; 95 % credible interval of its \
         place: {}.",
        peak.s,
        signed(peak.amplitude, 4),
        list
    )
}

fn figure(diagnosis: &Diagnosis, scan: &PlaceScan, word: &str) -> (String, Figure) {
    let s: Vec<f64> = scan.segments.iter().map(|segment| segment.s).collect();
    let log_bayes = scan.segments.iter().map(|segment| segment.log_bayes).collect();
    let mut series = vec![Series::line(&format!("thin {word} gradient"), s.clone(), log_bayes)];
    let height = |at: f64| {
        let nearest = (0..s.len()).min_by(|&i, &j| (s[i] - at).abs().total_cmp(&(s[j] - at).abs()));
        nearest.map_or(f64::NAN, |i| scan.segments[i].log_bayes)
    };
    let acts_alike = |one: &Finding| one.term().is_some_and(|term| term.kind.thin() == Some(scan.kind));
    let marks = diagnosis.findings.iter().flat_map(|finding| {
        core::iter::once((finding, true)).chain(finding.alternatives.iter().map(|other| (other, false)))
    });
    let (mut first, mut others) = (Vec::new(), Vec::new());
    for (one, leads) in marks.filter(|(one, _)| acts_alike(one)) {
        if let Some(at) = one.s {
            if leads { &mut first } else { &mut others }.push((at, height(at)));
        }
    }
    for (label, points) in [("finding", first), ("alternative", others)] {
        if !points.is_empty() {
            let (x, y) = points.into_iter().unzip();
            series.push(Series::points(label, x, y));
        }
    }
    let peak = scan.segments[scan.peak()];
    let (best, at) = (peak.log_bayes, peak.s);
    let title = match best > 0.0 {
        true => format!("A thin {word} gradient gains most at s = {at:.1} m: {best:.0} nat"),
        false => format!("A thin {word} gradient gains nothing anywhere"),
    };
    let axes = Axes::new(&title, "s [m]", "ln Bayes factor [nat]").compared(Reference::Level(0.0));
    let axes = axes.along(strip(diagnosis));
    let caption = format!(
        "ln Bayes factor of a thin {word} gradient against none, over its place; largest at s = {:.2} m, near {}{}. {STRIP}",
        at,
        nearest(&diagnosis.found.data.ring, at),
        if series.len() > 1 {
            "; markers are findings and alternatives that act like one, at the height of the curve"
        } else {
            ""
        }
    );
    (caption, Figure::lines(&axes, &series))
}

/// The named element whose middle is nearest.
fn nearest(ring: &Ring, s: f64) -> &str {
    let away = |element: &&Element| (element.s + 0.5 * element.length - s).abs();
    let named = ring.elements.iter().filter(|element| !element.name.is_empty());
    named.min_by(|one, other| away(one).total_cmp(&away(other))).map_or("", |element| &element.name)
}

/// The posterior of the place near its peak: all of it, and the part within the interval.
fn density(diagnosis: &Diagnosis, scan: &PlaceScan, interval: &[Interval], word: &str) -> (String, Figure) {
    let (peak, circumference) = (scan.segments[scan.peak()], diagnosis.found.data.ring.circumference);
    let (middle, largest) = (peak.s, peak.log_bayes);
    let weight = |i: usize| (scan.segments[i].log_bayes - largest).exp();
    let sum: f64 = (0..scan.segments.len()).map(|i| weight(i) * scan.segments[i].length).sum();
    // s relative to the peak, since the interval may cross the start of the ring
    let s = |i: usize| scan.segments[i].s - circumference * ((scan.segments[i].s - middle) / circumference).round();
    let mut order: Vec<usize> = (0..scan.segments.len()).collect();
    order.sort_by(|&i, &j| s(i).total_cmp(&s(j)));
    let counts = |i: &&usize| weight(**i) > NEGLIGIBLE;
    let (from, to) = (order.iter().find(counts), order.iter().rev().find(counts));
    let range = from.map_or(middle, |&i| s(i) - AROUND)..=to.map_or(middle, |&i| s(i) + AROUND);
    order.retain(|&i| range.contains(&s(i)));
    let inside = |at: f64| {
        interval.iter().any(|one| match one.from_m <= one.to_m {
            true => (one.from_m..=one.to_m).contains(&at),
            false => at >= one.from_m || at <= one.to_m,
        })
    };
    let x: Vec<f64> = order.iter().map(|&i| s(i)).collect();
    let all: Vec<f64> = order.iter().map(|&i| weight(i) / sum).collect();
    let held = order.iter().zip(&all).map(|(&i, &y)| if inside(scan.segments[i].s) { y } else { f64::NAN }).collect();
    let series = [Series::line("posterior", x.clone(), all), Series::line("95 % credible interval", x, held)];
    let title = format!("The thin {word} gradient is most likely at s = {middle:.2} m");
    let axes = Axes::new(&title, "s [m]", "density of the place [1/m]").along(strip(diagnosis));
    let caption = format!(
        "The same, near its peak, as a probability density of the place of a thin {word} gradient, prior uniform along the ring. {STRIP}"
    );
    (caption, Figure::densities(&axes, &series))
}
