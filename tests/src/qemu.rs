//! The image in the emulator: build it, run it, talk to its UART, read its log, count its instructions.
//!
//! ```no_run
//! use std::io::Write;
//! use system_tests::qemu::{Emulator, Image, Options};
//!
//! let image = Image::build()?;
//! let options = Options { regions: vec![image.function("Estimator::ingest")?], ..Options::default() };
//! let emulator = Emulator::start(&image, &options)?;
//! emulator.uart().write_all(b"frame")?;
//! let run = emulator.stop()?;
//! println!("{:?} {:?}", image.log(&run.stdout)?, run.counts["Estimator::ingest"]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod counts;
mod emulator;
mod error;
mod image;
mod log;

pub use counts::Counts;
pub use emulator::{Emulator, Options, Run};
pub use error::Error;
pub use image::{Function, Image, Sizes};
pub use log::Line;
