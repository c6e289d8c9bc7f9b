//! Prior sensitivity: the same differences under priors of 1 % to 4 % and without a width.

use inference::{Readings, Width};
use report::{Axes, Band, Figure, Reference, Section};

use super::sampling::Sampling;
use super::subsets::Subsets;
use super::{Sampled, StudyError};

/// The published widths.
const WIDTHS: [(&str, Width); 5] = [
    ("1 %", Width::Lognormal(0.01)),
    ("2 %", Width::Lognormal(0.02)),
    ("3 %", Width::Lognormal(0.03)),
    ("4 %", Width::Lognormal(0.04)),
    ("loguniform", Width::Loguniform),
];

/// Posteriors that this study samples.
pub const RUNS: usize = WIDTHS.len();

/// A posterior under each prior, by the prior's word.
pub type ByWidth = Vec<(&'static str, Sampled)>;

/// Sample the first subset with the widest differences under every prior, or all frames where there are no pairs.
///
/// # Errors
/// [`StudyError`].
pub fn study(sampling: &mut Sampling, subsets: &Subsets) -> Result<(Section, ByWidth), StudyError> {
    let mut by_width = Vec::new();
    for (word, width) in WIDTHS {
        let readings = readings(sampling, subsets);
        by_width.push((word, sampling.sample(&format!("prior {word}"), readings, Some(width))?));
    }
    let names = sampling.names();
    let axes = Axes::new("Posterior under five priors: bars 68 %, lines 95 %", "quadrupole", "var [1]");
    let axes = axes.named(&names).compared(Reference::Level(1.0));
    let bands: Vec<Band> = by_width.iter().map(|(word, sampled)| sampled.band(word)).collect();
    let mean_width = |sampled: &Sampled| 100.0 * sampled.sigma().iter().sum::<f64>() / names.len() as f64;
    let widths: Vec<String> =
        by_width.iter().map(|(word, sampled)| format!("{:.2} % under {word}", mean_width(sampled))).collect();
    let section = Section {
        heading: "Sensitivity to the prior".into(),
        text: vec![format!(
            "Data: {}. Each lognormal has mean exactly 1 (ln var has mean -sigma²/2) before it ends at the bounds of the var's range; \
             loguniform is flat in ln var. Mean posterior standard deviation: {}.",
            data(subsets),
            widths.join(", ")
        )],
        figures: vec![("Each var under every prior.".into(), Figure::bands(&axes, &bands))],
        ..Section::default()
    };
    Ok((section, by_width))
}

fn readings(sampling: &Sampling, subsets: &Subsets) -> Readings {
    match subsets.first() {
        Some((subset, _)) => Readings::of_pairs(&sampling.reduced, |_| 0.0, &subset.pairs),
        None => Readings::of_frames(&sampling.reduced, &sampling.twin, inference::TuneUse::LeftOut),
    }
}

/// What is sampled under every prior, in words.
pub fn data(subsets: &Subsets) -> String {
    subsets
        .widest()
        .map_or_else(|| "all frames".into(), |kind| format!("one subset of differences {}", subsets.words(kind)))
}
