//! Many closed loops, each with estimated vars, with the design's, and without correction: where the estimated response holds the
//! orbit better, where worse, and what of that is chance. Runs of one machine that differ by the noise of its monitors and
//! correctors alone are paired: the spread of their differences is chance. The tables of `docs/feedback.md`; minutes.

use core::error::Error;
use std::process::ExitCode;
use std::sync::Mutex;
use std::thread;

use clap::Parser;
use system_tests::feedback::{Control, Known, Loop, Sample, Scenario, recommended, rms, settled};

/// Close many loops.
#[derive(Debug, Parser)]
struct Arguments {
    /// Machines, and where things happen
    #[arg(long, value_delimiter = ',', default_value = "101,102,103,104,105,106")]
    seeds: Vec<u64>,
    /// Runs of each machine, each with another noise
    #[arg(long, value_name = "N", default_value_t = 1)]
    noises: u64,
    /// Loops at a time
    #[arg(long, value_name = "N", default_value_t = 2)]
    threads: usize,
}

fn main() -> ExitCode {
    match run(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("loops: {error}");
            ExitCode::from(1)
        }
    }
}

/// One stretch of one machine: what happens, and its rms orbits in each run [m].
#[derive(Debug, Clone)]
struct Stretch {
    seed: u64,
    name: String,
    runs: Vec<Orbits>,
}

/// Rms orbits of a stretch [m], in its [`PARTS`].
#[derive(Debug, Clone, Copy)]
struct Orbits {
    off: f64,
    design: [f64; 3],
    estimated: [f64; 3],
}

/// All frames of a stretch; those that follow a frame in which both responses moved the correctors, for the others show what
/// neither had any part in; and its second half.
const PARTS: [(&str, usize); 3] = [("whole stretches", 0), ("corrected frames", 1), ("settled", 2)];
/// Largest share of the orbit without correction that is asked for.
const SHARE: f64 = 0.2;
/// Standard errors of the mean over the noises by which two responses must differ: by chance once in 200 stretches with eight
/// noises (Student's t with 7 degrees of freedom, both sides).
const DIFFER: f64 = 4.0;

impl Stretch {
    /// Logarithm of estimated over design in each run.
    fn ratios(&self, part: usize) -> Vec<f64> {
        self.runs.iter().map(|run| (run.estimated[part] / run.design[part]).ln()).collect()
    }
}

fn run(arguments: &Arguments) -> Result<(), Box<dyn Error>> {
    let known = Known::read()?;
    let jobs: Vec<(u64, u64)> =
        arguments.seeds.iter().flat_map(|seed| (0..arguments.noises).map(|noise| (*seed, noise))).collect();
    let runs = in_parallel(arguments.threads, &jobs, |(seed, noise)| orbits(&known, *seed, *noise))?;
    let mut stretches: Vec<Stretch> = Vec::new();
    for (machine, seed) in runs.chunks(arguments.noises as usize).zip(&arguments.seeds) {
        for (k, (name, _)) in Scenario::of_everything(*seed).stretches().into_iter().enumerate() {
            stretches.push(Stretch { seed: *seed, name, runs: machine.iter().map(|run| run[k]).collect() });
        }
    }
    summarise(&stretches);
    if arguments.noises > 1 {
        compare(&stretches);
    }
    Ok(())
}

/// Stretches of one run.
fn orbits(known: &Known, seed: u64, noise: u64) -> Result<Vec<Orbits>, String> {
    let mut scenario = Scenario::of_everything(seed);
    scenario.noise += 1_000_003 * noise;
    let closed = |control| {
        let closed = Loop::new(known, recommended(), control, scenario.clone()).and_then(|mut closed| closed.run());
        closed.map_err(|error| format!("seed {seed}, noise {noise}: {error}"))
    };
    let (off, design, estimated) = (closed(Control::Off)?, closed(Control::Design)?, closed(Control::Estimated)?);
    let stretches = scenario.stretches().into_iter().map(|(_, frames)| {
        let is_moved = |sample: &Sample| sample.steered.is_some_and(|steered| steered.hold.is_none());
        let corrected: Vec<usize> =
            frames.clone().filter(|k| is_moved(&design[k - 1]) && is_moved(&estimated[k - 1])).collect();
        let parts = |samples: &[Sample]| {
            let corrected: Vec<Sample> = corrected.iter().map(|k| samples[*k]).collect();
            [rms(&samples[frames.clone()]), rms(&corrected), rms(settled(&samples[frames.clone()]))]
        };
        Orbits { off: rms(&off[frames.clone()]), design: parts(&design), estimated: parts(&estimated) }
    });
    Ok(stretches.collect())
}

/// What becomes of each, in the same order.
fn in_parallel<I: Sync, O: Send>(
    threads: usize,
    inputs: &[I],
    of: impl Fn(&I) -> Result<O, String> + Sync,
) -> Result<Vec<O>, String> {
    let (next, results) = (Mutex::new(0..inputs.len()), Mutex::new(Vec::new()));
    let work = || {
        while let Some(k) = next.lock().ok().and_then(|mut next| next.next()) {
            let result = of(&inputs[k]);
            results.lock().expect("no thread panics with it").push((k, result));
        }
    };
    thread::scope(|scope| (0..threads.max(1)).for_each(|_| drop(scope.spawn(work))));
    let mut results = results.into_inner().expect("no thread panics with it");
    results.sort_by_key(|(k, _)| *k);
    results.into_iter().map(|(_, result)| result).collect()
}

/// The table of all runs.
fn summarise(stretches: &[Stretch]) {
    let shares = stretches.iter().flat_map(|stretch| &stretch.runs).map(|run| run.estimated[0] / run.off);
    println!("largest share of the orbit without correction: {:.3}", shares.fold(0.0, f64::max));
    for stretch in stretches {
        let above = stretch.runs.iter().filter(|run| run.estimated[0] > SHARE * run.off).count();
        if above > 0 {
            println!("  above {SHARE} in {above} of {}: seed {}, {}", stretch.runs.len(), stretch.seed, stretch.name);
        }
    }
    for (name, part) in PARTS {
        let ratios: Vec<f64> = stretches.iter().flat_map(|stretch| stretch.ratios(part)).collect();
        let below = ratios.iter().filter(|ratio| **ratio < 0.0).count();
        let mean = ratios.iter().sum::<f64>() / ratios.len() as f64;
        let micrometres = |of: fn(&Orbits) -> [f64; 3]| {
            let runs = stretches.iter().flat_map(|stretch| &stretch.runs);
            1e6 * (runs.map(|run| of(run)[part].ln()).sum::<f64>() / ratios.len() as f64).exp()
        };
        let (design, estimated) = (micrometres(|run| run.design), micrometres(|run| run.estimated));
        println!(
            "{name}: {estimated:.1} um, the design's {design:.1} um, ratio {:.3}; below it in {below} of {}",
            mean.exp(),
            ratios.len()
        );
    }
}

/// The table of stretches in which the responses differ by more than chance.
fn compare(stretches: &[Stretch]) {
    for (name, part) in PARTS {
        let (mut better, mut worse) = (0, 0);
        for stretch in stretches {
            let (mean, error) = mean_and_error(&stretch.ratios(part));
            better += usize::from(mean < -DIFFER * error);
            if mean > DIFFER * error {
                worse += 1;
                report(stretch, part, mean, error);
            }
        }
        let neither = stretches.len() - better - worse;
        println!("{name}: better in {better}, worse in {worse}, neither in {neither} of {}", stretches.len());
    }
}

fn report(stretch: &Stretch, part: usize, mean: f64, error: f64) {
    let micrometres = |of: fn(&Orbits) -> [f64; 3]| {
        1e6 * (stretch.runs.iter().map(|run| of(run)[part].powi(2)).sum::<f64>() / stretch.runs.len() as f64).sqrt()
    };
    let (design, estimated) = (micrometres(|run| run.design), micrometres(|run| run.estimated));
    println!(
        "  seed {}, {}: {estimated:.1} um, design {design:.1} um, ratio {:.3} with an error of {:.3}",
        stretch.seed,
        stretch.name,
        mean.exp(),
        mean.exp() * error
    );
}

/// Mean, and its standard error.
fn mean_and_error(values: &[f64]) -> (f64, f64) {
    let number = values.len() as f64;
    let mean = values.iter().sum::<f64>() / number;
    let square = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / (number - 1.0);
    (mean, (square / number).sqrt())
}
