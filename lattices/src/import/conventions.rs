//! What a table of numbers does not say: unit of the orbit, size and sign of the kicks, noise.

use std::path::Path;

use twin::Plane;
use twin::limits::POSITIVE;

use super::instruments::{Channel, Instrument, label};
use super::stated::{KickIs, OrbitUnit};
use super::table::Table;
use measured::MeasuredError;

/// Whether a number above 0 deflects to larger x, to larger y.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Signs(pub [bool; 2]);

/// One number for all, one a plane, or a table by names.
#[derive(Debug, Clone)]
pub enum PerInstrument {
    /// The same for all.
    All(f64),
    /// Of x, of y.
    Planes([f64; 2]),
    /// A name and a number a line.
    Named(Table),
}

impl PerInstrument {
    /// A number, `x=0.2,y=0.15`, or a file of names and numbers.
    ///
    /// # Errors
    /// [`MeasuredError`]: none of the three.
    pub fn parse(option: &str, text: &str) -> Result<Self, MeasuredError> {
        if let Ok(number) = text.parse() {
            return Ok(Self::All(number));
        }
        if let Some((x, y)) = text.strip_prefix("x=").and_then(|rest| rest.split_once(",y="))
            && let (Ok(x), Ok(y)) = (x.parse(), y.parse())
        {
            return Ok(Self::Planes([x, y]));
        }
        if !Path::new(text).is_file() {
            let problem =
                format!("{option} {text}: expected a number, x=NUMBER,y=NUMBER, or a file of names and numbers");
            return Err(MeasuredError::Convention(problem));
        }
        let table = Table::read(Path::new(text))?;
        match table.width() {
            1 => Ok(Self::Named(table)),
            width => table.refuse(format!("expected a name and a number a line, found {width} numbers")),
        }
    }

    /// Of each channel.
    pub(super) fn of(
        &self,
        option: &str,
        channels: &[Channel],
        instruments: &[Instrument],
        names: &[String],
    ) -> Result<Vec<f64>, MeasuredError> {
        let lines = match self {
            Self::Named(table) => table.lines(instruments, names, None)?,
            _ => Vec::new(),
        };
        let one = |channel: &Channel| match self {
            Self::All(number) => Ok(*number),
            Self::Planes(both) => Ok(both[channel.1.index()]),
            Self::Named(table) => match lines.iter().position(|one| one == channel) {
                Some(line) => Ok(table.value(line, 0)),
                None => table.refuse(format!("{option}: no line for {}", label(*channel, names))),
            },
        };
        let numbers = channels.iter().map(|channel| match one(channel)? {
            number if POSITIVE.check(number.abs()).is_ok() => Ok(number),
            number => {
                let name = label(*channel, names);
                Err(MeasuredError::Convention(format!(
                    "{option} of {name}: expected {POSITIVE} or the negative of one, found {number:e}"
                )))
            }
        });
        numbers.collect()
    }
}

/// All of it.
#[derive(Debug, Clone)]
pub struct Conventions {
    /// Unit of the orbit.
    pub unit: OrbitUnit,
    /// Deflection that a column belongs to [mrad].
    pub kick: PerInstrument,
    /// Which change that is.
    pub kick_is: KickIs,
    /// Its signs.
    pub signs: Signs,
    /// Standard deviation of an element of the matrix, in its own unit.
    pub noise: PerInstrument,
}

impl Conventions {
    /// Full kick of a corrector's column [mrad], whose number is `kick`.
    pub(super) fn full(&self, kick: f64) -> f64 {
        match self.kick_is {
            KickIs::Full => kick,
            KickIs::Half => 2.0 * kick,
        }
    }

    /// Whether a plus deflects to smaller x or y.
    pub(super) fn is_reversed(&self, plane: Plane) -> bool {
        !self.signs.0[plane.index()]
    }
}

/// What was not said, and why it matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Missing {
    /// Unit of the orbit.
    Unit,
    /// Size of the kick.
    Kick,
    /// What the size counts.
    KickIs,
    /// Sign of the kick.
    Signs,
    /// Noise.
    Noise,
}

impl Missing {
    /// What to find out, and why.
    pub fn words(self) -> &'static str {
        match self {
            Self::Unit => "--orbit-unit mm|m|um: unit of the orbit in the matrix; a wrong one looks like gains of 1000",
            Self::Kick => {
                "--kick MRAD: deflection that an element of the matrix belongs to (1 for a matrix per mrad, 1000 per rad, the calibration in mrad/A per ampere); what is wrong in it looks like gains of all correctors"
            }
            Self::KickIs => {
                "--kick-is full|half: full where the two orbits differ by that kick, half where they are at plus and minus it; a mistake is a factor of 2"
            }
            Self::Signs => {
                "--kick-sign x+y+|x-y+|x+y-|x-y-: whether a plus kicks to larger x (outwards) and larger y (up); with a wrong sign a correction doubles the orbit instead of removing it. Find out with one corrector and the first monitor behind it"
            }
            Self::Noise => {
                "--noise NUMBER: standard deviation of an element of the matrix, in its unit, from repeated measurements; error bars and what counts as wrong go by it"
            }
        }
    }
}
