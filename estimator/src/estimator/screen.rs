//! Which readings of a good frame are used: what their repeats say, and where there are none, the model.

use super::whole::Whole;
use super::{Estimator, Model};
use crate::campaign::{Beside, Cell, Moved, Verdict, before_last, is_moved};
use crate::drive::Drive;
use crate::judged::{Expected, Screened};
use crate::monitor::Monitor;
use crate::surrogate::Surrogate;
use crate::wire::{Frame, PositionCode};

/// Information that a frame adds, up to which the params' uncertainty is none of a reading's business [nat]: shared by 33 readings
/// it makes 1.5 % of their noise.
const NARROWS: f64 = 0.5;

impl<
    G: Surrogate<B, C, F, N>,
    const B: usize,
    const C: usize,
    const F: usize,
    const N: usize,
    const S: usize,
    const K: usize,
    const T: usize,
    const U: usize,
    const W: usize,
> Estimator<G, B, C, F, N, S, K, T, U, W>
{
    /// Decide which readings to use, and learn each monitor's noise from its repeats.
    #[inline(never)]
    pub(super) fn screen(
        &mut self,
        model: &Model<'_, G, B, C, F>,
        frame: &Frame<B, C, F, W>,
        drive: &Drive<C, F>,
        cell: Option<u16>,
        whole: Whole,
        expected: &Expected<B, W>,
    ) -> Screened<W> {
        let mut screened = Screened::default();
        let within = &expected.within;
        let tells_noise = cell.is_none() && self.tells_noise(frame, expected);
        let is_lone = self.is_expected_but_for_a_few(frame, expected);
        for b in 0..B {
            let Some(code) = frame.reading.get(b).map(|r| r.steps()) else { continue };
            let valid = frame.valid.has(b);
            let usable = self.monitors.get_mut(b).is_some_and(|m| m.hear(valid.then_some(code)));
            if usable {
                match cell {
                    Some(index) => {
                        self.screen_repeat(model, b, code, (index, within.has(b), is_lone), &mut screened);
                    }
                    None => self.screen_loose(b, whole == Whole::Persists || within.has(b), &mut screened),
                }
                if tells_noise {
                    self.learn_alone(b, expected);
                }
            }
            if self.monitors.get_mut(b).is_some_and(Monitor::judge) {
                self.past.stale = true;
            }
        }
        for b in 0..B {
            let expected = self.follows(model, b);
            self.following.get_mut(b).into_iter().for_each(|following| following.learn(&expected));
        }
        self.screen_tunes(model, frame, drive, &mut screened);
        screened
    }

    /// True if the surprises of a frame that repeats nothing tell the noise of its monitors: not while the params' own uncertainty
    /// counts. What they all share is taken note of.
    fn tells_noise(&mut self, frame: &Frame<B, C, F, W>, expected: &Expected<B, W>) -> bool {
        if self.posterior.narrowed > NARROWS {
            return false;
        }
        let over_sigma = |(b, _): (usize, &Monitor)| {
            let sigma = libm::sqrtf(*expected.certain.get(b)?);
            Some(expected.surprise.get(b)? / sigma)
        };
        let mut peers = self.peers.clone();
        peers.hear(self.alive(frame).filter_map(over_sigma));
        self.peers = peers;
        true
    }

    /// Learn a monitor's noise from its surprise, less what all monitors share.
    fn learn_alone(&mut self, b: usize, expected: &Expected<B, W>) {
        let noise = self.noise_variance(b);
        if let (Some(monitor), Some(surprise), Some(certain)) =
            (self.monitors.get_mut(b), expected.surprise.get(b), expected.certain.get(b))
        {
            // the share of it that is the monitor's own
            monitor.noise.learn_alone(surprise * libm::sqrtf(noise / certain) / self.peers.scale());
        }
    }

    /// Tunes count where the RF is not moved, since what the chromaticity makes of them then is not in the model, and once they are linear
    /// in what is not known of the params.
    fn screen_tunes(
        &mut self,
        model: &Model<'_, G, B, C, F>,
        frame: &Frame<B, C, F, W>,
        drive: &Drive<C, F>,
        screened: &mut Screened<W>,
    ) {
        if model.setup.tune_calibration.is_none() || is_moved(frame.rf_offset) {
            return;
        }
        for (plane, code) in frame.tune.iter().enumerate() {
            let Some(code) = code else { continue };
            let is_linear = self.is_linear(model, plane);
            let Some(meter) = self.tunes.get_mut(plane) else { continue };
            let predicted = |strength: &[f32; F]| model.surrogate.tune(&self.tangent.linearised, plane, strength).0;
            let ripple = |change: &[f32; F]| predicted(change) - predicted(&[0.0; F]);
            let counts = meter.hear(*code, &drive.strength, model.setup.gate, ripple) && is_linear;
            // with it, or without it, all tunes so far
            self.past.stale |= core::mem::replace(&mut meter.is_linear, is_linear) != is_linear;
            self.past.stale |= meter.judge();
            let innovation = self.tangent.tune_innovation(model, plane, code.value(), &drive.strength);
            screened.tune.get_mut(plane).into_iter().for_each(|to| *to = counts.then_some(innovation));
        }
    }

    /// A reading in a setting is judged by its repeats, the first one by the model.
    fn screen_repeat(
        &mut self,
        model: &Model<'_, G, B, C, F>,
        b: usize,
        code: i32,
        (index, expected, is_lone): (u16, bool, bool),
        screened: &mut Screened<W>,
    ) {
        let moved = self.moved_to_mean_drive(b, code, index);
        let (Some(monitor), Some(cell)) = (self.monitors.get_mut(b), self.past.campaign.cell_mut(index)) else {
            return;
        };
        if let Some(difference) = cell.difference(b, moved.before) {
            monitor.noise.learn(difference);
        }
        let beside = Beside { expected, is_lone, jumps: monitor.jumps(), is_told: monitor.noise.is_told() };
        let waited = cell.waiting(b);
        let verdict = cell.judge(b, moved.before, monitor.noise.sigma(), model.setup.gate, beside);
        let (following, off_mean) = (self.following.get_mut(b), &self.predicted.off_mean);
        if let Some(following) = following {
            let variance = f64::from(monitor.variance());
            cell.take(b, code, moved, verdict, |deviation, n| {
                screened.scatter += following.add_repeat(deviation, off_mean, n) / variance;
            });
        }
        match verdict {
            Verdict::Accepted => {}
            Verdict::Confirms { .. } => monitor.pardon(waited),
            Verdict::Held { .. } => monitor.reject(),
        }
        screened.note(b, verdict);
    }

    /// A reading without a setting passes if the model expects it.
    fn screen_loose(&mut self, b: usize, expected: bool, screened: &mut Screened<W>) {
        let verdict = if expected { Verdict::Accepted } else { Verdict::Held { agreeing: 1 } };
        if let (Verdict::Held { .. }, Some(monitor)) = (verdict, self.monitors.get_mut(b)) {
            monitor.reject();
        }
        screened.note(b, verdict);
    }

    /// A reading as the mean drive of its setting would have made it, in steps.
    fn moved_to_mean_drive(&self, b: usize, code: i32, index: u16) -> Moved {
        let shift = match (self.predicted.at_mean_drive.get(b), self.predicted.prediction.reading.get(b)) {
            (Some(mean), Some(this)) => mean - this,
            _ => 0.0,
        };
        let moved = |shift: f32| {
            let moved = code.saturating_add(libm::roundf(shift / PositionCode::METRES_PER_LSB) as i32);
            moved.clamp(-PositionCode::LIMIT, PositionCode::LIMIT)
        };
        let after = moved(shift);
        match self.past.campaign.cells().get(usize::from(index)).map(Cell::frames) {
            // the frame has moved the mean drive by the share of it that nobody notices elsewhere
            Some(n @ 2..) if self.past.reference.scatters() => Moved { before: moved(shift * before_last(n)), after },
            _ => Moved { before: after, after },
        }
    }
}
