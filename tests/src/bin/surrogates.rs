//! Errors of every surrogate of the Booster against the twin, and what an evaluation takes: the table of `docs/surrogates.md`.
//!
//! `cargo run --release -p system-tests --bin surrogates -- [--samples N] [--checkpoint FILE]`

use core::error::Error;
use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Parser;
use estimator::surrogate::{
    CORRECTOR, CURRENTS, LAST_VAR, Network as Core, ORBIT, Pass as CorePass, Plain, SETTING_KICK, SPAN,
};
use inference::ResponseModel;
use nalgebra::DMatrix;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use training::network::fit::{Plan, Trainee, columns};
use training::network::layers::{Network, Pass};
use training::network::samples::Source;
use training::network::{PLANES, checkpoint};
use twin::{Hold, Optics, Ring, VariedRing};

/// Correctors of a plane, and monitors of x.
const CORRECTORS: usize = 24;
const FIRST: usize = 15;
/// Kick from -22 A to +22 A [rad].
const SWING: f64 = 2.0 * SETTING_KICK as f64;
/// Tunes of the training set about the design's.
const TUNE_CUT: f64 = 0.05;
/// Bands of a tune.
const BANDS: usize = 5;

#[derive(Parser)]
struct Options {
    /// Machines of each set
    #[arg(long, default_value_t = 2000)]
    samples: usize,
    /// Checkpoint of `orbitcal train`, for the network in f32
    #[arg(long)]
    checkpoint: Option<PathBuf>,
}

/// A machine as the twin sees it.
struct Exact {
    vars: Vec<f64>,
    response: DMatrix<f64>,
    tunes: [f64; 2],
}

/// All responses at given vars.
type Predict = dyn Fn(&[f64]) -> DMatrix<f64>;

/// What predicts them.
struct Model {
    name: &'static str,
    value: Box<Predict>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let options = Options::parse();
    let ring = Ring::booster();
    let models = models(&ring, options.checkpoint.as_deref())?;
    let mut random = StdRng::seed_from_u64(18);
    let even = machines(&ring, options.samples, || 1.0 + f64::from(SPAN) * random.random_range(-1.0..1.0));
    let mut random = StdRng::seed_from_u64(19);
    let prior = machines(&ring, options.samples, || {
        loop {
            let normal: f64 = StandardNormal.sample(&mut random);
            let var = (0.03 * normal - 0.5 * 0.03_f64.powi(2)).exp();
            if (var - 1.0).abs() <= f64::from(SPAN) {
                return var;
            }
        }
    });
    println!("error of the difference of the orbits at -22 A and 22 A [mm]; {} machines a set", options.samples);
    println!("surrogate, plane, vars even: rms, largest, 3 % prior: rms, largest; time of all responses [us]");
    for model in &models {
        let start = Instant::now();
        even.iter().take(50).for_each(|exact| _ = (model.value)(&exact.vars));
        let micro = 1e6 * start.elapsed().as_secs_f64() / 50.0;
        for plane in [0, 1] {
            let [[rms, largest], [prior_rms, prior_largest]] = [&even, &prior].map(|set| errors(model, set, plane));
            let name = ["x", "y"][plane];
            println!("{}, {name}, {rms:.5}, {largest:.4}, {prior_rms:.5}, {prior_largest:.4}; {micro:.0}", model.name);
            let bands: Vec<String> = bands(model, &even, plane).iter().map(|rms| format!("{rms:.4}")).collect();
            println!("  rms in {BANDS} bands of Q{name}, -0.05 to 0.05 about the design: {}", bands.join(", "));
            if let Some(stated) = stated(model.name, plane) {
                let share = beyond(model, &even, plane, stated);
                println!(
                    "  stated {stated:.4} mm; {:.1} % of the machines have twice that rms, or more",
                    100.0 * share
                );
            }
        }
    }
    Ok(())
}

/// The twin and all that stand in for it.
fn models(ring: &Ring, checkpoint: Option<&Path>) -> Result<Vec<Model>, Box<dyn Error>> {
    let of = |name, model: ResponseModel| Model {
        name,
        value: Box::new(move |vars| {
            let strength: Vec<f64> = vars.iter().map(|var| var.ln()).collect();
            model.predict(&strength).expect("stable, as the twin is").response
        }),
    };
    let mut models = vec![
        linear(ring),
        of("green", ResponseModel::green(ring)?),
        of("twin", ResponseModel::twin(ring)?),
        Model { name: "resnet int8", value: Box::new(by_core) },
    ];
    if let Some(path) = checkpoint {
        let source = Source::of(ring);
        let mut planes = [0, 1].map(|plane| Trainee::new(&source, plane, &Plan::FULL));
        checkpoint::load(path, &mut planes)?;
        let free = planes.map(|plane| plane.free);
        models.push(Model { name: "resnet f32", value: Box::new(move |vars| by_network(&free, vars)) });
    }
    Ok(models)
}

/// The design's response and its derivatives there.
fn linear(ring: &Ring) -> Model {
    let optics = Optics::of(ring, Hold::Momentum { delta: 0.0 }).expect("a stable design");
    let (monitors, correctors, quadrupoles) = (optics.read_monitors(), optics.correctors(), optics.quadrupoles());
    let design = optics.response(&monitors, &correctors);
    let slopes = optics.response_jacobian(&monitors, &correctors, &quadrupoles);
    let gradients = ring.gradients();
    let value = move |vars: &[f64]| {
        let each = slopes.iter().zip(&gradients).zip(vars);
        each.fold(design.clone(), |sum, ((slope, k), var)| sum + slope * (k * (var - 1.0)))
    };
    Model { name: "linear", value: Box::new(value) }
}

/// Inputs of a corrector.
fn inputs(vars: &[f64], corrector: usize) -> Vec<f32> {
    let powered = (0..CORRECTORS).map(|c| if c == corrector { CORRECTOR } else { 0.0 });
    let vars = vars.iter().map(|var| (var - 1.0) as f32 * (LAST_VAR / SPAN));
    powered.chain([0.0; CURRENTS]).chain(vars).collect()
}

/// The network of the core, in integers.
fn by_core(vars: &[f64]) -> DMatrix<f64> {
    let mut pass = CorePass::BLANK;
    responses(|plane, c| {
        let mut outputs = vec![0.0; PLANES[plane].shape().1];
        PLANES[plane].forward::<Plain>(&inputs(vars, c), &mut pass, &mut outputs);
        outputs
    })
}

/// The network in f32.
fn by_network(planes: &[Network; 2], vars: &[f64]) -> DMatrix<f64> {
    let outputs = [0, 1].map(|plane: usize| {
        let network: &Network = &planes[plane];
        let all: Vec<f32> = (0..CORRECTORS).flat_map(|c| inputs(vars, c)).collect();
        let all = DMatrix::from_vec(all.len() / CORRECTORS, CORRECTORS, all);
        Pass::new(network, CORRECTORS).forward(network, &columns(&all, 0, CORRECTORS)).clone()
    });
    responses(|plane, c| outputs[plane].column(c).iter().copied().collect())
}

/// Responses from the outputs of a network.
fn responses(mut outputs: impl FnMut(usize, usize) -> Vec<f32>) -> DMatrix<f64> {
    let planes: &[Core<'_>; 2] = &PLANES;
    let mut response = DMatrix::zeros(FIRST + planes[1].shape().1, 2 * CORRECTORS);
    for (plane, network) in planes.iter().enumerate() {
        for c in 0..CORRECTORS {
            for (b, output) in outputs(plane, c).into_iter().enumerate() {
                let orbit = network.design(c, b) + ORBIT * output;
                response[(plane * FIRST + b, plane * CORRECTORS + c)] = f64::from(orbit / SETTING_KICK);
            }
        }
    }
    response
}

/// Machines within the tune cut.
fn machines(ring: &Ring, count: usize, mut var: impl FnMut() -> f64) -> Vec<Exact> {
    let varied = VariedRing::of(ring).expect("a stable design");
    let design = varied.at(&vec![1.0; ring.quadrupoles.len()]).expect("a stable design").tunes();
    let mut set = Vec::new();
    while set.len() < count {
        let vars: Vec<f64> = ring.parameters.iter().map(|_| var()).collect();
        let Ok(optics) = varied.at(&vars) else { continue };
        let tunes = optics.tunes();
        if tunes.iter().zip(&design).all(|(tune, design)| (tune - design).abs() <= TUNE_CUT) {
            set.push(Exact { response: optics.response(), vars, tunes: [tunes[0] - design[0], tunes[1] - design[1]] });
        }
    }
    set
}

/// Errors of the difference of the orbits in a plane [mm].
fn misses(model: &Model, exact: &Exact, plane: usize) -> Vec<f64> {
    let own = (model.value)(&exact.vars);
    let monitors = if plane == 0 { 0..FIRST } else { FIRST..exact.response.nrows() };
    let places = monitors.flat_map(|b| (0..CORRECTORS).map(move |c| (b, plane * CORRECTORS + c)));
    places.map(|place| 1e3 * SWING * (own[place] - exact.response[place])).collect()
}

/// Rms and largest [mm].
fn errors(model: &Model, set: &[Exact], plane: usize) -> [f64; 2] {
    let all: Vec<f64> = set.iter().flat_map(|exact| misses(model, exact, plane)).collect();
    [rms(&all), all.iter().fold(0.0, |largest, miss| miss.abs().max(largest))]
}

/// Rms error by the plane's own tune [mm].
fn bands(model: &Model, set: &[Exact], plane: usize) -> Vec<f64> {
    let mut within = vec![Vec::new(); BANDS];
    for exact in set {
        let band = ((exact.tunes[plane] / TUNE_CUT + 1.0) * 0.5 * BANDS as f64) as usize;
        within[band.min(BANDS - 1)].extend(misses(model, exact, plane));
    }
    within.iter().map(|misses| rms(misses)).collect()
}

/// What a surrogate states of the difference of the orbits in a plane [mm].
fn stated(name: &str, plane: usize) -> Option<f64> {
    (name == "resnet int8").then(|| 2e3 * f64::from(PLANES[plane].stated_error()))
}

/// Share of machines whose rms error is at least twice what is stated.
fn beyond(model: &Model, set: &[Exact], plane: usize, stated: f64) -> f64 {
    let far = set.iter().filter(|exact| rms(&misses(model, exact, plane)) >= 2.0 * stated).count();
    far as f64 / set.len() as f64
}

fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len().max(1) as f64).sqrt()
}
