//! Which frames have come, and how much time has passed between them.

use super::IngestError;
use crate::state::{Blank, state};
use crate::wire::Frame;

/// Numbers up to this much larger are later ones; what is further ahead is behind, since numbers wrap.
const LATER: u32 = i32::MAX as u32;
/// Time from one cycle to the next where no clock tells [s].
const PERIOD: f32 = 1.0;
/// Microseconds in a second.
const SECOND: f32 = 1e6;

/// Which cycle a frame is of, and when it was.
#[derive(Debug, Clone, Copy)]
struct Cycle {
    epoch: u32,
    sequence: u32,
    time_us: u64,
}

state!([] Cycle { epoch, sequence, time_us });

impl Blank for Cycle {
    const BLANK: Self = Self { epoch: 0, sequence: 0, time_us: 0 };
}

impl Cycle {
    /// Cycles from this one to a later one: their difference, which wraps. In a new epoch nobody has counted them: one.
    fn before(&self, later: &Self) -> Result<u32, IngestError> {
        let (last, got) = (self.sequence, later.sequence);
        let [epochs, cycles] = [later.epoch.wrapping_sub(self.epoch), got.wrapping_sub(last)];
        match (epochs, cycles) {
            (0, 0) => Err(IngestError::Repeated { sequence: last }),
            (0, 1..=LATER) => Ok(cycles),
            (1..=LATER, _) => Ok(1),
            _ => Err(IngestError::OutOfOrder { last, got }),
        }
    }
}

/// The frames so far.
#[derive(Debug, Clone)]
pub(super) struct Sequence {
    last: Option<Cycle>,
    /// Frames that were taken in.
    pub frames: u32,
    /// Frames that were refused.
    pub rejected: u32,
    /// Time from one cycle to the next, once the clock has told [s].
    period: Option<f32>,
}

state!([] Sequence { last, frames, rejected, period });

impl Sequence {
    /// None so far.
    pub const EMPTY: Self = Self { last: None, frames: 0, rejected: 0, period: None };

    /// Take the next frame as new, whatever its number.
    pub fn forget(&mut self) {
        self.last = None;
    }

    /// Refuse a frame that has come before, or after a later one.
    pub fn check<const B: usize, const C: usize, const F: usize, const W: usize>(
        &self,
        frame: &Frame<B, C, F, W>,
    ) -> Result<(), IngestError> {
        self.last.map_or(Ok(()), |last| last.before(&cycle(frame)).map(drop))
    }

    /// Count a frame; returns the time since the one before [s].
    ///
    /// The frames' clock tells it. Where that has not advanced, or counts from an epoch of its own, the numbers do, at the
    /// period of the frames before.
    pub fn advance<const B: usize, const C: usize, const F: usize, const W: usize>(
        &mut self,
        frame: &Frame<B, C, F, W>,
    ) -> f32 {
        self.frames = self.frames.saturating_add(1);
        let this = cycle(frame);
        let Some(last) = self.last.replace(this) else { return 0.0 };
        let cycles = last.before(&this).unwrap_or(1) as f32;
        if last.epoch == this.epoch && this.time_us > last.time_us {
            let elapsed = (this.time_us - last.time_us) as f32 / SECOND;
            self.period = Some(elapsed / cycles);
            elapsed
        } else {
            cycles * self.period.unwrap_or(PERIOD)
        }
    }
}

fn cycle<const B: usize, const C: usize, const F: usize, const W: usize>(frame: &Frame<B, C, F, W>) -> Cycle {
    Cycle { epoch: frame.epoch, sequence: frame.sequence, time_us: frame.time_us }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mask::Mask;
    use crate::wire::{CurrentCode, MagnetCurrents, PositionCode, RfCode};

    fn frame([epoch, sequence]: [u32; 2], time_us: u64) -> Frame<1, 1, 1, 1> {
        Frame {
            epoch,
            sequence,
            time_us,
            cycle_time_us: 0,
            corrector: [CurrentCode::default()],
            magnets: MagnetCurrents { dipole: CurrentCode::default(), supply: [CurrentCode::default()] },
            rf_offset: RfCode::default(),
            reading: [PositionCode::default()],
            tune: [None; 2],
            intensity: None,
            valid: Mask::NONE,
        }
    }

    #[test]
    fn numbers_wrap_and_a_new_epoch_counts_anew() {
        let before = |from: [u32; 2], to: [u32; 2]| cycle(&frame(from, 0)).before(&cycle(&frame(to, 0)));
        assert_eq!(before([0, 7], [0, 9]), Ok(2));
        assert_eq!(before([0, u32::MAX], [0, 1]), Ok(2));
        assert_eq!(before([0, 9], [0, 9]), Err(IngestError::Repeated { sequence: 9 }));
        assert_eq!(before([0, 9], [0, 7]), Err(IngestError::OutOfOrder { last: 9, got: 7 }));
        // a number out of the blue: the stream goes on after it
        assert_eq!(before([0, 9], [0, u32::MAX]), Err(IngestError::OutOfOrder { last: 9, got: u32::MAX }));
        assert_eq!(before([1, 900], [2, 0]), Ok(1));
        assert_eq!(before([u32::MAX, 900], [0, 900]), Ok(1));
        assert_eq!(before([2, 0], [1, 901]), Err(IngestError::OutOfOrder { last: 0, got: 901 }));
    }

    #[test]
    fn time_is_that_of_the_clock_and_without_one_that_of_the_numbers() {
        let mut sequence = Sequence::EMPTY;
        let mut since = |cycle, ms: u64| sequence.advance(&frame(cycle, 1000 * ms));
        assert_eq!([since([0, 0], 0), since([0, 1], 100), since([0, 2], 190)], [0.0, 0.1, 0.09]);
        assert_eq!([since([0, 3], 300), since([0, 5], 500)], [0.11, 0.2]);
        // the clock is set back, and another epoch's is another one
        assert!((since([0, 8], 100) - 0.3).abs() < 1e-6);
        assert!((since([1, 0], 9_000_000) - 0.1).abs() < 1e-6);
    }
}
