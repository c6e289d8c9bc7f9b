//! What every posterior of a study is sampled with: one campaign, one model, one seed; and how far the whole job is.

use core::ops::ControlFlow;
use std::sync::Arc;

use schemars::JsonSchema;
use serde::Serialize;
use twin::Ring;

use inference::Campaign;
use inference::nuts::{self, NutsSettings};
use inference::{
    BaseModel, BatchFit, Posterior, Prior, Readings, Recording, Reduced, ResponseModel, TuneUse, Width, simulate,
};
use report::{Section, Table};

use super::{Sampled, StudyError};

/// One sampled posterior.
#[derive(Debug, Clone, Serialize, JsonSchema)]
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

/// What posteriors are sampled with.
pub struct Sampling<'p> {
    pub(crate) reduced: Reduced,
    pub(crate) twin: ResponseModel,
    settings: NutsSettings,
    /// A fresh one for whatever is random.
    seeds: Box<dyn Iterator<Item = u64>>,
    /// Posteriors that have been sampled.
    pub(crate) runs: Vec<RunNumbers>,
    /// Posteriors that will be.
    planned: usize,
    progress: &'p mut dyn FnMut(&str, usize, usize),
}

impl<'p> Sampling<'p> {
    /// Fit a recording; `progress` hears what is done, and how many draws of how many there are.
    ///
    /// # Errors
    /// [`StudyError`].
    pub fn new(
        ring: &Ring,
        recording: &Recording,
        settings: NutsSettings,
        progress: &'p mut dyn FnMut(&str, usize, usize),
    ) -> Result<Self, StudyError> {
        progress("batch fit", 0, 1);
        let reduced = reduced(ring, recording)?;
        let twin = ResponseModel::twin(&reduced.campaign.ring)?;
        let seeds = Box::new(simulate::seeds(settings.seed));
        Ok(Self { reduced, twin, settings, seeds, runs: Vec::new(), planned: 1, progress })
    }

    /// How many posteriors will be sampled in all.
    pub(crate) fn plan(&mut self, posteriors: usize) {
        self.planned = posteriors;
    }

    /// Sample one posterior of the twin, under the priors of the ring's params or all of one width.
    ///
    /// # Errors
    /// [`StudyError`].
    pub fn sample(&mut self, name: &str, readings: Readings, width: Option<Width>) -> Result<Sampled, StudyError> {
        let names = self.names();
        let prior = self.prior(width);
        let posterior = Posterior::new(self.twin.clone(), readings, prior);
        let laplace = posterior
            .laplace(&self.reduced.fit.map_params)
            .map_err(|source| StudyError::Laplace { run: name.to_owned(), source })?;
        let settings = NutsSettings { seed: self.seed(), ..self.settings };
        let each = settings.chains * (settings.warm_up + settings.draws);
        let (before, total) = (self.runs.len() * each, self.planned.max(self.runs.len() + 1) * each);
        let progress = &mut *self.progress;
        let run = nuts::sample(Arc::new(posterior), Arc::new(laplace), &names, settings, |done| {
            progress(name, before + done, total);
            ControlFlow::Continue(())
        });
        let run = run.map_err(|source| StudyError::Nuts { run: name.to_owned(), source })?;
        progress(name, before + each, total);
        let sampled = Sampled::of(&run.draws);
        self.runs.push(RunNumbers {
            name: name.to_owned(),
            rhat_max: sampled.largest_r_hat(),
            ess_min: sampled.smallest_ess(),
            divergences: run.draws.divergences(),
            draws: settings.chains * settings.draws,
            seconds: run.seconds,
        });
        Ok(sampled)
    }

    /// Those of the ring's params, or all of one width.
    pub(crate) fn prior(&self, width: Option<Width>) -> Prior {
        let ring = &self.campaign().ring;
        width.map_or_else(|| Prior::from_ring(ring), |width| Prior::of_width(ring, width))
    }

    pub(crate) fn seed(&mut self) -> u64 {
        self.seeds.next().expect("seeds do not end")
    }

    pub(crate) fn campaign(&self) -> &Campaign {
        &self.reduced.campaign
    }

    pub(crate) fn names(&self) -> Vec<String> {
        self.campaign().ring.var_names()
    }
}

/// A recording with its batch fit. Measured tunes are left out, as in the published analysis.
pub(crate) fn reduced(ring: &Ring, recording: &Recording) -> Result<Reduced, StudyError> {
    let campaign = Campaign::of(ring, recording)?;
    if campaign.times.count() > 1 {
        return Err(StudyError::Times(campaign.times.to_string()));
    }
    let fit = BatchFit::best(&campaign, TuneUse::LeftOut, BaseModel::EXACT, |_| ())?;
    Ok(Reduced::from_fit(campaign, fit)?)
}

/// How well each posterior was sampled.
pub(crate) fn section(runs: &[RunNumbers]) -> Section {
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
    let unmixed: Vec<&str> =
        runs.iter().filter(|run| run.rhat_max > nuts::UNMIXED).map(|run| run.name.as_str()).collect();
    let verdict = if unmixed.is_empty() {
        format!("All are below {}: the chains have mixed.", nuts::UNMIXED)
    } else {
        format!(
            "Above {}, so that the chains do not agree yet and their numbers are provisional: {}.",
            nuts::UNMIXED,
            unmixed.join("; ")
        )
    };
    Section {
        heading: "How the posteriors were sampled".into(),
        text: vec![format!(
            "Every posterior was sampled by NUTS on the exact twin in coordinates whitened by its Laplace covariance. R-hat compares \
             the chains with each other; it is rank-normalised and split, the largest over all vars. {verdict} The effective sample \
             size (ESS) is the smaller of bulk and tail, the smallest over all vars."
        )],
        tables: vec![Table {
            caption: "Sampling diagnostics.".into(),
            header: header.map(str::to_owned).to_vec(),
            rows: runs.iter().map(row).collect(),
        }],
        ..Section::default()
    }
}
