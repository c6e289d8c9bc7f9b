//! The paper's studies of one recording, each a figure and its numbers in one report.
//!
//! The reference is NUTS on the exact twin. Where the paper's data are asked for, the readings are differences of one initial
//! and one final setting per corrector, chosen at random among the repeats ([`Subset`]).

mod correlations;
mod laplace;
mod prediction;
mod prior;
mod sampled;
mod single;
mod subsets;
mod trimming;

use std::sync::Arc;

use serde::Serialize;
use twin::Ring;

use inference::model::ResponseModel;
use inference::nuts::{self, NutsError, NutsSettings};
use inference::posterior::{LaplaceError, Posterior, Width};
use inference::readings::{Campaign, Readings, ReadingsError};
use inference::recording::Recording;
use inference::simulate;
use inference::stream::StreamError;
use report::{Page, Section};

pub use laplace::{Comparison, LaplaceRow};
pub use sampled::Sampled;
pub use subsets::{Kind, Subset};
pub use trimming::{Fault, faults};

/// Width of the prior where nothing else is said, the paper's.
const WIDTH: Width = Width::Lognormal(0.03);

/// The var that the paper looks at by itself.
const SINGLE: &str = "D8";

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
#[derive(Debug, Clone, Serialize)]
pub struct Numbers {
    /// The recording.
    pub recording: String,
    /// Every posterior that was sampled.
    pub runs: Vec<RunNumbers>,
    /// The reference: all frames, twin.
    pub vars: Vec<VarNumbers>,
    /// Every subset of the data.
    pub subsets: Vec<SubsetNumbers>,
    /// Standard deviation of each var in each kind of subset, median over the subsets, and pooled.
    pub widths: Vec<subsets::Widths>,
    /// Laplace approximations beside the reference.
    pub laplace: Vec<Comparison>,
    /// Readings that the trimming finds at fault.
    pub faults: Vec<Fault>,
}

/// One sampled posterior.
#[derive(Debug, Clone, Serialize)]
pub struct RunNumbers {
    /// What it was.
    pub name: String,
    /// Largest R-hat of a var.
    pub rhat_max: f64,
    /// Smallest bulk or tail effective sample size of a var.
    pub ess_min: f64,
    /// Divergent draws.
    pub divergences: usize,
    /// Draws of all chains.
    pub draws: usize,
    /// Wall-clock time [s].
    pub seconds: f64,
}

/// One subset of the data.
#[derive(Debug, Clone, Serialize)]
pub struct SubsetNumbers {
    /// The settings.
    pub kind: &'static str,
    /// Frame pairs in it.
    pub pairs: usize,
    /// Each var.
    pub vars: Vec<VarNumbers>,
}

/// One var of a posterior.
#[derive(Debug, Clone, Serialize)]
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
    /// The recording cannot be reduced.
    #[error(transparent)]
    Readings(#[from] ReadingsError),
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
    /// No tables.
    #[error(transparent)]
    Training(#[from] training::TrainingError),
    /// The core refuses the recording.
    #[error(transparent)]
    Stream(#[from] StreamError),
    /// The recording has not what the paper's data need.
    #[error("{recording}: no corrector has frames for a difference {kind}, which the paper's data are made of")]
    NoPairs {
        /// The recording.
        recording: String,
        /// From which setting to which.
        kind: &'static str,
    },
}

/// The bench on which posteriors are sampled: one campaign, one model, one seed.
pub struct Bench<'p> {
    campaign: Campaign,
    twin: ResponseModel,
    options: Options,
    /// A fresh one for whatever is random.
    seeds: Box<dyn Iterator<Item = u64>>,
    runs: Vec<RunNumbers>,
    progress: &'p mut dyn FnMut(&str, usize, usize),
}

impl<'p> Bench<'p> {
    fn new(
        ring: &Ring,
        recording: &Recording,
        options: Options,
        progress: &'p mut dyn FnMut(&str, usize, usize),
    ) -> Result<Self, StudyError> {
        progress("batch fit", 0, 1);
        let campaign = Campaign::of(ring, recording, |_| ())?;
        let seeds = Box::new(simulate::seeds(options.nuts.seed));
        Ok(Self { campaign, twin: ResponseModel::twin(ring)?, options, seeds, runs: Vec::new(), progress })
    }

    /// Sample one posterior of the twin.
    fn sample(&mut self, name: &str, readings: Readings, width: Width) -> Result<Sampled, StudyError> {
        let names = self.campaign.ring.var_names();
        let posterior = Posterior { model: self.twin.clone(), readings, width };
        let laplace = posterior
            .laplace(&self.campaign.fit.map_params)
            .map_err(|source| StudyError::Laplace { run: name.to_owned(), source })?;
        let settings = NutsSettings { seed: self.seed(), ..self.options.nuts };
        let total = settings.chains * (settings.warm_up + settings.draws);
        let report = &mut *self.progress;
        let run =
            nuts::sample(Arc::new(posterior), Arc::new(laplace), &names, settings, |done| report(name, done, total))
                .map_err(|source| StudyError::Nuts { run: name.to_owned(), source })?;
        let sampled = Sampled::of(&run.draws);
        self.runs.push(RunNumbers {
            name: name.to_owned(),
            rhat_max: sampled.summary.iter().map(|s| s.r_hat).fold(0.0, f64::max),
            ess_min: sampled.smallest_ess(),
            divergences: run.draws.divergences(),
            draws: settings.chains * settings.draws,
            seconds: run.seconds,
        });
        Ok(sampled)
    }

    fn seed(&mut self) -> u64 {
        self.seeds.next().expect("seeds do not end")
    }

    fn names(&self) -> Vec<String> {
        self.campaign.ring.var_names()
    }
}

/// Make all studies of a recording; `progress` hears the name of each posterior and how many of its draws are done.
///
/// # Errors
/// [`StudyError`].
pub fn run(
    ring: &Ring,
    recording: &Recording,
    options: Options,
    progress: &mut dyn FnMut(&str, usize, usize),
) -> Result<Study, StudyError> {
    let mut bench = Bench::new(ring, recording, options, progress)?;
    let frames = Readings::of_frames(&bench.campaign, &bench.twin);
    let reference = bench.sample("all frames", frames, WIDTH)?;
    let (stability, subsets) = subsets::study(&mut bench)?;
    let (sensitivity, by_width) = prior::study(&mut bench, &subsets)?;
    let single = single::study(&bench, &by_width);
    let correlations = correlations::study(&mut bench, &reference)?;
    let prediction = prediction::study(&mut bench, &subsets)?;
    let (approximations, laplace) = laplace::study(&bench, &reference)?;
    let (trimming, faults) = trimming::study(&bench)?;
    let numbers = Numbers {
        recording: recording.name.clone(),
        runs: bench.runs.clone(),
        vars: reference.summary.iter().map(VarNumbers::of).collect(),
        subsets: subsets.numbers(),
        widths: subsets.widths(&bench.names()),
        laplace,
        faults,
    };
    let sections = vec![
        subsets.final_table(&bench, &reference),
        sensitivity,
        single,
        stability,
        correlations,
        prediction,
        approximations,
        trimming,
        sampling(&bench.runs),
    ];
    let page = Page {
        title: format!("Quadrupole strengths from {}", recording.name),
        lead: lead(&bench, &reference),
        sections,
    };
    Ok(Study { page, numbers })
}

/// The result in three sentences.
fn lead(bench: &Bench, reference: &Sampled) -> String {
    let sigma = |range: core::ops::Range<usize>| {
        let count = range.len() as f64;
        100.0 * reference.summary[range].iter().map(|s| s.sd).sum::<f64>() / count
    };
    let furthest = reference.summary.iter().max_by(|a, b| (a.mean - 1.0).abs().total_cmp(&(b.mean - 1.0).abs()));
    let furthest = furthest
        .map_or(String::new(), |s| format!("{} is furthest from its design, {:.4} ± {:.4}. ", s.name, s.mean, s.sd));
    let first = inference::map::first_family(&bench.campaign.ring);
    format!(
        "Full NUTS on the exact twin, all {} frames, every baseline unknown, lognormal prior of 3 %: the horizontally focusing \
         quadrupoles are known to {:.2} %, the vertically focusing ones to {:.2} % (mean standard deviation). {furthest}\
         Chi-square per degree of freedom is {:.3}. The twin's corrector kick of 0.2 mrad at 22 A was inferred from the very \
         posterior widths of the published analysis: that widths agree with it is a calibration, not a confirmation.",
        bench.campaign.recording.rows.len(),
        sigma(0..first),
        sigma(first..reference.summary.len()),
        bench.campaign.fit.chi2_per_dof,
    )
}

/// How well each posterior was sampled.
fn sampling(runs: &[RunNumbers]) -> Section {
    let row = |run: &RunNumbers| {
        vec![
            run.name.clone(),
            format!("{:.4}", run.rhat_max),
            format!("{:.0}", run.ess_min),
            run.divergences.to_string(),
            run.draws.to_string(),
            format!("{:.1}", run.seconds),
        ]
    };
    let header = ["posterior", "largest R-hat", "smallest ESS", "divergences", "draws", "time [s]"];
    Section {
        heading: "How the posteriors were sampled".into(),
        text: vec!["Every posterior was sampled by NUTS on the exact twin in coordinates whitened by its Laplace covariance. R-hat is \
                    rank-normalised and split; the effective sample size is the smaller of bulk and tail, the smallest over all \
                    vars."
            .into()],
        tables: vec![report::Table {
            caption: "Sampling diagnostics.".into(),
            header: header.map(str::to_owned).to_vec(),
            rows: runs.iter().map(row).collect(),
        }],
        ..Section::default()
    }
}

impl VarNumbers {
    fn of(summary: &inference::draws::Summary) -> Self {
        let inference::draws::Summary { name, mean, sd, q025, q16, q84, q975, .. } = summary.clone();
        Self { name, mean, sigma: sd, q025, q16, q84, q975 }
    }
}
