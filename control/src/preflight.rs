//! The channels of a plan, checked before anything is written.

use crate::channel::{Channel, Control, ControlError};
use crate::plan::Plan;
use crate::step::Step;

/// Why a plan cannot be carried out.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PreflightError {
    /// The control system is not there.
    #[error(transparent)]
    Control(#[from] ControlError),
    /// Some channels cannot do what the plan asks of them.
    #[error("{}", .0.join("; "))]
    Channels(Vec<String>),
}

/// Check that every channel is connected and holds what it should, and that set points may be written within the limits.
///
/// # Errors
/// [`PreflightError`], all faults at once.
pub fn preflight(control: &mut impl Control, plan: &Plan) -> Result<(), PreflightError> {
    let read = plan.channels.of_a_frame();
    let set = plan.set_points();
    let names: Vec<&str> =
        read.iter().copied().chain(set.iter().map(|set| set.read)).chain(set.iter().map(|set| set.write)).collect();
    let channels = control.describe(&names)?;
    let mut wrong = Vec::new();
    let mut known: Vec<(&str, &Channel)> = names.iter().copied().zip(&channels).collect();
    known.dedup_by_key(|(name, _)| *name);
    for (name, channel) in &known {
        match (channel.connected, channel.readable) {
            (false, _) => wrong.push(format!("{name}: not connected")),
            (_, false) => wrong.push(format!("{name}: may not be read")),
            _ => {}
        }
    }
    let of = |name: &str| {
        known.iter().find(|(known, channel)| *known == name && channel.connected).map(|(_, channel)| *channel)
    };
    for waveform in &plan.channels.monitors {
        let (need, count) = (waveform.monitors.len(), of(&waveform.name).map(|channel| channel.count));
        if count.is_some_and(|count| count != need) {
            wrong.push(format!("{}: expected {need} numbers, found {}", waveform.name, count.unwrap_or(0)));
        }
    }
    for set in &set {
        let Some(channel) = of(set.write) else { continue };
        if !channel.writable {
            wrong.push(format!("{}: may not be written", set.write));
        }
        let [low, high] = set.range;
        if let Some([lowest, highest]) = channel.limits.filter(|[lowest, highest]| low < *lowest || high > *highest) {
            wrong.push(format!("{}: takes {lowest} to {highest}, the plan needs {low} to {high}", set.write));
        }
    }
    wrong.sort();
    wrong.dedup();
    if wrong.is_empty() { Ok(()) } else { Err(PreflightError::Channels(wrong)) }
}

/// A set point that the plan writes, and its read-back.
#[derive(Debug, Clone, PartialEq)]
pub struct SetPoint<'p> {
    /// Channel that is written.
    pub write: &'p str,
    /// Channel that follows.
    pub read: &'p str,
    /// What is written, smallest and largest; of the RF frequency its limits.
    pub range: [f64; 2],
    /// Largest distance of the read-back.
    pub tolerance: f64,
    /// Limits of the plan.
    pub limits: [f64; 2],
}

impl Plan {
    /// The set points that are written, each once.
    pub fn set_points(&self) -> Vec<SetPoint<'_>> {
        let mut all: Vec<SetPoint> = Vec::new();
        for step in &self.steps {
            let Some(set) = self.set_point(step) else { continue };
            match all.iter_mut().find(|known| known.write == set.write) {
                Some(known) => {
                    known.range = [known.range[0].min(set.range[0]), known.range[1].max(set.range[1])];
                }
                None => all.push(set),
            }
        }
        all
    }

    /// The set point of a step; none if the machine has no such device.
    pub fn set_point(&self, step: &Step) -> Option<SetPoint<'_>> {
        match step {
            Step::Corrector { corrector, current } => {
                let c = self.corrector_names.iter().position(|name| name == corrector)?;
                Some(SetPoint {
                    write: &self.channels.corrector_set[c],
                    read: &self.channels.corrector_read[c],
                    range: [*current; 2],
                    tolerance: self.corrector_tolerance,
                    limits: self.corrector_limits,
                })
            }
            Step::Rf { .. } => {
                let [write, read] = self.channels.rf.as_ref()?;
                Some(SetPoint {
                    write,
                    read,
                    range: self.rf_limits,
                    tolerance: self.rf_tolerance,
                    limits: self.rf_limits,
                })
            }
        }
    }
}
