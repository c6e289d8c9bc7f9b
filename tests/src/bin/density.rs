//! The log-density that NUTS samples, as numbers for other samplers: `tests/peers/numpyro_nuts.py` writes the same
//! density from them and takes its own derivatives.
//!
//! Under the Green's function, whose equations need nothing but tables. Matrices are those of nalgebra's serde:
//! `[entries by columns, rows, columns]`.

use core::error::Error;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use inference::{
    BaseModel, BatchFit, Campaign, Laplace, Posterior, Readings, Recording, Reduced, ResponseModel, TuneUse,
};
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand_distr::{Distribution, StandardNormal};
use results::output;
use serde::Serialize;
use serde_json::{Value, json};
use system_tests::repository;
use twin::{OrbitError, Ring};

/// Fixes the points at which the density is given.
const SEED: u64 = 1;

/// Standard deviations of these points in whitened coordinates: the MAP, where the draws lie, and two further out.
const SPREADS: [f64; 4] = [0.0, 1.0, 2.0, 3.0];

/// Write the density of a recording as JSON.
#[derive(Debug, Parser)]
struct Arguments {
    /// Folder with header.toml and frames.csv; the paper's campaign without it
    recording: Option<PathBuf>,
    /// Where it goes
    #[arg(long, value_name = "FILE", default_value = "target/density.json")]
    json: PathBuf,
}

/// Log-density and gradient at one point, in whitened coordinates.
#[derive(Debug, Serialize)]
struct Check {
    point: Vec<f64>,
    value: f64,
    gradient: Vec<f64>,
}

fn main() -> ExitCode {
    match run(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("density: {error}");
            ExitCode::from(1)
        }
    }
}

fn run(arguments: &Arguments) -> Result<(), Box<dyn Error>> {
    let ring = Ring::booster();
    let folder = arguments.recording.clone().unwrap_or_else(|| repository("recordings/paper-vars"));
    let campaign = Campaign::of(&ring, &Recording::read(&folder, &ring)?)?;
    let fit = BatchFit::best(&campaign, TuneUse::LeftOut, BaseModel::EXACT, |_| ())?;
    let reduced = Reduced::from_fit(campaign, fit)?;
    // as `orbitcal fit --method nuts --model green` puts it together, without the tunes
    let model = ResponseModel::green(&ring)?;
    let readings = Readings::of_frames(&reduced, &model, TuneUse::LeftOut);
    let posterior = Posterior::new(model, readings, reduced.campaign.prior.clone());
    let laplace = posterior.laplace(&reduced.fit.map_params)?;
    output::json(&arguments.json, &density(&ring, &posterior, &laplace)?)?;
    println!("{}", arguments.json.display());
    Ok(())
}

/// All that the density is made of.
fn density(ring: &Ring, posterior: &Posterior, laplace: &Laplace) -> Result<Value, Box<dyn Error>> {
    let ResponseModel::Green(green) = &posterior.model else { return Err("the twin has no tables".into()) };
    // all params of this ring have one prior
    let (prior, coordinates) = (&posterior.prior, posterior.coordinates.each());
    let mut random = StdRng::seed_from_u64(SEED);
    let mut normal = || -> f64 { StandardNormal.sample(&mut random) };
    let mut point = |spread: f64| (0..posterior.dimension()).map(|_| spread * normal()).collect();
    let checks = SPREADS.map(|spread| check(posterior, laplace, point(spread)));
    Ok(json!({
        "names": ring.var_names(),
        "green": green,
        "readings": posterior.readings,
        "prior": { "mean": prior.mean[0], "precision": prior.precision[0] },
        "range": prior.range[0].map(f64::exp),
        "bend": coordinates[0].bend(),
        "laplace": laplace,
        "checks": checks.into_iter().collect::<Result<Vec<Check>, _>>()?,
    }))
}

fn check(posterior: &Posterior, laplace: &Laplace, point: Vec<f64>) -> Result<Check, OrbitError> {
    let (value, slope) = posterior.of_unbounded(laplace.unbounded(&point).as_slice())?;
    Ok(Check { gradient: laplace.whiten(&slope).as_slice().to_vec(), point, value })
}
