//! The published studies, of any recording: each a figure and its numbers in one report.
//!
//! The reference is NUTS on the exact twin. Where the published kind of data is asked for, the readings are differences of one
//! initial and one final setting per corrector, chosen at random among the repeats ([`Subset`]). The likelihood is the published
//! one: orbits alone, measured tunes left out.

mod correlations;
mod laplace;
mod prediction;
mod prior;
mod published;
mod sampled;
mod sampling;
mod settings;
mod single;
mod subsets;
mod trimming;

use inference::LaplaceError;
use inference::nuts::{NutsError, NutsSettings};
use inference::simulate::VarsError;
use inference::{BatchError, Campaign, FittedTune, Readings, Recording, StreamError, Summary, TuneUse};
use report::Page;
use schemars::JsonSchema;
use serde::Serialize;
use twin::Ring;

pub use laplace::{Comparison, LaplaceRow};
pub use published::Beside;
pub use sampled::Sampled;
pub use sampling::RunNumbers;
use sampling::Sampling;
pub use settings::Kind;
pub use subsets::{Subset, Width, Widths};
pub use trimming::{Fault, faults};

/// What a study is made of.
#[derive(Debug, Clone, Copy)]
pub struct Options {
    /// How each posterior is sampled.
    pub nuts: NutsSettings,
}

/// Everything found, for a person and for a program.
#[derive(Debug)]
pub struct Study {
    /// The report.
    pub page: Page,
    /// Its numbers.
    pub numbers: Numbers,
}

/// The numbers of a study.
#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct Numbers {
    /// The recording.
    pub recording: String,
    /// Every posterior that was sampled.
    pub runs: Vec<RunNumbers>,
    /// The reference: all frames, twin.
    pub vars: Vec<VarNumbers>,
    /// Tunes of the fitted ring, whose fit leaves out the measured ones.
    pub tunes: [TuneNumbers; 2],
    /// Every subset of the data.
    pub subsets: Vec<SubsetNumbers>,
    /// Standard deviation of each var in each kind of subset, median over the subsets, and pooled.
    pub widths: Vec<Widths>,
    /// Laplace approximations beside the reference.
    pub laplace: Vec<Comparison>,
    /// Readings that the trimming finds at fault.
    pub faults: Vec<Fault>,
    /// Half widths beside the published ones, for the recording made with the published vars.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub published: Vec<Beside>,
}

/// One tune of the ring at the MAP, and as measured.
#[derive(Debug, Clone, Copy, Serialize, JsonSchema)]
pub struct TuneNumbers {
    /// Plane, `x` or `y`.
    pub plane: &'static str,
    /// Of the fitted ring.
    pub model: f64,
    /// Mean of what was measured and its standard deviation; none without a tune meter.
    pub measured: Option<[f64; 2]>,
}

/// One subset of the data.
#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct SubsetNumbers {
    /// The settings.
    pub kind: String,
    /// Frame pairs in it.
    pub pairs: usize,
    /// Each var.
    pub vars: Vec<VarNumbers>,
}

/// One var of a posterior.
#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct VarNumbers {
    /// Name.
    pub name: String,
    /// Mean.
    pub mean: f64,
    /// Standard deviation.
    pub sigma: f64,
    /// Quantiles.
    pub q025: f64,
    /// Quantiles.
    pub q16: f64,
    /// Quantiles.
    pub q84: f64,
    /// Quantiles.
    pub q975: f64,
}

/// Why there is no study.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StudyError {
    /// Frames at several times in the cycle: the differences that are studied are of frames with one baseline.
    #[error("expected frames at one time in the cycle, found {0}")]
    Times(String),
    /// There is no batch fit.
    #[error(transparent)]
    Fit(#[from] BatchError),
    /// A posterior has no Laplace approximation.
    #[error("{run}: {source}")]
    Laplace {
        /// Which posterior.
        run: String,
        /// Why.
        source: LaplaceError,
    },
    /// A posterior could not be sampled.
    #[error("{run}: {source}")]
    Nuts {
        /// Which posterior.
        run: String,
        /// Why.
        source: NutsError,
    },
    /// The ring at a point has no closed orbit.
    #[error(transparent)]
    Orbit(#[from] twin::OrbitError),
    /// The prior has no rings to predict with.
    #[error(transparent)]
    Vars(#[from] VarsError),
    /// The core refuses the recording.
    #[error(transparent)]
    Stream(#[from] StreamError),
}

/// Make all studies of a recording that it has the data for; `progress` hears the name of each posterior, and how many draws of
/// how many are done.
///
/// # Errors
/// [`StudyError`].
pub fn run(
    ring: &Ring,
    recording: &Recording,
    options: Options,
    progress: &mut dyn FnMut(&str, usize, usize),
) -> Result<Study, StudyError> {
    let mut sampling = Sampling::new(ring, recording, options.nuts, progress)?;
    let drawn = subsets::drawn(sampling.campaign());
    let beside = if published::is_published(ring, recording) { published::DRAWN.to_vec() } else { Vec::new() };
    // all frames, the subsets, the priors, and the simulated readings
    let posteriors = drawn.iter().chain(&beside).map(|(_, times)| times).sum::<usize>();
    sampling.plan(1 + posteriors + prior::RUNS + 1);
    let frames = Readings::of_frames(&sampling.reduced, &sampling.twin, TuneUse::LeftOut);
    let reference = sampling.sample("all frames", frames, None)?;
    let var = farthest(&reference);
    let subsets = subsets::sample(&mut sampling, &drawn, |_| 0.0)?;
    let (sensitivity, by_width) = prior::study(&mut sampling, &subsets)?;
    let single = single::study(&sampling, &subsets, &by_width, var);
    let correlations = correlations::study(&mut sampling, &reference, var)?;
    let prediction = prediction::study(&mut sampling, &subsets)?;
    let (approximations, laplace) = laplace::study(&sampling, &reference)?;
    let (trimming, faults) = trimming::study(&sampling)?;
    let names = sampling.names();
    let beside = subsets::sample(&mut sampling, &beside, published::error(ring))?;
    let published = published::beside(&beside);
    let stability = (!drawn.is_empty()).then(|| subsets.stability(&names));
    let beside = (!published.is_empty()).then(|| published::section(&beside, &published));
    let first = [Some(subsets::final_table(&sampling, &subsets, &reference)), beside, Some(sensitivity), Some(single)];
    let then = [stability, Some(correlations), prediction, Some(approximations), Some(trimming)];
    let sections = first.into_iter().chain(then).flatten().chain([sampling::section(&sampling.runs)]).collect();
    let title = format!("Quadrupole strengths from {}", recording.name);
    let page = Page { title, lead: lead(&sampling, &subsets, &reference), sections };
    let numbers = Numbers {
        recording: recording.name.clone(),
        vars: reference.summary.iter().map(VarNumbers::of).collect(),
        tunes: tune_numbers(&sampling.reduced.fit.tunes),
        subsets: subsets.numbers(),
        widths: subsets.widths(&names),
        runs: sampling.runs,
        laplace,
        faults,
        published,
    };
    Ok(Study { page, numbers })
}

/// The differences that a campaign holds, in words: what its studies of single pairs are made of.
pub fn differences(campaign: &Campaign) -> Vec<String> {
    let settings = settings::Settings::of(&campaign.recording, campaign.ring.correctors.len());
    subsets::drawn(campaign).into_iter().map(|(kind, _)| settings.words(kind)).collect()
}

/// The var that is farthest from its design, in its error bars.
fn farthest(reference: &Sampled) -> usize {
    let away = |s: &Summary| (s.mean - 1.0).abs() / s.sd;
    let each = reference.summary.iter().map(away).enumerate();
    each.max_by(|one, other| one.1.total_cmp(&other.1)).map_or(0, |(var, _)| var)
}

/// The result in a few sentences.
fn lead(sampling: &Sampling, subsets: &subsets::Subsets, reference: &Sampled) -> String {
    let campaign = sampling.campaign();
    let furthest = reference.summary.get(farthest(reference));
    let furthest = furthest
        .map_or(String::new(), |s| format!("{} is furthest from its design, {:.4} ± {:.4}. ", s.name, s.mean, s.sd));
    let data = subsets.widest().map_or_else(
        || "The recording holds no pairs of settings of single correctors, so that studies of differences are left out. ".into(),
        |_| format!("Correctors were set to at most {}. ", subsets.settings.strongest()),
    );
    format!(
        "{}: full NUTS on the exact twin, all {} frames, every baseline unknown, measured tunes left out. Mean standard deviation: {}. \
         {furthest}{data}Chi-square per degree of freedom is {:.3}. {}",
        campaign.ring.name,
        campaign.frames(),
        widths(&campaign.ring, reference),
        sampling.reduced.fit.chi2_per_dof,
        tunes(&sampling.reduced.fit.tunes),
    )
}

fn tune_numbers(tunes: &[FittedTune; 2]) -> [TuneNumbers; 2] {
    let one = |plane, tune: &FittedTune| TuneNumbers {
        plane,
        model: tune.model,
        measured: tune.measured.map(|(mean, sigma)| [mean, sigma]),
    };
    [one("x", &tunes[0]), one("y", &tunes[1])]
}

/// Tunes of the fitted ring beside the measured ones.
fn tunes(tunes: &[FittedTune; 2]) -> String {
    let one = |tune: TuneNumbers| {
        let measured = tune
            .measured
            .map_or_else(|| "not measured".into(), |[mean, sigma]| format!("measured {mean:.4} ± {sigma:.4}"));
        format!("Q{} {:.4} ({measured})", tune.plane, tune.model)
    };
    format!("Tunes of the fitted ring: {}.", tune_numbers(tunes).map(one).join(", "))
}

/// Mean standard deviation of the focusing and of the defocusing vars, which come after them.
fn widths(ring: &Ring, reference: &Sampled) -> String {
    let [focusing, others] = ring.params_by_focusing();
    let mean = |of: &[usize]| 100.0 * of.iter().map(|i| reference.summary[*i].sd).sum::<f64>() / of.len() as f64;
    let each = [("horizontally focusing quadrupoles", focusing), ("vertically focusing ones", others)];
    let words = each.iter().filter(|(_, of)| !of.is_empty()).map(|(name, of)| format!("{name} {:.2} %", mean(of)));
    words.collect::<Vec<_>>().join(", ")
}

impl VarNumbers {
    fn of(summary: &Summary) -> Self {
        let Summary { name, mean, sd, q025, q16, q84, q975, .. } = summary.clone();
        Self { name, mean, sigma: sd, q025, q16, q84, q975 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Only `paper-vars` is of the published campaign; any other recording is described by its own settings and vars.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes unoptimised; the release tests run it")]
    fn a_study_describes_its_own_recording() {
        let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/ten-cells");
        let ring = Ring::read(&folder.join("ring.json")).unwrap();
        let recording = Recording::read(&folder.join("plain"), &ring).unwrap();
        let options = Options { nuts: NutsSettings { chains: 2, warm_up: 50, draws: 50, seed: 1 } };
        let (mut last, mut totals) = ((0, 0), Vec::new());
        let mut progress = |_: &str, done, total| {
            last = (done, total);
            totals.push(total);
        };
        let Study { page, numbers } = run(&ring, &recording, options, &mut progress).unwrap();
        let text: Vec<&String> =
            page.sections.iter().flat_map(|s| core::iter::once(&s.heading).chain(&s.text)).collect();
        let captions = page.sections.iter().flat_map(|s| s.figures.iter().map(|(caption, _)| caption));
        let tables = page.sections.iter().flat_map(|s| &s.tables).flat_map(|t| t.header.iter().chain([&t.caption]));
        for text in text.into_iter().chain(captions).chain(tables).chain([&page.lead]) {
            for foreign in ["22 A", "published", "D8", "paper"] {
                assert!(!text.contains(foreign), "{foreign}: {text}");
            }
        }
        assert!(numbers.published.is_empty());
        let kinds: Vec<&str> = numbers.widths.iter().map(|widths| widths.kind.as_str()).collect();
        assert_eq!(kinds, ["0 to ±2 A", "0 to +2 A", "0 to -2 A", "-2 A to +2 A"]);
        assert_eq!(last.0, last.1, "progress ends at the whole");
        totals.retain(|total| *total > 1);
        assert!(totals.iter().all(|total| *total == last.1), "the whole is known from the start");
    }
}
