//! The log of the chip: defmt frames, whose texts lie in the image.

use defmt_decoder::{DecodeError, Frame, Locations, Table};

use super::Error;

/// A line of the log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Line {
    /// `trace`, `debug`, `info`, `warn` or `error`.
    pub level: &'static str,
    /// What it says.
    pub message: String,
    /// File and line of the source that says it, `src/main.rs:7`.
    pub location: String,
}

/// Lines from the frames in an image's output. A frame that the end of the output cuts short is left out.
pub(super) fn decode(elf: &[u8], output: &[u8]) -> Result<Vec<Line>, Error> {
    let broken = |error: String| Error::Image(format!("its log: {error}"));
    let table = Table::parse(elf).map_err(|e| broken(e.to_string()))?;
    let table = table.ok_or_else(|| broken("no texts (.defmt)".into()))?;
    let locations = table.get_locations(elf).map_err(|e| broken(e.to_string()))?;
    let mut decoder = table.new_stream_decoder();
    decoder.received(output);
    let mut lines = Vec::new();
    loop {
        match decoder.decode() {
            Ok(frame) => lines.push(line(&frame, &locations)),
            Err(DecodeError::UnexpectedEof) => return Ok(lines),
            Err(DecodeError::Malformed) => return Err(broken("a malformed frame".into())),
        }
    }
}

fn line(frame: &Frame, locations: &Locations) -> Line {
    let place = locations.get(&frame.index());
    Line {
        level: frame.level().map_or("", |level| level.as_str()),
        message: frame.display_message().to_string(),
        location: place.map(|at| format!("{}:{}", at.file.display(), at.line)).unwrap_or_default(),
    }
}
