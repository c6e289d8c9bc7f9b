//! Prior sensitivity: the same differences under priors of 1 % to 4 % and without a width.

use super::subsets::{Kind, Subsets};
use super::{Bench, Sampled, StudyError};
use inference::posterior::Width;
use inference::readings::Readings;
use report::{Axes, Band, Figure, Reference, Section};

/// The paper's widths.
const WIDTHS: [(&str, Width); 5] = [
    ("1 %", Width::Lognormal(0.01)),
    ("2 %", Width::Lognormal(0.02)),
    ("3 %", Width::Lognormal(0.03)),
    ("4 %", Width::Lognormal(0.04)),
    ("loguniform", Width::Loguniform),
];

/// A posterior under each prior, by the prior's word.
pub type ByWidth = Vec<(&'static str, Sampled)>;

/// Sample the first subset of -22 to +22 A under every prior.
pub fn study(bench: &mut Bench, subsets: &Subsets) -> Result<(Section, ByWidth), StudyError> {
    let pairs = subsets.first(Kind::MinusToPlus).map_or(Vec::new(), |(subset, _)| subset.pairs.clone());
    let mut by_width = Vec::new();
    for (word, width) in WIDTHS {
        let readings = Readings::of_pairs(&bench.campaign, &bench.twin, &pairs);
        by_width.push((word, bench.sample(&format!("prior {word}"), readings, width)?));
    }
    let names = bench.names();
    let axes = Axes::new("Posterior under five priors: bars 68 %, lines 95 %", "quadrupole", "var [1]");
    let axes = axes.named(&names).compared(Reference::Level(1.0));
    let bands: Vec<Band> = by_width.iter().map(|(word, sampled)| sampled.band(word)).collect();
    let mean_width = |sampled: &Sampled| 100.0 * sampled.sigma().iter().sum::<f64>() / names.len() as f64;
    let widths: Vec<String> =
        by_width.iter().map(|(word, sampled)| format!("{:.2} % under {word}", mean_width(sampled))).collect();
    let section = Section {
        heading: "Sensitivity to the prior".into(),
        text: vec![format!(
            "One subset of -22 to +22 A. Each lognormal has mean exactly 1 (ln var has mean -sigma^2/2) before it ends at 0.94 and \
             1.06; loguniform is flat in ln var. Mean posterior standard deviation: {}.",
            widths.join(", ")
        )],
        figures: vec![("What the prior's width does to each var.".into(), Figure::bands(&axes, &bands))],
        ..Section::default()
    };
    Ok((section, by_width))
}
