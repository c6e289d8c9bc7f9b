//! Where along the beam a gradient would sit.

use twin::{EffectError, EffectKind};

use super::super::along::{Along, Interval, thin};
use super::super::{Diagnosis, Verdict};
use crate::report::{Axes, Figure, Section, Series};

/// Share of the posterior that an interval holds.
const SHARE: f64 = 0.95;

/// The scans for normal and skew gradients.
pub fn section(diagnosis: &Diagnosis) -> Result<Section, EffectError> {
    let mut section = Section {
        heading: "The scan along the ring".into(),
        text: vec![
            "ln Bayes factor of one thin gradient at every place of the ring, given all other findings, vars adapting, to first \
             order. Below zero the readings speak against a gradient there; a flat curve means that they cannot tell. The credible interval has a \
             prior uniform along the beam, and assumes one thin gradient in a model that is otherwise true."
                .into(),
        ],
        ..Section::default()
    };
    let found = &diagnosis.found;
    for (kind, word, symbol) in
        [(EffectKind::StrayGradient, "normal", "K1L"), (EffectKind::StraySkewGradient, "skew", "K1sL")]
    {
        let terms = &found.best.hypothesis.terms;
        let own = terms.iter().position(|term| thin(term.kind) == Some(kind));
        let along = Along::of(&found.data, &found.best, own, kind)?;
        let settled = matches!(diagnosis.verdict, Verdict::Identified | Verdict::Ambiguous);
        let interval = own.filter(|_| settled).map(|_| along.credible(SHARE));
        if let (Some(own), Some(interval)) = (own, &interval) {
            section.text.push(stated(&along, interval, word, symbol, &terms[own].label()));
        }
        section.figures.push(figure(diagnosis, &along, interval.as_deref(), word));
    }
    Ok(section)
}

fn stated(along: &Along, interval: &[Interval], word: &str, symbol: &str, label: &str) -> String {
    let peak = along.peak();
    let list: Vec<String> = interval.iter().map(|one| format!("{:.2} to {:.2} m", one.from_m, one.to_m)).collect();
    format!(
        "In place of {label}, a thin {word} gradient is most likely at s = {:.2} m, with {symbol} = {:.4} /m; 95 % credible interval of its \
         place: {}.",
        along.cells[peak].s,
        along.amplitude[peak],
        list.join(" or ")
    )
}

fn figure(diagnosis: &Diagnosis, along: &Along, interval: Option<&[Interval]>, word: &str) -> (String, Figure) {
    let s: Vec<f64> = along.cells.iter().map(|cell| cell.s).collect();
    let mut series = vec![Series::line(&format!("thin {word} gradient"), s.clone(), along.log_bayes.clone())];
    let height = |at: f64| {
        let nearest = (0..s.len()).min_by(|&i, &j| (s[i] - at).abs().total_cmp(&(s[j] - at).abs()));
        nearest.map_or(f64::NAN, |i| along.log_bayes[i])
    };
    let of_kind = |kind: &str| EffectKind::ALL.iter().any(|one| one.word() == kind && thin(*one) == Some(along.kind));
    let marks = diagnosis.findings.iter().flat_map(|finding| {
        core::iter::once((finding, true)).chain(finding.alternatives.iter().map(|other| (other, false)))
    });
    let (mut first, mut others) = (Vec::new(), Vec::new());
    for (one, leads) in marks.filter(|(one, _)| of_kind(one.kind)) {
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
    if let Some(interval) = interval {
        series.push(bar(along, interval));
    }
    let title = format!("A thin {word} gradient along the ring");
    let axes = Axes::new(&title, "s [m]", "ln Bayes factor [nat]").compared(crate::report::Reference::Level(0.0));
    let caption = format!(
        "ln Bayes factor of a thin {word} gradient against none, over its place; markers are the findings and alternatives that act as \
         one, at the height of the curve{}.",
        if interval.is_some() { "; the bar above the peak is the 95 % credible interval" } else { "" }
    );
    (caption, Figure::lines(&axes, &series))
}

/// The interval as a bar above the peak.
fn bar(along: &Along, interval: &[Interval]) -> Series {
    let end = along.cells.last().map_or(0.0, |cell| cell.s + 0.5 * cell.length);
    let lowest = along.log_bayes.iter().copied().fold(f64::INFINITY, f64::min);
    let peak = along.log_bayes[along.peak()];
    let level = peak + 0.06 * (peak - lowest).max(1.0);
    let (mut x, mut y) = (Vec::new(), Vec::new());
    let mut piece = |from: f64, to: f64| {
        x.extend([from, to, to]);
        y.extend([level, level, f64::NAN]);
    };
    for one in interval {
        if one.from_m < one.to_m {
            piece(one.from_m, one.to_m);
        } else {
            piece(one.from_m, end);
            piece(0.0, one.to_m);
        }
    }
    Series::line("95 % credible interval", x, y)
}
