//! The times in the cycle at which the frames of a recording were read. Along a ramp each has baselines of its own: fields that the
//! momentum does not scale, remanent ones above all, turn a beam of lower momentum by more.

use core::fmt;

use crate::recording::{Drive, Recording, mean_supplies};

/// The frames by their time in the cycle.
#[derive(Debug, Clone, PartialEq)]
pub struct Times {
    /// Which of the times each frame has.
    pub of_frame: Vec<usize>,
    /// The times [s], in the order in which they came; one without a ramp.
    pub known: Vec<f64>,
}

impl Times {
    /// Those of a recording.
    pub fn in_recording(recording: &Recording) -> Self {
        let mut known: Vec<f64> = Vec::new();
        let is_ramped = recording.header.ramp.is_given();
        let is_same = |one: f64, other: f64| ((one - other) * 1e6).round().abs() <= f64::from(estimator::SAME_TIME);
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

/// A supply that is off at one time in the cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stray {
    /// Which supply.
    pub supply: usize,
    /// The time [ms].
    pub milliseconds: f64,
    /// Mean `ln` of its factor there, less that of all frames.
    pub off: f64,
}

/// The supply that is furthest off the ramp at some time, from what it is on average; none without several times.
pub fn furthest_stray(recording: &Recording) -> Option<Stray> {
    let times = Times::in_recording(recording);
    let drives = recording.drives();
    let all = mean_supplies(&drives);
    let at = |(time, milliseconds): (usize, f64)| {
        let own: Vec<Drive> = (drives.iter().zip(&times.of_frame))
            .filter(|(_, at)| **at == time)
            .map(|(drive, _)| drive.clone())
            .collect();
        let off = mean_supplies(&own).into_iter().zip(&all).map(|(own, all)| own - all);
        off.enumerate().map(|(supply, off)| Stray { supply, milliseconds, off }).collect::<Vec<_>>()
    };
    let each = times.milliseconds().into_iter().enumerate().flat_map(at).filter(|_| times.count() > 1);
    each.max_by(|one, other| one.off.abs().total_cmp(&other.off.abs()))
}

impl fmt::Display for Times {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let each: Vec<String> = self.milliseconds().iter().map(f64::to_string).collect();
        write!(f, "{} ms", each.join(", "))
    }
}
