//! Campaigns on disk: `header.toml` and `frames.csv` become SI values, or one line that says what is wrong.
//!
//! The format, with worked examples, is `docs/recording.md`. Nothing is repaired or guessed: past [`Recording::read`] every
//! number is finite, in its range and in its place, and the recording is of the ring.

mod columns;
mod drive;
mod error;
mod frames;
mod header;
mod limit;
mod names;
mod plausibility;
mod ramp;
mod write;

use std::borrow::Cow;
use std::path::Path;

use twin::Ring;
use twin::limits::{FILE, Limit, SETTINGS};

pub use drive::Drive;
pub(crate) use drive::{field, mean, mean_supplies};
pub use error::{Mismatch, Part, Place, RecordingError};
pub use frames::Row;
use header::Text;
pub use header::{BelievedRf, Format, Header, at_energy};
pub use names::Names;
pub use ramp::{At, Ramp};

/// Names of the two files.
const HEADER: &str = "header.toml";
const FRAMES: &str = "frames.csv";

/// One campaign: what it was taken with, and one row a machine cycle.
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    /// Name of the folder.
    pub name: String,
    /// What holds for every row.
    pub header: Header,
    /// Columns of currents that the model has no use for, `i_sh_A`.
    pub other: Vec<String>,
    /// Machine cycles in the order of time; at least one.
    pub rows: Vec<Row>,
}

impl Recording {
    /// Read `header.toml` and `frames.csv` of a campaign's folder.
    ///
    /// # Errors
    /// The first fault met, the header's before the frames'; last what of the header the frames contradict.
    pub fn read(folder: &Path, ring: &Ring) -> Result<Self, RecordingError> {
        let header = text(&folder.join(HEADER), SETTINGS)?;
        Self::of_texts(folder, ring, &header, || text(&folder.join(FRAMES), FILE))
    }

    /// File name of the machine's lattice as a campaign's header states it; none where it cannot be read, of which [`Recording::read`] says why.
    pub fn lattice(folder: &Path) -> Option<String> {
        header::lattice(&text(&folder.join(HEADER), SETTINGS).ok()?)
    }

    /// The built-in machine that a campaign's header names, if it does.
    pub fn built_in_ring(folder: &Path) -> Option<Ring> {
        Ring::built_in(&Self::lattice(folder)?)
    }

    /// The same from the texts of the two files; `folder` gives the recording its name and appears in errors.
    ///
    /// # Errors
    /// As [`Recording::read`].
    pub fn parse(folder: &Path, ring: &Ring, header: &str, frames: &str) -> Result<Self, RecordingError> {
        Self::of_texts(folder, ring, header, || Ok(frames.into()))
    }

    /// The header comes first: its faults are told even where there are no frames.
    fn of_texts(
        folder: &Path,
        ring: &Ring,
        header_text: &str,
        frames: impl FnOnce() -> Result<String, RecordingError>,
    ) -> Result<Self, RecordingError> {
        let (file, frames_file) = (folder.join(HEADER), folder.join(FRAMES));
        let header_text = Text { file: &file, text: header_text };
        let ring = powered(ring, header_text.format()?);
        let names = Names::from_ring(&ring);
        let header = Header::parse(&header_text, &ring, &names)?;
        let (rows, other) = frames::parse(&frames_file, &frames()?, &header, &ring, &names)?;
        plausibility::check(&header, &rows, &names.supplies)
            .map_err(|(key, what)| header_text.refuse_key(key, &what))?;
        Ok(Self { name: name(folder), header, other, rows })
    }

    /// The same of one of several campaigns of a ring, at whichever energy it was taken; with a ramp in the machine file the frames' times say
    /// which that is.
    ///
    /// # Errors
    /// As [`Recording::read`].
    pub fn read_at_its_energy(folder: &Path, ring: &Ring) -> Result<Self, RecordingError> {
        Self::read(folder, &at_its_energy(ring, &text(&folder.join(HEADER), SETTINGS)?))
    }

    /// The same from the texts of the two files, as [`Recording::parse`].
    ///
    /// # Errors
    /// As [`Recording::read`].
    pub fn parse_at_its_energy(folder: &Path, ring: &Ring, header: &str, frames: &str) -> Result<Self, RecordingError> {
        Self::parse(folder, &at_its_energy(ring, header), header, frames)
    }

    /// The ring as the recording's supplies power it: its own in format 2; in format 1 one for the focusing quadrupoles and
    /// one for all others, where the ring's own cannot be fed by these.
    pub fn powered<'r>(&self, ring: &'r Ring) -> Cow<'r, Ring> {
        powered(ring, self.header.format)
    }

    /// Time of each frame within the campaign, from -1 for the first to 1 for the last.
    pub fn times(&self) -> Vec<f64> {
        let (start, end) = (self.rows.first().map_or(0.0, |r| r.time), self.rows.last().map_or(0.0, |r| r.time));
        let within = |row: &Row| if end > start { 2.0 * (row.time - start) / (end - start) - 1.0 } else { 0.0 };
        self.rows.iter().map(within).collect()
    }

    /// What drove the beam in each frame.
    pub fn drives(&self) -> Vec<Drive> {
        drive::in_rows(&self.header, &self.rows)
    }

    /// Mean `ln` of each supply's factor over all frames [F]: the currents at which the tunes were measured.
    pub fn mean_supplies(&self) -> Vec<f64> {
        mean_supplies(&self.drives())
    }

    /// Largest kick that a corrector was set to, by read-back where settings are not recorded [rad]; 1 where none was.
    pub fn nominal_kick(&self) -> f64 {
        let kick = |(c, current): (usize, f64)| (current * self.header.kick_per_ampere[c]).abs();
        let set = self.rows.iter().flat_map(|row| row.correctors.iter().copied()).map(kick).fold(0.0, f64::max);
        let read_back = || {
            let currents = self.rows.iter().flat_map(|row| row.corrector_current.iter().copied().enumerate());
            currents.map(kick).fold(0.0, f64::max)
        };
        let largest = if self.rows.iter().any(|row| !row.correctors.is_empty()) { set } else { read_back() };
        if largest > IDLE { largest } else { 1.0 }
    }
}

/// The ring at the energy that a header states.
fn at_its_energy<'r>(ring: &'r Ring, header: &str) -> Cow<'r, Ring> {
    header::kinetic_energy(header).map_or(Cow::Borrowed(ring), |energy| at_energy(ring, energy))
}

/// Kick below which a corrector is idle [rad]: the scatter of its read-back.
const IDLE: f64 = 1e-6;

fn powered(ring: &Ring, format: Format) -> Cow<'_, Ring> {
    match format {
        Format::One => names::by_focusing(ring),
        Format::Two => Cow::Borrowed(ring),
    }
}

/// The folder's own name, also where it was given as `.` or `..`.
fn name(folder: &Path) -> String {
    let full = folder.canonicalize().unwrap_or_else(|_| folder.into());
    full.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// The file's text without the byte order mark that some spreadsheets put before it.
fn text(file: &Path, limit: Limit) -> Result<String, RecordingError> {
    let text = limit.text(file).map_err(|error| RecordingError::reading(file, &error))?;
    Ok(text.strip_prefix('\u{feff}').map(str::to_owned).unwrap_or(text))
}

#[cfg(test)]
mod tests;
