//! A feedback of many frames through the emulated chip, on a bad line, beside the core in process.

use core::error::Error;
use std::process::ExitCode;

use clap::Parser;
use orbitcal::progress;
use system_tests::endurance::{Endured, endure};
use system_tests::qemu::Image;

/// Run a long feedback on the emulated chip.
#[derive(Debug, Parser)]
struct Arguments {
    /// Frames
    #[arg(long, value_name = "N", default_value_t = 20_000)]
    frames: u32,
}

fn main() -> ExitCode {
    match run(&Arguments::parse()) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(1),
        Err(error) => {
            eprintln!("endure: {error}");
            ExitCode::from(1)
        }
    }
}

/// True if chip and host agree to the bit, every refusal was counted, and no byte was lost.
fn run(arguments: &Arguments) -> Result<bool, Box<dyn Error>> {
    let bar = progress(arguments.frames as usize, "frames", false);
    let Endured { different, refused, status } = endure(&Image::build()?, arguments.frames, || bar.inc(1))?;
    bar.finish_and_clear();
    let equal = match different.as_slice() {
        [] => "equal the host's, bit for bit".to_owned(),
        different => format!("differ from the host's in {} frames, first {}", different.len(), different[0]),
    };
    println!(
        "{} frames: replies {equal}; {} packets refused, {refused} of them said; stack {:.1} kB; {} bytes lost",
        status.frames,
        status.refused,
        f64::from(status.vitals.stack_bytes) / 1024.0,
        status.vitals.lost_bytes,
    );
    Ok(different.is_empty() && status.refused == refused && status.vitals.lost_bytes == 0)
}
