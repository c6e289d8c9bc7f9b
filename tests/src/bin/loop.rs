//! The loop closed in software: one of everything that can happen to a machine, with estimated vars, with the design's, and
//! without correction; the same frames through the emulated chip. A table, a figure, `target/loop.json`.

use core::error::Error;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use comfy_table::CellAlignment;
use host_bridge::output::{self, table};
use report::{Axes, Figure, Series};
use serde_json::json;
use system_tests::feedback::{Control, Known, Loop, Sample, Scenario, WALK, held, on_chip, recommended, rms, settled};
use system_tests::qemu::Image;

/// Close the loop in software.
#[derive(Debug, Parser)]
struct Arguments {
    /// Machine, noise, and where things happen
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// How far the orbit is expected to walk in the root of a second [m]
    #[arg(long, default_value_t = WALK)]
    walk: f32,
    /// Frames that also go through the emulated chip
    #[arg(long, value_name = "N", default_value_t = 500)]
    chip: usize,
    /// Where the figure goes
    #[arg(long, value_name = "FILE", default_value = "target/loop.svg")]
    figure: PathBuf,
    /// Where the result goes as JSON
    #[arg(long, value_name = "FILE", default_value = "target/loop.json")]
    json: PathBuf,
}

fn main() -> ExitCode {
    match run(&Arguments::parse()) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(1),
        Err(error) => {
            eprintln!("loop: {error}");
            ExitCode::from(1)
        }
    }
}

/// True if the chip agrees to the bit.
fn run(arguments: &Arguments) -> Result<bool, Box<dyn Error>> {
    let known = Known::read()?;
    let scenario = Scenario::of_everything(arguments.seed);
    let close = |control| -> Result<_, Box<dyn Error>> {
        let feedback = estimator::booster::Feedback { walk: arguments.walk, ..recommended() };
        let mut closed = Loop::new(&known, feedback, control, scenario.clone())?;
        let mut wires = Vec::new();
        let mut samples = Vec::new();
        for _ in 0..scenario.frames {
            samples.push(closed.cycle()?);
            wires.push(closed.wire.clone());
        }
        Ok((samples, wires))
    };
    let (off, _) = close(Control::Off)?;
    let (design, _) = close(Control::Design)?;
    let (estimated, wires) = close(Control::Estimated)?;
    let all = [off.as_slice(), &design, &estimated];
    println!("{}", stretches(&scenario, all));
    output::bytes(&arguments.figure, figure(&scenario, all).svg.as_bytes())?;
    let chip = &wires[..arguments.chip.min(wires.len())];
    let different = if chip.is_empty() { 0 } else { on_chip(&Image::build()?, chip)? };
    println!("{} of {} estimates of the emulated chip differ from the host's", different, chip.len());
    output::json(&arguments.json, &summary(&scenario, all, (chip.len(), different)))?;
    println!("{} {}", arguments.figure.display(), arguments.json.display());
    Ok(different == 0)
}

fn stretches(scenario: &Scenario, all: [&[Sample]; 3]) -> comfy_table::Table {
    let mut table = table([
        "frame",
        "what happens",
        "without [mm]",
        "design [mm]",
        "estimated [mm]",
        "settled, design",
        "settled",
        "held",
    ]);
    for (name, frames) in scenario.stretches() {
        let [off, design, estimated] = all.map(|samples| rms(&samples[frames.clone()]));
        let [_, settled_design, settled] = all.map(|samples| rms(settled(&samples[frames.clone()])));
        let numbers = [off, design, estimated, settled_design, settled].map(|rms| format!("{:.3}", 1e3 * rms));
        let row = [vec![frames.start.to_string(), name], numbers.into(), vec![held(&all[2][frames]).to_string()]];
        table.add_row(row.concat());
    }
    table.column_iter_mut().skip(2).for_each(|column| column.set_cell_alignment(CellAlignment::Right));
    table
}

fn figure(scenario: &Scenario, all: [&[Sample]; 3]) -> Figure {
    let from = scenario.campaign as usize;
    let axes = Axes::new("Orbit with and without feedback", "frame", "log10 of the rms orbit [mm]");
    let names = ["without correction", "response of the design", "response at the estimated vars"];
    let series = names.into_iter().zip(all).map(|(name, samples)| {
        let frames = (from..samples.len()).map(|frame| frame as f64).collect();
        Series::line(name, frames, samples[from..].iter().map(|sample| (1e3 * sample.rms).log10()).collect())
    });
    Figure::lines(&axes, &series.collect::<Vec<_>>())
}

fn summary(scenario: &Scenario, all: [&[Sample]; 3], (chip, different): (usize, usize)) -> serde_json::Value {
    let rows = scenario.stretches().into_iter().map(|(name, frames)| {
        let [off, design, estimated] = all.map(|samples| 1e3 * rms(&samples[frames.clone()]));
        let [_, settled_design, settled] = all.map(|samples| 1e3 * rms(settled(&samples[frames.clone()])));
        json!({"what": name, "from": frames.start, "to": frames.end, "held": held(&all[2][frames]),
            "rms_mm": {"off": off, "design": design, "estimated": estimated},
            "settled_rms_mm": {"design": settled_design, "estimated": settled}})
    });
    let last = all[2].last();
    json!({
        "seed": scenario.seed,
        "frames": scenario.frames,
        "stretches": rows.collect::<Vec<_>>(),
        "nees": last.map(|sample| sample.nees),
        "sigma": last.map(|sample| sample.sigma),
        "chip": {"frames": chip, "different": different},
    })
}
