//! When the setpoints stay as they are, and why.

use core::fmt;

use serde::{Deserialize, Serialize};

use crate::judged::{Judged, is_surprising, most};

/// Why a frame moves no corrector.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
#[repr(u8)] // from 1 on: none is 0 then, and a state of all zero takes no flash
pub enum Hold {
    /// The first frame, the first after too long a silence, or the first of another time in the cycle: where the correctors and the
    /// orbit are is only learnt by it.
    Stale = 1,
    /// The frame was put aside: no beam, or one that the model does not know.
    PutAside,
    /// The estimate is not that of a positive information.
    Unsolved,
    /// The readings are further from the prediction than chance explains.
    Surprising,
    /// They have been, on average, for many frames: model and machine disagree.
    Mismatch,
    /// Fewer than half of the monitors can be used.
    Blind,
    /// The gains are not made yet.
    Unprepared,
}

impl Hold {
    /// As a number, from 1 on.
    pub fn code(self) -> u8 {
        self as u8
    }

    /// True where the readings contradict the model: without kicks nothing would tell which of them is wrong.
    pub fn is_doubt(self) -> bool {
        matches!(self, Self::PutAside | Self::Surprising | Self::Mismatch)
    }
}

impl fmt::Display for Hold {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Stale => "first frame after a silence",
            Self::PutAside => "no beam that the model knows",
            Self::Unsolved => "the estimate failed",
            Self::Surprising => "a surprising frame",
            Self::Mismatch => "model and machine disagree",
            Self::Blind => "too few monitors",
            Self::Unprepared => "the gains are not made yet",
        })
    }
}

/// Share of a frame in the running mean of NIS over readings.
const SHARE: f32 = 1.0 / 64.0;
/// Running mean above which model and machine disagree; that of a true model is 1.00 ± 0.02.
const DISAGREES: f32 = 3.0;
/// One in so many monitors must be of use.
const BLIND: usize = 2;

/// The running mean of NIS over readings, less 1.
#[derive(Debug, Clone, Copy)]
pub struct Watch(f32);

impl Watch {
    /// None so far.
    pub const BLANK: Self = Self(0.0);

    /// Judge a frame.
    pub fn judge<const B: usize, const C: usize, const F: usize, const W: usize>(
        &mut self,
        is_stale: bool,
        is_ready: bool,
        judged: &Judged<B, C, F, W>,
        monitors: usize,
    ) -> Option<Hold> {
        let (used, nis) = (judged.screened.accepted.count(), judged.nis);
        if !judged.remarks.put_aside && used > 0 {
            // a single frame of any size moves the mean no further than a surprising one
            let expected = used as f32;
            self.0 += SHARE * (nis.min(most(used)) / expected - 1.0 - self.0);
        }
        let reasons = [
            (is_stale, Hold::Stale),
            (judged.remarks.put_aside, Hold::PutAside),
            (judged.remarks.unsolved || !nis.is_finite(), Hold::Unsolved),
            (is_surprising(nis, used), Hold::Surprising),
            (1.0 + self.0 > DISAGREES, Hold::Mismatch),
            (BLIND * (used as usize) < monitors, Hold::Blind),
            (!is_ready, Hold::Unprepared),
        ];
        reasons.into_iter().find(|(holds, _)| *holds).map(|(_, hold)| hold)
    }
}
