//! The probabilities of the causes: bars that add up to 1.

use diagnosis::{Alternative, Cause, Competition, Data, Diagnosis, Finding, capitalised, imitating};
use report::{Axes, Figure, Ranked, Section};

use super::location::short;
use super::slope::name;

/// Causes with a bar of their own.
const SHOWN: usize = 6;
/// Least probability of these.
const LEAST: f64 = 5e-4;
/// What the bars are of.
const GROUPS: [&str; 3] = ["effect of the library", "unmodelled discrepancy", "nothing"];

/// One figure for each finding, and one for what else may be missing.
pub fn section(diagnosis: &Diagnosis) -> Section {
    let found = &diagnosis.found;
    let mut figures = Vec::new();
    for finding in diagnosis.findings.iter().filter(|finding| finding.tested.is_some()) {
        if let Some(competition) = competition_of(diagnosis, finding) {
            let nothing = "no effect in its place";
            let title = format!("{} has probability {}", capitalised(&name(finding)), percent(finding.probability));
            let caption =
                format!("What explains the readings beside the other findings, if {} is taken out.", finding.label());
            figures.push((caption, figure(&found.data, competition, &title, nothing)));
        }
    }
    // what passes within settings is found before, and not in the data of the search
    let is_first = found.competitions.is_empty() && diagnosis.transients.is_empty();
    let (next, more) = (&found.next, if is_first { "" } else { " more" });
    let title = format!("Nothing{more} is missing with probability {}", percent(next.nothing));
    let caption = match is_first {
        true => "What is missing in the model without any effect.",
        false => "What is missing beside what was found.",
    };
    figures.push((caption.into(), figure(&found.data, next, &title, &format!("nothing{more}"))));
    Section {
        heading: "How probable each cause is".into(),
        text: vec![
            "The bars of a figure add up to 100 %: every effect of the library at every place, every unmodelled discrepancy, causes that no effect describes and that look like one or are \
             too small to be seen, and nothing. They are posterior probabilities, corrected for the number of candidates tried."
                .into(),
        ],
        figures,
        ..Section::default()
    }
}

/// The competition that a finding stands in.
pub fn competition_of<'d>(diagnosis: &'d Diagnosis, finding: &Finding) -> Option<&'d Competition> {
    let found = &diagnosis.found;
    let term = finding.term()?;
    let index = found.best.hypothesis.terms.iter().position(|one| one == term)?;
    found.competitions.get(index)
}

fn figure(data: &Data, competition: &Competition, title: &str, nothing: &str) -> Figure {
    let axes = Axes::new(title, "probability [%]", "");
    Figure::ranking(&axes, &GROUPS, &bars(data, competition, nothing))
}

/// The leading causes, the others together, and nothing [%].
fn bars(data: &Data, competition: &Competition, nothing: &str) -> Vec<Ranked> {
    let bar = |label: String, group: usize, p: f64| Ranked { label, group, value: 100.0 * p, threshold: None };
    let shown = competition.alternatives.iter().filter(|one| one.probability > LEAST).take(SHOWN);
    let mut bars: Vec<Ranked> =
        shown.map(|one| bar(label(data, one), usize::from(!one.is_of_library()), one.probability)).collect();
    let imitating = imitating(competition.library());
    if imitating > LEAST {
        bars.push(bar("unknown, and looks like an effect".into(), 1, imitating));
    }
    if competition.too_small > LEAST {
        bars.push(bar("unknown, and too small to be seen".into(), 1, competition.too_small));
    }
    let sum: f64 = bars.iter().map(|bar| bar.value).sum::<f64>() / 100.0;
    bars.push(bar("all others together, of both".into(), 0, (1.0 - sum - competition.nothing).max(0.0)));
    bars.push(bar(nothing.into(), 2, competition.nothing));
    bars
}

fn label(data: &Data, one: &Alternative) -> String {
    match &one.cause {
        Cause::Effect(term) => {
            format!("{} {}", term.kind.word().replace('_', " "), term.site.name(&data.ring)).trim_end().to_owned()
        }
        Cause::Unmodelled(discrepancy) => short(&discrepancy.at, data),
    }
}

fn percent(p: f64) -> String {
    if p > 0.9995 { "above 99.9 %".into() } else { format!("{:.1} %", 100.0 * p) }
}
