//! Which readings of a frame are used: what their repeats say, and where there are none, the model.

use super::{Estimator, Model, UNDERWEIGHT};
use crate::campaign::Verdict;
use crate::frame::{Frame, PositionCode};
use crate::linear::dot;
use crate::monitor::Monitor;
use crate::surrogate::Surrogate;

/// Which readings of a frame are used.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Screened {
    pub accepted: u64,
    pub rejected: u64,
    pub confirmed: u64,
    pub restarted: u64,
}

impl Screened {
    fn note(&mut self, b: usize, verdict: Verdict) {
        let bit = 1 << b;
        match verdict {
            Verdict::Accepted => self.accepted |= bit,
            Verdict::Held => self.rejected |= bit,
            Verdict::Confirms { outvotes } => {
                self.accepted |= bit;
                self.confirmed |= bit;
                self.restarted |= if outvotes { bit } else { 0 };
            }
        }
    }
}

/// Frames in a row that must surprise all over before the model is at fault, and not the beam.
const CONVINCED: u32 = 3;

impl<G: Surrogate<B, C, N>, const B: usize, const C: usize, const N: usize, const S: usize, const T: usize>
    Estimator<G, B, C, N, S, T>
{
    /// Decide which readings to use, and learn each monitor's noise from its repeats.
    #[inline(never)]
    pub(super) fn screen(&mut self, model: &Model<'_, G>, frame: &Frame<B, C>, cell: Option<u16>) -> Screened {
        let mut screened = Screened::default();
        for b in 0..B {
            let Some(code) = frame.reading.get(b).map(|r| r.steps()) else { continue };
            let valid = frame.is_valid(b);
            let usable = self.monitors.get_mut(b).is_some_and(|m| m.hear(valid.then_some(code)));
            if usable {
                match cell {
                    Some(index) => self.screen_repeat(model, b, code, index, &mut screened),
                    None => self.screen_loose(model, b, code, &mut screened),
                }
            }
            if self.monitors.get_mut(b).is_some_and(Monitor::judge) {
                self.stale = true;
            }
        }
        if cell.is_none() {
            self.excuse(&mut screened);
        }
        screened
    }

    /// Monitors fail one at a time: when more than an eighth of a frame without a setting surprises, the beam was lost or
    /// the model is at fault. A lost beam is soon over: the third such frame in a row is used, all of it, the ones before
    /// are not. (In a setting the repeats decide.)
    fn excuse(&mut self, screened: &mut Screened) {
        let (accepted, rejected) = (screened.accepted.count_ones(), screened.rejected.count_ones());
        if 8 * rejected <= accepted + rejected {
            self.surprises = 0;
            return;
        }
        let each = self.monitors.iter_mut().enumerate();
        each.filter(|(b, _)| screened.rejected >> b & 1 == 1).for_each(|(_, monitor)| monitor.pardon());
        let all = screened.accepted | screened.rejected;
        self.surprises = self.surprises.saturating_add(1);
        (screened.accepted, screened.rejected) = if self.surprises >= CONVINCED { (all, 0) } else { (0, all) };
    }

    /// A reading in a setting is judged by its repeats, the first one by the model.
    fn screen_repeat(&mut self, model: &Model<'_, G>, b: usize, code: i32, index: u16, screened: &mut Screened) {
        let (expected, moved) = (self.is_expected(model, b, code), self.moved_to_mean_drive(b, code));
        let (Some(monitor), Some(cell)) = (self.monitors.get_mut(b), self.campaign.cell_mut(index)) else { return };
        if let Some(difference) = cell.difference(b, moved) {
            monitor.noise.learn(difference);
        }
        let verdict = cell.judge(b, moved, monitor.noise.sigma(), model.setup.gate, expected);
        let scatter = cell.take(b, code, moved, verdict);
        match verdict {
            Verdict::Accepted => {}
            Verdict::Confirms { .. } => monitor.pardon(),
            Verdict::Held => monitor.reject(),
        }
        screened.note(b, verdict);
        self.campaign.add_scatter(b, scatter);
    }

    /// A reading without a setting passes if the model expects it.
    fn screen_loose(&mut self, model: &Model<'_, G>, b: usize, code: i32, screened: &mut Screened) {
        let verdict = if self.is_expected(model, b, code) { Verdict::Accepted } else { Verdict::Held };
        if let (Verdict::Held, Some(monitor)) = (verdict, self.monitors.get_mut(b)) {
            monitor.reject();
        }
        screened.note(b, verdict);
    }

    /// True if the model, with all its uncertainty, expects a reading.
    fn is_expected(&self, model: &Model<'_, G>, b: usize, code: i32) -> bool {
        let (d, baseline_variance) = self.gaussian.effective(b, self.slope(b));
        let predicted = self.gaussian.baseline(b) + dot(&d, &self.solution.delta);
        let surprise = self.innovation(b, code) - predicted;
        let certain = self.variance(model, b, 1, self.rf_offset) + baseline_variance;
        // the uncertainty of the params is only worked out for readings that need it
        model.setup.gate.expects(surprise, certain)
            || model.setup.gate.expects(surprise, certain + (1.0 + UNDERWEIGHT) * self.solution.variance_of(&d))
    }

    /// A reading as the mean drive of its setting would have made it, in steps.
    fn moved_to_mean_drive(&self, b: usize, code: i32) -> i32 {
        let shift = match (self.at_mean_drive.get(b), self.prediction.reading.get(b)) {
            (Some(mean), Some(this)) => mean - this,
            _ => 0.0,
        };
        let moved = code.saturating_add(libm::roundf(shift / PositionCode::METRES_PER_LSB) as i32);
        moved.clamp(-PositionCode::LIMIT, PositionCode::LIMIT)
    }
}
