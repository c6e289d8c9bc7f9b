//! Errors of every surrogate of the Booster against the twin, what they do to the vars, and where each fails: the tables and the
//! figure of `docs/surrogates.md`.
//!
//! `cargo run --release -p system-tests --bin surrogates -- [--samples N] [--checkpoint FILE] [--figure FILE]`

use core::error::Error;
use std::path::PathBuf;
use std::time::Instant;

use clap::Parser;
use report::{Axes, Figure, Map};
use system_tests::surrogates::{
    BANDS, Machine, Surrogate, bands, beyond, effects, errors, even, map, prior, surrogates,
};
use training::check::TUNE_CUT;
use twin::{Hold, Optics, Ring};

#[derive(Parser)]
struct Options {
    /// Machines of each set
    #[arg(long, default_value_t = 2000)]
    samples: usize,
    /// Checkpoint of `orbitcal train`, for the network in f32
    #[arg(long)]
    checkpoint: Option<PathBuf>,
    /// Where the maps of the errors over both tunes go
    #[arg(long)]
    figure: Option<PathBuf>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let options = Options::parse();
    let ring = Ring::booster();
    let surrogates = surrogates(&ring, options.checkpoint.as_deref())?;
    let (even, prior) = (even(&ring, options.samples), prior(&ring, options.samples));
    println!("error of the difference of the orbits at -22 A and 22 A [mm]; {} machines a set", options.samples);
    println!("surrogate, plane, vars even: rms, largest, 3 % prior: rms, largest; time of all responses [us]");
    for surrogate in &surrogates {
        let micro = time(surrogate, &even);
        for plane in [0, 1] {
            let [[rms, largest], [prior_rms, prior_largest]] = [&even, &prior].map(|set| errors(surrogate, set, plane));
            let name = ["x", "y"][plane];
            println!(
                "{}, {name}, {rms:.5}, {largest:.4}, {prior_rms:.5}, {prior_largest:.4}; {micro:.0}",
                surrogate.name
            );
            let bands = bands(surrogate, &even, plane).map(|rms| format!("{rms:.4}")).join(", ");
            println!("  rms in {BANDS} bands of Q{name}, -0.05 to 0.05 about the design: {bands}");
            if let Some(stated) = surrogate.stated {
                let stated = 2e3 * stated[plane];
                let share = 100.0 * beyond(surrogate, &even, plane, stated);
                println!("  stated {stated:.4} mm; {share:.1} % of the machines have twice that rms, or more");
            }
        }
    }
    for recording in ["recordings/paper-vars", "recordings/random-vars"] {
        println!("{recording}: shift of the vars in the twin's sigma: rms, largest; sigma over the twin's; NEES/N");
        for (name, effect) in effects(&ring, recording, &surrogates)? {
            let ([rms, largest], [least, most]) = (effect.shift, effect.width);
            println!("  {name}: {rms:.3}, {largest:.3}; {least:.2} to {most:.2}; {:.2}", effect.nees);
        }
    }
    if let Some(path) = options.figure {
        std::fs::write(path, figure(&ring, &surrogates, &even)?.svg)?;
    }
    Ok(())
}

/// Median time of all responses [us].
fn time(surrogate: &Surrogate, set: &[Machine]) -> f64 {
    let one = |machine: &Machine| {
        let start = Instant::now();
        let _ = surrogate.predict(&machine.vars);
        1e6 * start.elapsed().as_secs_f64()
    };
    let mut times: Vec<f64> = set.iter().take(51).map(one).collect();
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

/// Error over the stated one, as a power of two, over both tunes.
fn figure(ring: &Ring, surrogates: &[Surrogate], set: &[Machine]) -> Result<Figure, Box<dyn Error>> {
    let tunes = Optics::of(ring, Hold::Momentum { delta: 0.0 })?.tunes()?;
    let middle =
        |tune: f64, band: usize| format!("{:.2}", tune + TUNE_CUT * ((2 * band + 1) as f64 / BANDS as f64 - 1.0));
    let columns: Vec<String> = (0..BANDS).map(|band| middle(tunes.x, band)).collect();
    let rows: Vec<String> = (0..BANDS).rev().map(|band| middle(tunes.y, band)).collect();
    let shown = |surrogate: &&Surrogate| ["linear", "resnet int8", "green i16"].contains(&surrogate.name);
    let of_surrogate = |surrogate: &Surrogate| {
        let stated = surrogate.stated.expect("all but the twin state an error");
        [0, 1].map(|plane| Map {
            name: format!("{}, {}", surrogate.name, ["x", "y"][plane]),
            values: map(surrogate, set, plane).map(|rms| (rms / (2e3 * stated[plane])).log2()),
        })
    };
    let maps: Vec<Map> = surrogates.iter().filter(shown).flat_map(of_surrogate).collect();
    let axes = Axes::new("Rms error over the stated one, by the tunes", "Qx", "Qy").named(&columns);
    Ok(Figure::maps(&axes, "log2 of the ratio", 2.0, &rows, &maps))
}
