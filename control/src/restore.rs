//! The machine put back as it was.

use crate::channel::{Control, ControlError};
use crate::journal::{Journal, JournalError, Setting};

/// Why the machine may not be as it was.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RestoreError {
    /// Some set points could not be written.
    #[error("not put back: {}", .0.join("; "))]
    Left(Vec<String>),
    /// The journal cannot be kept.
    #[error(transparent)]
    Journal(#[from] JournalError),
}

/// Relative difference of a set point that is none: control systems may keep single precision.
const SAME: f64 = 1e-6;
/// Time between two tries [s].
const RETRY: f64 = 0.2;

/// Write what the journal holds as original to every set point that differs from it, until all read so; says how many were written.
/// Set points that are as they were are not touched.
///
/// # Errors
/// [`RestoreError::Left`] with channel, present and original value, if that takes longer than `timeout` [s].
pub fn restore(control: &mut impl Control, journal: &mut Journal, timeout: f64) -> Result<usize, RestoreError> {
    let Some(original) = journal.pending().map(<[Setting]>::to_vec) else { return Ok(0) };
    let deadline = control.now() + timeout;
    let mut written = 0;
    loop {
        let left = differing(control, &original);
        if left.is_empty() {
            journal.restored()?;
            return Ok(written);
        }
        let tried: Vec<Result<(), ControlError>> =
            left.iter().map(|left| control.write(&left.setting.channel, left.setting.value)).collect();
        written += tried.iter().filter(|tried| tried.is_ok()).count();
        if control.now() > deadline || matches!(tried.first(), Some(Err(ControlError::Process(_)))) {
            let left = differing(control, &original);
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
    found: Result<Option<f64>, ControlError>,
}

impl Left<'_> {
    fn to_string(left: &Self) -> String {
        let Setting { channel, value } = left.setting;
        match &left.found {
            Ok(Some(found)) => format!("{channel} is at {found}, was at {value}"),
            Ok(None) => format!("{channel} holds no number, was at {value}"),
            Err(why) => format!("{channel} was at {value}: {why}"),
        }
    }
}

fn differing<'s>(control: &mut impl Control, original: &'s [Setting]) -> Vec<Left<'s>> {
    let names: Vec<&str> = original.iter().map(|setting| setting.channel.as_str()).collect();
    let found: Vec<Result<Option<f64>, ControlError>> = match control.read(&names) {
        Ok(samples) => samples.iter().map(|sample| Ok(sample.value.first().copied().flatten())).collect(),
        Err(error @ ControlError::Process(_)) => names.iter().map(|_| Err(error.clone())).collect(),
        // some have no value: which ones
        Err(_) => {
            names.iter().map(|name| control.read(&[name]).map(|s| s[0].value.first().copied().flatten())).collect()
        }
    };
    let same = |found: &Result<Option<f64>, _>, value: f64| matches!(found, Ok(Some(found)) if (found - value).abs() <= SAME * value.abs().max(1e-3));
    let differs = |(setting, found): (&'s Setting, Result<Option<f64>, ControlError>)| {
        (!same(&found, setting.value)).then_some(Left { setting, found })
    };
    original.iter().zip(found).filter_map(differs).collect()
}
