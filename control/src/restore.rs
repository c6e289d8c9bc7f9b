//! The machine put back as it was.

use core::fmt::{self, Display};

use crate::channel::{Control, ControlError, Sample};
use crate::journal::{Journal, JournalError, Setting};

/// Why the machine may not be as it was.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RestoreError {
    /// Some set points could not be written.
    #[error("not put back: {}", few(.0))]
    Left(Vec<String>),
    /// The control system is out of reach.
    #[error("not put back: {0}")]
    Control(#[from] ControlError),
    /// The journal cannot be kept.
    #[error(transparent)]
    Journal(#[from] JournalError),
}

/// The first few of many lines.
fn few(lines: &[String]) -> String {
    const FEW: usize = 3;
    let shown = lines[..lines.len().min(FEW)].join("; ");
    if lines.len() > FEW { format!("{shown}; and {} more", lines.len() - FEW) } else { shown }
}

/// Relative difference of a set point that is none: control systems may keep single precision.
const SAME: f64 = 1e-6;
/// Time between two tries [s].
const RETRY: f64 = 0.2;

/// Write what the journal holds as original to every set point that differs from it, until all read so; says how many were written.
/// Set points that are as they were are not touched.
///
/// # Errors
/// [`RestoreError::Left`] with channel, present and original value, if that takes longer than `timeout` [s]; [`RestoreError::Control`].
pub fn restore(control: &mut impl Control, journal: &mut Journal, timeout: f64) -> Result<usize, RestoreError> {
    let Some(original) = journal.pending().map(<[Setting]>::to_vec) else { return Ok(0) };
    let deadline = control.now() + timeout;
    let mut written = 0;
    loop {
        let left = differing(control, &original)?;
        if left.is_empty() {
            journal.restored()?;
            return Ok(written);
        }
        for Left { setting, found } in &left {
            // what has no value at present cannot be written either
            if found.is_ok() && control.write(&setting.channel, setting.value).is_ok() {
                written += 1;
            }
        }
        if control.now() > deadline {
            let left = differing(control, &original)?;
            if !left.is_empty() {
                return Err(RestoreError::Left(left.iter().map(Left::to_string).collect()));
            }
        }
        control.pause(RETRY);
    }
}

/// A set point that is not as it was.
struct Left<'s> {
    setting: &'s Setting,
    /// What it is at, if it is there; no number is none.
    found: Result<Option<f64>, String>,
}

impl Display for Left<'_> {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Setting { channel, value } = self.setting;
        match &self.found {
            Ok(Some(found)) => write!(f, "{channel} is at {found}, was at {value}"),
            Ok(None) => write!(f, "{channel} holds no number, was at {value}"),
            Err(why) => write!(f, "{channel} was at {value}: {why}"),
        }
    }
}

fn differing<'s>(control: &mut impl Control, original: &'s [Setting]) -> Result<Vec<Left<'s>>, ControlError> {
    let names: Vec<&str> = original.iter().map(|setting| setting.channel.as_str()).collect();
    let same = |found: &Result<Option<f64>, _>, value: f64| matches!(found, Ok(Some(found)) if (found - value).abs() <= SAME * value.abs().max(1e-3));
    let of = |(setting, sampled): (&'s Setting, Result<Sample, String>)| {
        let found = sampled.map(|sample| sample.value.first().copied().flatten());
        (!same(&found, setting.value)).then_some(Left { setting, found })
    };
    Ok(original.iter().zip(control.sample(&names)?).filter_map(of).collect())
}
