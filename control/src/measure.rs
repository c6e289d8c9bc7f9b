//! A plan carried out: every setting made and read, the machine put back, a recording.

use inference::Recording;

use crate::channel::Control;
use crate::frame::Frame;
use crate::journal::Journal;
use crate::plan::Plan;
use crate::restore::RestoreError;
use crate::session::{Progress, Session, SessionError};

/// Why there is no recording.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum MeasureError {
    /// It ended early; the machine is as it was.
    #[error("{0}; the machine is back at its settings")]
    Ended(Box<SessionError>),
    /// It ended early, and the machine may not be as it was.
    #[error("{0}; {1}")]
    Left(Box<SessionError>, RestoreError),
    /// All frames were taken, and the machine may not be as it was.
    #[error("all frames are taken; {0}")]
    NotBack(#[from] RestoreError),
}

/// Carry out what the journal lacks of a plan. However it ends, the machine is put back first.
///
/// # Errors
/// [`MeasureError`], which says whether the machine is as it was.
pub fn measure(
    control: &mut impl Control,
    plan: &Plan,
    journal: &mut Journal,
    stop: &dyn Fn() -> bool,
    progress: impl FnMut(Progress),
) -> Result<(), MeasureError> {
    let mut session = Session { control, plan, journal, stop, seen: None, moved: None, back: false };
    let taken = session.take_all(progress);
    match (taken, session.put_back()) {
        (Ok(()), Ok(_)) => Ok(()),
        (Ok(()), Err(left)) => Err(left.into()),
        (Err(ended), Ok(_)) => Err(MeasureError::Ended(ended.into())),
        (Err(ended), Err(left)) => Err(MeasureError::Left(ended.into(), left)),
    }
}

/// The recording of a journal whose frames are complete: those of the plan's settings, in the order of time.
///
/// The counter of a machine that was restarted in between goes on from the cycle before.
pub fn recording(plan: &Plan, journal: &Journal, name: &str) -> Recording {
    let taken = journal.frames().filter(|(step, _)| plan.steps.contains(step));
    let mut frames: Vec<_> = taken.flat_map(|(step, frames)| frames.iter().map(move |frame| (step, frame))).collect();
    frames.sort_by(|one, other| one.1.time_s.total_cmp(&other.1.time_s));
    let began = frames.first().map_or(0.0, |(_, frame)| frame.time_s);
    let numbers = numbered(frames.iter().map(|(_, frame)| *frame));
    let rows = frames.iter().zip(numbers).map(|((step, frame), number)| frame.row(step, plan, number, began)).collect();
    Recording { name: name.into(), header: plan.header.clone(), other: Vec::new(), rows }
}

/// Rising numbers of frames: those of their cycles, moved on where the counter began anew.
fn numbered<'f>(frames: impl Iterator<Item = &'f Frame>) -> Vec<u32> {
    let (mut last, mut moved): (Option<u32>, u32) = (None, 0);
    let number = |frame: &Frame| {
        if let Some(last) = last.filter(|last| frame.cycle.wrapping_add(moved) <= *last) {
            moved = last.wrapping_add(1).wrapping_sub(frame.cycle);
        }
        last = Some(frame.cycle.wrapping_add(moved));
        frame.cycle.wrapping_add(moved)
    };
    frames.map(number).collect()
}
