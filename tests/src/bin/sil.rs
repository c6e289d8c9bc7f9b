//! Software in the loop: recordings through the emulated chip into shared memory, beside the core in process; the final
//! tables, what the chip needed, and `target/sil.json`.

use core::error::Error;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use comfy_table::CellAlignment;
use inference::stream;
use results::Names;
use results::output::{self, table};
use serde_json::{Value, json};
use shared_memory::{PUBLISHER, Publisher, SERVICE};
use system_tests::qemu::{Image, Sizes};
use system_tests::recording;
use system_tests::sil::{Comparison, compare, largest};
use twin::Ring;

/// Recordings that are run through the chip, and the random walk of their vars.
const RECORDINGS: [(&str, f32); 2] = [("paper-vars", 0.0), ("random-vars", 2e-4)];

/// Replay recordings through the emulated chip.
#[derive(Debug, Parser)]
struct Arguments {
    /// First frames of each recording; all of them without it
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Where the result goes as JSON
    #[arg(long, value_name = "FILE", default_value = "target/sil.json")]
    json: PathBuf,
    /// Name of the shared-memory service
    #[arg(long, default_value = SERVICE)]
    service: String,
}

fn main() -> ExitCode {
    match run(&Arguments::parse()) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(1),
        Err(error) => {
            eprintln!("sil: {error}");
            ExitCode::from(1)
        }
    }
}

/// True if chip and host agree to the bit.
fn run(arguments: &Arguments) -> Result<bool, Box<dyn Error>> {
    let image = Image::build()?;
    let sizes = image.sizes()?;
    let mut publisher = Publisher::try_new(&arguments.service, PUBLISHER, &Names::of(&Ring::booster()))?;
    let mut results = Vec::new();
    for (name, process_noise) in RECORDINGS {
        let (ring, mut recording) = recording(name);
        recording.rows.truncate(arguments.frames.unwrap_or(usize::MAX));
        let bar = orbitcal::progress(recording.rows.len(), "frames", false);
        let walk = stream::walk_per_cycle(&recording, process_noise, 0.0);
        let comparison = compare(&image, (&ring, &recording), walk, true, |record| {
            bar.inc(1);
            Ok(publisher.publish(record)?)
        })?;
        bar.finish_and_clear();
        print(&comparison, &sizes);
        results.push(summary(&recording.name, &comparison, &sizes));
    }
    let bit_equal = results.iter().all(|result| result["bit_equal"] == true);
    // the first recording's numbers stand at the top, where scripts look for them
    let mut whole = results[0].clone();
    whole["recordings"] = Value::Array(results);
    output::json(&arguments.json, &whole)?;
    println!("{}", arguments.json.display());
    Ok(bit_equal)
}

fn print(comparison: &Comparison, sizes: &Sizes) {
    println!("{}", comparison.result);
    let mut table = table(["step", "runs", "median instructions", "most"]);
    for (word, name) in system_tests::sil::REGIONS {
        let mut runs = comparison.counts.get(name).cloned().unwrap_or_default();
        runs.sort_unstable();
        let (median, most) = (runs.get(runs.len() / 2).copied().unwrap_or(0), runs.last().copied().unwrap_or(0));
        table.add_row([word.to_owned(), runs.len().to_string(), median.to_string(), most.to_string()]);
    }
    table.column_iter_mut().skip(1).for_each(|column| column.set_cell_alignment(CellAlignment::Right));
    println!("\non the emulated chip\n{table}");
    let equal = match comparison.different.as_slice() {
        [] => "equal the host's, bit for bit".to_owned(),
        different => format!("differ from the host's in {} frames, first {}", different.len(), different[0]),
    };
    println!(
        "{} estimates {equal}; flash {} kB, RAM {} kB, stack {:.1} kB; {} bytes lost\n",
        comparison.frames,
        sizes.flash / 1024,
        sizes.ram / 1024,
        f64::from(comparison.status.vitals.stack_bytes) / 1024.0,
        comparison.status.vitals.lost_bytes,
    );
}

/// The keys that scripts rely on.
fn summary(recording: &str, comparison: &Comparison, sizes: &Sizes) -> Value {
    let most: serde_json::Map<String, Value> =
        largest(&comparison.counts).into_iter().map(|(word, count)| (word.to_owned(), count.into())).collect();
    let of = |word: &str| most[word].as_u64().unwrap_or(0);
    json!({
        "recording": recording,
        "frames": comparison.frames,
        "bit_equal": comparison.different.is_empty(),
        "instructions": {
            "decode": of("decode"),
            "predict": of("predict"),
            "update": of("screen") + of("condition") + of("solve"),
            "slice": of("slice"),
            "frame": of("ingest") + of("encode"),
        },
        "flash_bytes": sizes.flash,
        "ram_bytes": sizes.ram,
        "stack_bytes": comparison.status.vitals.stack_bytes,
    })
}
