//! Long streams of simulated frames through the core, hours of them if asked: one line a checkpoint.

use core::error::Error;
use estimator::Walk;
use std::process::ExitCode;

use clap::Parser;
use system_tests::soak::{Row, Soak};

/// Stream simulated frames through the core, beside the same Gaussian in double precision.
#[derive(Debug, Parser)]
struct Arguments {
    /// What drives the beam; every kind in turn without it
    #[arg(long, value_enum)]
    row: Option<Row>,
    /// Frames of each stream
    #[arg(long, value_name = "N", default_value_t = 1_000_000)]
    frames: u32,
    /// Frames between checkpoints
    #[arg(long, value_name = "N", default_value_t = 100_000)]
    every: u32,
    /// Which machine
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

fn main() -> ExitCode {
    match run(&Arguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("soak: {error}");
            ExitCode::from(1)
        }
    }
}

fn run(arguments: &Arguments) -> Result<(), Box<dyn Error>> {
    for row in Row::ALL.into_iter().filter(|row| arguments.row.is_none_or(|only| only == *row)) {
        println!("{row:?}, seed {}", arguments.seed);
        let mut soak = Soak::new(row, arguments.seed, Walk::NONE)?;
        for _ in 0..arguments.frames / arguments.every.max(1) {
            let c = soak.run(arguments.every);
            println!(
                "{:9} frames  NEES/48 {:9.2}  sigma {:.3} to {:.3}  NIS {:6.2} ± {:5.2}  evidence {:+.3} nat a frame",
                c.frames, c.nees, c.sigma_ratio[0], c.sigma_ratio[1], c.nis, c.nis_scatter, c.evidence
            );
        }
    }
    Ok(())
}
