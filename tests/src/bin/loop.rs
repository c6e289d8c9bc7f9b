//! The loop closed in software: one of everything that can happen to a machine, with estimated vars, with the design's, and
//! without correction; the emulated chip steers the same machine, beside the core in process. A table, a figure, `target/loop.json`.

use core::error::Error;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use comfy_table::CellAlignment;
use report::{Axes, Figure, Series};
use results::output::{self, table};
use serde_json::json;
use system_tests::feedback::{
    Chip, Control, Known, Loop, REGIONS, Sample, Scenario, WALK, held, recommended, rms, settled,
};
use system_tests::qemu::{Counts, Emulator, Image, Options};

/// Close the loop in software.
#[derive(Debug, Parser)]
struct Arguments {
    /// Machine, noise, and where things happen
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// How far the orbit is expected to walk in the root of a second [m]
    #[arg(long, default_value_t = WALK)]
    walk: f32,
    /// Frames from the beginning of the feedback on in which the emulated chip steers as well
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
    let feedback = estimator::booster::Feedback { walk: arguments.walk, ..recommended() };
    let closed = |control| Loop::new(&known, feedback.clone(), control, scenario.clone());
    let [off, design] = [Control::Off, Control::Design].map(|control| closed(control)?.run());
    let (estimated, chip) = match arguments.chip {
        0 => (closed(Control::Estimated)?.run()?, OnChip::default()),
        frames => steered_by_the_chip(
            closed(Control::Estimated)?,
            (scenario.campaign as usize + frames).min(scenario.frames as usize),
        )?,
    };
    let (off, design) = (off?, design?);
    let all = [off.as_slice(), &design, &estimated];
    println!("{}", stretches(&scenario, all));
    output::bytes(&arguments.figure, figure(&scenario, all).svg.as_bytes())?;
    println!("{} of {} replies of the emulated chip differ from the host's", chip.different, chip.frames);
    println!("{} bytes of its stack were used", chip.stack_bytes);
    for (word, [median, most]) in chip.instructions() {
        println!("instructions, {word}: median {median}, most {most}");
    }
    output::json(&arguments.json, &summary(&scenario, all, &chip))?;
    println!("{} {}", arguments.figure.display(), arguments.json.display());
    Ok(chip.different == 0)
}

/// What the emulated chip showed.
#[derive(Debug, Default)]
struct OnChip {
    frames: usize,
    different: usize,
    stack_bytes: u32,
    counts: Counts,
}

impl OnChip {
    /// Median and most instructions of each region.
    fn instructions(&self) -> Vec<(&'static str, [u64; 2])> {
        let of = |name| {
            let mut runs = self.counts.get(name)?.clone();
            runs.sort_unstable();
            Some([*runs.get(runs.len() / 2)?, *runs.last()?])
        };
        REGIONS.iter().filter_map(|(word, name)| Some((*word, of(*name)?))).collect()
    }
}

/// A loop in which the chip hears the first frames, and steers as soon as there is feedback.
fn steered_by_the_chip(closed: Loop<'_>, frames: usize) -> Result<(Vec<Sample>, OnChip), Box<dyn Error>> {
    let image = Image::build()?;
    let regions = REGIONS.iter().map(|(_, name)| image.function(name)).collect::<Result<_, _>>()?;
    let emulator = Emulator::start(&image, &Options { regions, ..Options::default() })?;
    let mut closed = closed; // for no longer than there is the emulator
    closed.chip = Some(Chip::start(&emulator)?);
    let mut on_chip = OnChip::default();
    let mut samples = (0..frames).map(|_| closed.cycle()).collect::<Result<Vec<_>, _>>()?;
    if let Some(mut chip) = closed.chip.take() {
        (on_chip.frames, on_chip.different) = (chip.frames, chip.different);
        on_chip.stack_bytes = chip.status()?.vitals.stack_bytes;
    }
    samples.extend(closed.run()?);
    drop(closed);
    on_chip.counts = emulator.stop()?.counts;
    Ok((samples, on_chip))
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
    let on = (f64::from(scenario.campaign), "feedback".to_owned());
    let events = scenario.events.iter().map(|(at, event)| (f64::from(*at), event.word().to_owned()));
    let axes = Axes::new("Orbit with and without feedback", "frame", "rms orbit [mm]")
        .logarithmic()
        .marked([on].into_iter().chain(events).collect());
    let names = ["without correction", "response of the design", "response at the estimated vars"];
    let series = names.into_iter().zip(all).map(|(name, samples)| {
        let frames = (from..samples.len()).map(|frame| frame as f64).collect();
        Series::line(name, frames, samples[from..].iter().map(|sample| 1e3 * sample.rms).collect())
    });
    Figure::lines(&axes, &series.collect::<Vec<_>>())
}

fn summary(scenario: &Scenario, all: [&[Sample]; 3], chip: &OnChip) -> serde_json::Value {
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
        "chip": {"frames": chip.frames, "different": chip.different, "stack_bytes": chip.stack_bytes, "instructions": chip.instructions().into_iter().collect::<BTreeMap<_, _>>()},
    })
}
