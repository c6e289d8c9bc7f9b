//! The times in the cycle at which the frames of a recording were read. Along a ramp each has baselines of its own: fields that the
//! momentum does not scale, remanent ones above all, turn a beam of lower momentum by more.

use core::fmt;

use crate::recording::Recording;

/// The frames by their time in the cycle.
#[derive(Debug, Clone, PartialEq)]
pub struct Times {
    /// Which of the times each frame has.
    pub of_frame: Vec<usize>,
    /// The times [s], in the order in which they came; one without a ramp.
    pub known: Vec<f64>,
}

/// Times this close are one, as in the core [us].
const SAME_TIME: f64 = 1e3;

impl Times {
    /// Those of a recording.
    pub fn of(recording: &Recording) -> Self {
        let mut known: Vec<f64> = Vec::new();
        let is_ramped = recording.header.ramp.is_given();
        let is_same = |one: f64, other: f64| ((one - other) * 1e6).round().abs() <= SAME_TIME;
        let mut index = |time: f64| {
            known.iter().position(|one| !is_ramped || is_same(*one, time)).unwrap_or_else(|| {
                known.push(time);
                known.len() - 1
            })
        };
        let of_frame = recording.rows.iter().map(|row| index(row.cycle_time)).collect();
        Self { of_frame, known }
    }

    /// How many there are.
    pub fn count(&self) -> usize {
        self.known.len().max(1)
    }

    /// The times [ms], to the microsecond.
    pub fn milliseconds(&self) -> Vec<f64> {
        self.known.iter().map(|time| (time * 1e6).round() / 1e3).collect()
    }
}

impl fmt::Display for Times {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let each: Vec<String> = self.milliseconds().iter().map(f64::to_string).collect();
        write!(f, "{} ms", each.join(", "))
    }
}
