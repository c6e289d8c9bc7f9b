//! `orbitcal train`: the network of the built-in Booster, trained on the twin.

use core::fmt;
use std::fs;
use std::path::Path;
use std::time::Instant;

use estimator::surrogate::ORBIT;
use host_bridge::stop::Stop;
use report::{Axes, Figure, Series};
use results::output;
use training::network::fit::{self, Plan, Progress, Trainee};
use training::network::samples::{Samples, Source};
use training::network::{checkpoint, tables};
use twin::Ring;

use super::{CommandError, check_outputs, progress};
use crate::cli::Train;

/// Seconds between two checkpoints.
const SAVED_EVERY: u64 = 30;

/// What was trained.
struct Trained {
    planes: [Plane; 2],
    /// Samples of each plane in a second of this run.
    rate: f64,
}

struct Plane {
    /// Rms error of the difference of the orbits at 22 A and at -22 A [m]: the validation set in f32, and with 8-bit weights in the
    /// core.
    free: f32,
    core: f32,
    bytes: usize,
}

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Train) -> Result<(), CommandError> {
    check_outputs([options.curves.as_deref()])?;
    let plan = Plan {
        free: options.machines as usize,
        rounded: options.rounded as usize,
        seed: options.seed.into(),
        ..Plan::FULL
    };
    let source = Source::of(&Ring::booster());
    let validation = fit::validation(&source);
    let mut planes = [0, 1].map(|plane| Trainee::new(&source, plane, &plan));
    checkpoint::load(&options.checkpoint, &mut planes).map_err(CommandError::other)?;
    let rate = learn(options, &plan, &source, &mut planes, &validation)?;
    fs::create_dir_all(&options.out).map_err(CommandError::other)?;
    let write = |plane: usize| write(&options.out, &source, plane, &planes[plane], &validation[plane]);
    let trained = Trained { planes: [write(0)?, write(1)?], rate };
    if let Some(path) = &options.curves {
        output::bytes(path, curves(&planes).svg.as_bytes())?;
    }
    if !options.quiet {
        output::say(trained)?;
    }
    Ok(())
}

/// Learn all that is left, with a checkpoint now and then; returns the samples of each plane in a second.
fn learn(
    options: &Train,
    plan: &Plan,
    source: &Source,
    planes: &mut [Trainee; 2],
    validation: &[Samples; 2],
) -> Result<f64, CommandError> {
    let save = |planes: &[Trainee; 2]| checkpoint::save(&options.checkpoint, planes).map_err(CommandError::other);
    let stop = Stop::on_signals().map_err(CommandError::other)?;
    let bar = progress(plan.chunks(), "thousand machines", options.quiet);
    let (start, first, mut saved) = (Instant::now(), planes[0].progress.len(), Instant::now());
    while planes[0].progress.len() < plan.chunks() && !stop.is_requested() {
        fit::learn(source, plan, planes, validation);
        bar.set_position(planes[0].progress.len() as u64);
        if saved.elapsed().as_secs() >= SAVED_EVERY {
            save(planes)?;
            saved = Instant::now();
        }
    }
    bar.finish_and_clear();
    let (done, all) = (planes[0].progress.len(), plan.chunks());
    if done > first {
        save(planes)?;
    }
    if done < all {
        return Err(CommandError::Other(format!("stopped after {done} of {all}; the same command goes on from there")));
    }
    let samples = ((done - first) * plan.machines * source.correctors(0).len()) as f64;
    Ok(samples / start.elapsed().as_secs_f64())
}

/// Write the tables of a plane, and measure them.
fn write(
    folder: &Path,
    source: &Source,
    plane: usize,
    trainee: &Trainee,
    validation: &Samples,
) -> Result<Plane, CommandError> {
    let bytes = tables::bytes(source, plane, &fit::rounded(&trainee.network), validation);
    let errors = tables::errors(source, plane, &bytes, validation);
    output::bytes(&folder.join(["resnet-x.bin", "resnet-y.bin"][plane]), &bytes)?;
    let core = 2.0 * ORBIT * tables::rms(&errors);
    Ok(Plane { free: fit::validate(&trainee.free, validation), core, bytes: bytes.len() })
}

/// Errors while training, of the difference of the orbits at 22 A and at -22 A.
fn curves(planes: &[Trainee; 2]) -> Figure {
    let axes = Axes::new("Error while training", "samples of each plane [million]", "rms error [mm]").logarithmic();
    let of = |label: &str, plane: &Trainee, error: fn(&Progress) -> f32| {
        let seen = plane.progress.iter().enumerate().filter(|(_, progress)| !error(progress).is_nan());
        let million = |chunk: usize| (chunk + 1) as f64 * (Plan::FULL.machines * 24) as f64 * 1e-6;
        let (x, y) = seen.map(|(i, p)| (million(i), f64::from(1e3 * error(p)))).unzip();
        Series::line(label, x, y)
    };
    let [x, y] = planes;
    Figure::lines(
        &axes,
        &[
            of("x, training", x, |p| p.training),
            of("x, validation", x, |p| p.validation),
            of("y, training", y, |p| p.training),
            of("y, validation", y, |p| p.validation),
        ],
    )
}

impl fmt::Display for Trained {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (name, plane) in ['x', 'y'].iter().zip(&self.planes) {
            let (free, core, bytes) = (1e3 * plane.free, 1e3 * plane.core, plane.bytes);
            writeln!(
                f,
                "{name}: rms error {free:.4} mm in f32, {core:.4} mm with 8-bit weights in the core, {bytes} bytes"
            )?;
        }
        write!(f, "{:.0} samples of each plane a second", self.rate)
    }
}
