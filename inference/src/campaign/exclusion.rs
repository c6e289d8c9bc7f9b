//! Which readings count, and why the others do not.
//!
//! One table serves all stages. The screening begins it, and the diagnosis lifts what the noise explains and adds what no fit explains.

use std::collections::BTreeMap;

use nalgebra::DMatrix;

/// Why a reading does not count.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Excluded {
    /// The monitor did not report in this frame.
    Missing,
    /// It did not, and ended dead.
    Dead,
    /// It repeats its value, or reads only its own electronics.
    Stuck,
    /// The frame had no beam, or one that went astray.
    LostBeam,
    /// Repeats of the setting, or the model where there are none, contradict it.
    Jump,
    /// It surprised the model, and no repeat has confirmed it.
    Unconfirmed,
    /// A reading of a faulty monitor that lies far from the fit.
    Poor,
}

/// Why readings do not count, rows frames, columns monitors.
#[derive(Debug, Clone, PartialEq)]
pub struct Exclusions {
    reasons: DMatrix<Option<Excluded>>,
}

impl Excluded {
    /// As results call it.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Missing => "missing",
            Self::Dead => "dead",
            Self::Stuck => "stuck",
            Self::LostBeam => "lost_beam",
            Self::Jump => "jump",
            Self::Unconfirmed => "unconfirmed",
            Self::Poor => "poor",
        }
    }

    /// True if there is no reading.
    const fn is_missing(self) -> bool {
        matches!(self, Self::Missing | Self::Dead)
    }
}

impl Exclusions {
    /// Every reading counts, rows frames, columns monitors; those that are not a number are missing.
    pub fn from_readings(readings: &DMatrix<f64>) -> Self {
        Self { reasons: readings.map(|reading| reading.is_nan().then_some(Excluded::Missing)) }
    }

    /// Numbers of frames and monitors.
    pub fn size(&self) -> (usize, usize) {
        self.reasons.shape()
    }

    /// True if a reading counts.
    pub fn counts(&self, frame: usize, b: usize) -> bool {
        self.reasons[(frame, b)].is_none()
    }

    /// True if a reading was put aside: it is there, and does not count.
    pub fn is_aside(&self, frame: usize, b: usize) -> bool {
        self.reasons[(frame, b)].is_some_and(|reason| !reason.is_missing())
    }

    /// Which readings count.
    pub fn counting(&self) -> DMatrix<bool> {
        self.reasons.map(|reason| reason.is_none())
    }

    /// Of a monitor, the number of readings left out for each reason that occurs.
    ///
    /// ```
    /// use inference::{Excluded, Exclusions};
    ///
    /// let mut exclusions = Exclusions::from_readings(&nalgebra::dmatrix![1e-3; f64::NAN; 9e-3]);
    /// exclusions.exclude(2, 0, Excluded::Jump);
    /// let reasons: Vec<_> = exclusions.tally(0).into_iter().collect();
    /// assert_eq!(reasons, [(Excluded::Missing, 1), (Excluded::Jump, 1)]);
    /// ```
    pub fn tally(&self, b: usize) -> BTreeMap<Excluded, usize> {
        let mut tally = BTreeMap::new();
        self.reasons.column(b).iter().flatten().for_each(|reason| *tally.entry(*reason).or_default() += 1);
        tally
    }

    /// [`Exclusions::tally`] of every monitor.
    pub fn tallies(&self) -> Vec<BTreeMap<Excluded, usize>> {
        (0..self.reasons.ncols()).map(|b| self.tally(b)).collect()
    }

    /// Leave a reading out. The first reason stays, unless it is that nothing has confirmed the reading.
    pub fn exclude(&mut self, frame: usize, b: usize, reason: Excluded) {
        let known = &mut self.reasons[(frame, b)];
        if matches!(known, None | Some(Excluded::Unconfirmed)) {
            *known = Some(reason);
        }
    }

    /// Leave out what a frame has.
    pub fn exclude_frame(&mut self, frame: usize, reason: Excluded) {
        (0..self.reasons.ncols()).for_each(|b| self.exclude(frame, b, reason));
    }

    /// Leave out what a monitor has read.
    pub fn exclude_monitor(&mut self, b: usize, reason: Excluded) {
        (0..self.reasons.nrows()).for_each(|frame| self.exclude(frame, b, reason));
    }

    /// Let a reading count again.
    ///
    /// # Panics
    /// If there is none.
    pub fn lift(&mut self, frame: usize, b: usize) {
        let known = &mut self.reasons[(frame, b)];
        assert!(!known.is_some_and(Excluded::is_missing), "only what was read can count");
        *known = None;
    }

    /// What a dead monitor did not report.
    pub(super) fn set_dead(&mut self, b: usize) {
        let missing = self.reasons.column_mut(b).into_iter().filter(|reason| **reason == Some(Excluded::Missing));
        missing.for_each(|reason| *reason = Some(Excluded::Dead));
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::dmatrix;

    use super::*;

    #[test]
    fn the_first_reason_stays_unless_it_is_a_doubt() {
        let mut exclusions = Exclusions::from_readings(&dmatrix![1.0, f64::NAN; 2.0, 3.0]);
        exclusions.exclude(0, 0, Excluded::Unconfirmed);
        exclusions.exclude(0, 0, Excluded::Jump);
        exclusions.exclude_frame(0, Excluded::LostBeam);
        exclusions.exclude_frame(1, Excluded::LostBeam);
        use Excluded::{Dead, Jump, LostBeam, Missing};
        assert_eq!(exclusions.reasons, dmatrix![Some(Jump), Some(Missing); Some(LostBeam), Some(LostBeam)]);
        exclusions.lift(1, 1);
        exclusions.set_dead(1);
        assert_eq!(exclusions.reasons, dmatrix![Some(Jump), Some(Dead); Some(LostBeam), None]);
        assert_eq!(exclusions.counting(), dmatrix![false, false; false, true]);
        assert!(exclusions.is_aside(0, 0) && !exclusions.is_aside(0, 1) && !exclusions.is_aside(1, 1));
    }

    #[test]
    #[should_panic = "only what was read can count"]
    fn what_was_not_read_never_counts() {
        Exclusions::from_readings(&dmatrix![f64::NAN]).lift(0, 0);
    }
}
