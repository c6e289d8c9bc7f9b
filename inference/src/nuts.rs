//! The reference: full NUTS on the exact posterior.
//!
//! The sampler is nuts-rs; here it is given the density in whitened coordinates (see `posterior.rs`), each chain from
//! the MAP, and its draws come back as vars. The seed fixes every draw, whatever the number of threads.
//!
//! Source: M. D. Hoffman and A. Gelman, J. Mach. Learn. Res. 15 (2014) 1593; A. Seyboldt, nuts-rs.

use core::ops::ControlFlow;
use core::time::Duration;
use std::collections::HashMap;
use std::sync::Arc;
use std::time::Instant;

use nalgebra::DVector;
use nuts_rs::{
    CpuLogpFunc, CpuMath, CpuMathError, DiagNutsSettings, HasDims, HashMapConfig, HashMapResult, HashMapValue,
    InitPositionError, LogpError, Model, Sampler, SamplerWaitResult,
};

use rand::Rng;
use twin::limits::{DRAWS, Exceeded};

use crate::draws::{Chain, DrawStats, Draws};
use crate::posterior::{Laplace, Posterior};

/// How to sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NutsSettings {
    /// Independent chains.
    pub chains: usize,
    /// Draws of each that adapt the step, thrown away.
    pub warm_up: usize,
    /// Draws of each that are kept.
    pub draws: usize,
    /// Fixes every draw.
    pub seed: u64,
}

impl Default for NutsSettings {
    fn default() -> Self {
        Self { chains: 4, warm_up: 1000, draws: 2000, seed: 1 }
    }
}

/// Draws of the vars, and what they cost.
#[derive(Debug, Clone)]
pub struct NutsRun {
    /// Draws of every var.
    pub draws: Draws,
    /// Evaluations of log-density and gradient, warm-up included.
    pub evaluations: u64,
    /// Wall-clock time.
    pub seconds: f64,
    /// Chains that ran at the same time.
    pub threads: usize,
    /// What happened at each divergence.
    pub divergences: Vec<String>,
}

/// Why there are no draws.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum NutsError {
    /// Somebody asked for the end.
    #[error("interrupted")]
    Interrupted,
    /// The sampler stopped.
    #[error("the sampler stopped: {0}")]
    Sampler(String),
    /// More draws than are kept.
    #[error("{0}, the warm-up counted")]
    TooMany(#[from] Exceeded),
    /// The sampler's result is incomplete.
    #[error("the sampler's result has no {0}")]
    Missing(&'static str),
}

/// What the sampler explores, in coordinates in which it is nearly a standard normal.
pub trait Density: Send + Sync + 'static {
    /// Number of coordinates.
    fn dimension(&self) -> usize;

    /// Log-density at a position, and its gradient.
    ///
    /// # Errors
    /// Where there is no stable ring: the trajectory ends there.
    fn evaluate(&self, position: &[f64]) -> Result<(f64, Vec<f64>), Unstable>;

    /// Range of each var; the vars are the first of what is kept.
    fn ranges(&self) -> Vec<[f64; 2]>;

    /// What is kept of a draw, by the names given: the vars, then anything else.
    fn expand(&self, position: &[f64]) -> Vec<f64>;
}

/// A ring without a closed orbit.
#[derive(Debug, thiserror::Error)]
#[error("no stable ring: {0}")]
pub struct Unstable(Box<dyn core::error::Error + Send + Sync>);

impl Unstable {
    /// With its reason.
    pub fn new(reason: impl core::error::Error + Send + Sync + 'static) -> Self {
        Self(Box::new(reason))
    }
}

/// R-hat of chains that have not mixed: their draws are not yet those of one distribution.
///
/// Source: A. Vehtari, A. Gelman, D. Simpson, B. Carpenter and P. Buerkner, Bayesian Anal. 16 (2021) 667, sec. 4.
pub const UNMIXED: f64 = 1.01;

/// Sample a posterior about its Laplace approximation; `progress` hears of finished draws, warm-up included, every 0.1 s, and may break off.
///
/// # Errors
/// [`NutsError`].
pub fn sample(
    posterior: Arc<Posterior>,
    laplace: Arc<Laplace>,
    names: &[String],
    settings: NutsSettings,
    progress: impl FnMut(usize) -> ControlFlow<()>,
) -> Result<NutsRun, NutsError> {
    explore(Arc::new(Whitened { posterior, laplace }), names, settings, progress)
}

/// Sample a density from the origin of its coordinates; `progress` as in [`sample`].
///
/// # Errors
/// [`NutsError`].
pub fn explore<D: Density>(
    density: Arc<D>,
    names: &[String],
    settings: NutsSettings,
    mut progress: impl FnMut(usize) -> ControlFlow<()>,
) -> Result<NutsRun, NutsError> {
    DRAWS.check((settings.warm_up + settings.draws) as u64 * (settings.chains * names.len()) as u64)?;
    let options = DiagNutsSettings {
        num_chains: settings.chains,
        num_tune: settings.warm_up as u64,
        num_draws: settings.draws as u64,
        seed: settings.seed,
        store_divergences: true,
        ..DiagNutsSettings::default()
    };
    let threads = std::thread::available_parallelism().map_or(1, usize::from).min(settings.chains);
    let start = Instant::now();
    let model = Arc::new(Explored(Arc::clone(&density)));
    let failed = |error: anyhow::Error| NutsError::Sampler(format!("{error:#}"));
    let mut sampler = Sampler::new(model, options, HashMapConfig::new(), threads, None).map_err(failed)?;
    let chains = loop {
        let chains = sampler.progress().map_err(failed)?;
        if progress(chains.iter().map(|chain| chain.finished_draws).sum()).is_break() {
            sampler.abort().map_err(failed)?;
            return Err(NutsError::Interrupted);
        }
        match sampler.wait_timeout(Duration::from_millis(100)) {
            SamplerWaitResult::Trace(chains) => break chains,
            SamplerWaitResult::Timeout(more) => sampler = more,
            SamplerWaitResult::Err(error, _) => return Err(failed(error)),
        }
    };
    let seconds = start.elapsed().as_secs_f64();
    let explain = |(c, chain)| explained(c, chain, density.as_ref(), names, settings.warm_up);
    let divergences = chains.iter().enumerate().flat_map(explain).collect();
    let evaluations = chains.iter().map(leapfrogs).sum();
    let unpack = |chain| unpack(chain, names.len(), settings.warm_up);
    let chains = chains.iter().map(unpack).collect::<Result<_, _>>()?;
    Ok(NutsRun { draws: Draws { names: names.to_vec(), chains }, evaluations, seconds, threads, divergences })
}

/// The posterior of the vars, in the coordinates of its Laplace approximation.
#[derive(Debug)]
struct Whitened {
    posterior: Arc<Posterior>,
    laplace: Arc<Laplace>,
}

impl Density for Whitened {
    fn dimension(&self) -> usize {
        self.posterior.dimension()
    }

    fn evaluate(&self, position: &[f64]) -> Result<(f64, Vec<f64>), Unstable> {
        let u = self.laplace.unbounded(position);
        let (value, slope) = self.posterior.of_unbounded(u.as_slice()).map_err(Unstable::new)?;
        Ok((value, self.laplace.whiten(&slope).as_slice().to_vec()))
    }

    fn ranges(&self) -> Vec<[f64; 2]> {
        self.posterior.prior.range.iter().map(|range| range.map(f64::exp)).collect()
    }

    fn expand(&self, position: &[f64]) -> Vec<f64> {
        let u = self.laplace.unbounded(position);
        self.posterior.coordinates.params(u.as_slice()).iter().map(|theta| theta.exp()).collect()
    }
}

/// A density as the sampler wants it.
struct Explored<D>(Arc<D>);

impl<D> Clone for Explored<D> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl LogpError for Unstable {
    fn is_recoverable(&self) -> bool {
        true
    }
}

impl<D: Density> HasDims for Explored<D> {
    fn dim_sizes(&self) -> HashMap<String, u64> {
        HashMap::from([("dim".to_owned(), self.0.dimension() as u64)])
    }
}

impl<D: Density> CpuLogpFunc for Explored<D> {
    type LogpError = Unstable;
    type FlowParameters = ();
    type ExpandedVector = Vec<f64>;

    fn dim(&self) -> usize {
        self.0.dimension()
    }

    fn logp(&mut self, position: &[f64], gradient: &mut [f64]) -> Result<f64, Unstable> {
        let (value, slope) = self.0.evaluate(position)?;
        gradient.copy_from_slice(&slope);
        Ok(value)
    }

    fn expand_vector<R: Rng + ?Sized>(&mut self, _: &mut R, position: &[f64]) -> Result<Vec<f64>, CpuMathError> {
        Ok(self.0.expand(position))
    }
}

impl<D: Density> Model for Explored<D> {
    type Math = CpuMath<Explored<D>>;

    fn math<R: Rng + ?Sized>(self: Arc<Self>, _: &mut R) -> anyhow::Result<Self::Math> {
        Ok(CpuMath::new((*self).clone()))
    }

    /// The origin.
    fn init_position<R: Rng + ?Sized>(&self, _: &mut R, _: u64, position: &mut [f64]) -> Result<(), InitPositionError> {
        position.fill(0.0);
        Ok(())
    }
}

/// One sentence a divergence after the warm-up: where its trajectory began, and which var was nearest its bound there.
fn explained(
    chain: usize,
    result: &HashMapResult,
    density: &impl Density,
    names: &[String],
    warm_up: usize,
) -> Vec<String> {
    let (Some(HashMapValue::U64(draws)), Some(HashMapValue::String(messages)), Some(HashMapValue::F64(starts))) = (
        result.stats.get("divergence_draw"),
        result.stats.get("divergence_message"),
        result.stats.get("divergence_start"),
    ) else {
        return Vec::new();
    };
    let each = draws.iter().zip(messages).zip(starts.chunks_exact(density.dimension()));
    let kept = each.filter(|((draw, _), _)| **draw as usize >= warm_up);
    let sentence = |((draw, message), start): ((&u64, &String), &[f64])| {
        let (kept, ranges) = (density.expand(start), density.ranges());
        let room = kept.iter().zip(&ranges).map(|(var, range)| (var - range[0]).min(range[1] - var));
        let nearest = DVector::from_iterator(ranges.len(), room).imin();
        let (name, var) = (&names[nearest], kept[nearest]);
        format!("chain {}, draw {}: {message}; {name} = {var:.4} was nearest its bound", chain + 1, draw + 1)
    };
    kept.map(sentence).collect()
}

/// Leapfrog steps of all draws, an evaluation each.
fn leapfrogs(chain: &HashMapResult) -> u64 {
    match chain.stats.get("n_steps") {
        Some(HashMapValue::U64(steps)) => steps.iter().sum(),
        _ => 0,
    }
}

/// The draws after the warm-up.
fn unpack(chain: &HashMapResult, names: usize, warm_up: usize) -> Result<Chain, NutsError> {
    let real = |name: &'static str| match chain.stats.get(name) {
        Some(HashMapValue::F64(values)) => Ok(values),
        _ => Err(NutsError::Missing(name)),
    };
    let whole = |name: &'static str| match chain.stats.get(name) {
        Some(HashMapValue::U64(values)) => Ok(values),
        _ => Err(NutsError::Missing(name)),
    };
    let Some(HashMapValue::Bool(divergent)) = chain.stats.get("diverging") else {
        return Err(NutsError::Missing("diverging"));
    };
    let Some(HashMapValue::F64(values)) = chain.draws.get("value") else { return Err(NutsError::Missing("value")) };
    let (lp, energy, step) = (real("logp")?, real("energy")?, real("step_size")?);
    let (acceptance, depth, leapfrogs) = (real("mean_tree_accept")?, whole("depth")?, whole("n_steps")?);
    let stats = |i: usize| DrawStats {
        lp: lp[i],
        acceptance: acceptance[i],
        step_size: step[i],
        depth: depth[i],
        leapfrogs: leapfrogs[i],
        divergent: divergent[i],
        energy: energy[i],
    };
    Ok(Chain {
        draws: values.chunks_exact(names).skip(warm_up).map(<[f64]>::to_vec).collect(),
        stats: (warm_up..divergent.len()).map(stats).collect(),
    })
}
