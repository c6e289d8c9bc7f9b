//! A frame as a whole, before any of it counts: is there a beam in it that the model knows?

use super::{Estimator, Model, UNDERWEIGHT};
use crate::campaign::Setting;
use crate::estimate::MonitorState;
use crate::judged::{Expected, Judged, is_surprising};
use crate::mask::Mask;
use crate::monitor::Monitor;
use crate::quarantine::{Quarantine, Shift};
use crate::state::state;
use crate::surrogate::Surrogate;
use crate::wire::Frame;

/// One in so many monitors may surprise before the whole frame is in doubt: they fail one at a time.
const FEW: u32 = 8;
/// A beam of less than one part in so many of the largest lately is lost.
const LOST: i64 = 100;
/// The largest lately is forgotten by one part in `2^6` a frame: a wrong reading of it is overcome in some hundred frames.
const FORGOTTEN: u32 = 6;
/// An orbit resembles the one expected if the squares of the surprises are at most one part in so many of its own.
const RESEMBLES: f32 = 4.0;

/// Mean square of the surprises within the gate, over their variance, above which they surprise together; by chance the mean of 33
/// is 1.00 ± 0.25.
const TOGETHER: f64 = 3.0;

/// What a frame is as a whole.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Whole {
    /// Its readings are judged one by one.
    Good,
    /// The same, once the baselines are where its readings and those of the frames before say.
    Moved,
    /// Most of it surprises, as for many frames before: the model is at fault, and where no repeat tells, all readings count.
    Persists,
    /// None of its readings counts.
    Aside,
}

/// What is kept of the frames so far to judge the next one by.
#[derive(Debug, Clone)]
pub(super) struct WholeFrames<const B: usize> {
    /// Frames put aside since the last good one.
    quarantine: Quarantine<B>,
    /// Largest beam intensity lately, in steps.
    most_intense: i32,
}

state!([const B: usize] WholeFrames<B> { quarantine, most_intense });

impl<const B: usize> WholeFrames<B> {
    /// None so far.
    pub const NONE: Self = Self { quarantine: Quarantine::EMPTY, most_intense: 0 };
}

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
    /// True if the repeats of a setting decide on a whole frame, and not the model: while all frames have seen the same ring, or where
    /// something is driven, whose response may be wrong in detail. Where nothing is, an orbit that has moved is not to be taken for
    /// a change of the vars, however little it surprises each monitor.
    pub(super) fn repeats_decide(&self, model: &Model<'_, G, B, C, F>, setting: &Setting) -> bool {
        setting.is_driven() || self.posterior.is_still(&model.setup.walk)
    }

    /// Judge a frame as a whole, and put it aside if need be.
    #[inline(never)]
    pub(super) fn judge_whole(
        &mut self,
        model: &Model<'_, G, B, C, F>,
        frame: &Frame<B, C, F, W>,
        repeats_decide: bool,
    ) -> (Whole, Expected<B, W>) {
        let expected = self.expected(model, frame);
        if self.is_beam_lost(frame) {
            return (Whole::Aside, expected);
        }
        // the repeats decide of an orbit that might be one
        let is_expected = self.is_expected_but_for_a_few(frame, &expected)
            && (repeats_decide || self.is_expected_together(frame, &expected));
        if is_expected || (repeats_decide && self.resembles(frame, &expected)) {
            self.whole.quarantine.clear();
            return (Whole::Good, expected);
        }
        self.put_aside(frame, &expected);
        let variance = |b: usize| self.noise_variance(b);
        if let Some(shift) = self.whole.quarantine.shift(variance) {
            self.whole.quarantine.clear();
            self.move_baselines(&shift);
            return (Whole::Moved, self.expected(model, frame));
        }
        (if self.whole.quarantine.persists() { Whole::Persists } else { Whole::Aside }, expected)
    }

    /// What the model, with all its uncertainty, makes of each reading.
    fn expected(&self, model: &Model<'_, G, B, C, F>, frame: &Frame<B, C, F, W>) -> Expected<B, W> {
        let mut expected = Expected { surprise: [0.0; B], certain: [0.0; B], within: Mask::NONE };
        let each = expected.surprise.iter_mut().zip(&mut expected.certain).zip(&frame.reading).enumerate();
        for (b, ((to, to_certain), reading)) in each.filter(|(b, _)| frame.valid.has(*b)) {
            let channel = self.predicted.first_channel + b;
            let (predicted, baseline_variance) =
                self.posterior.gaussian.expected(channel, self.slope(b), &self.posterior.solution.delta);
            let surprise = f64::from(self.innovation(b, *reading)) - predicted;
            let certain = f64::from(
                self.own_variance(model, b, &self.predicted.strength)
                    + self.shared_variance(model, &self.tangent, b, self.predicted.rf_offset),
            ) + baseline_variance;
            let expects = |variance: f64| model.setup.gate.expects(surprise as f32, variance as f32);
            // the uncertainty of the params is only worked out for readings that need it
            let within = expects(certain) || expects(certain + (1.0 + UNDERWEIGHT) * self.variance_of_params(b));
            (*to, *to_certain) = (surprise as f32, certain as f32);
            expected.within.put(b, within);
        }
        expected
    }

    /// True if the front end counts particles, and hardly any are there.
    fn is_beam_lost(&mut self, frame: &Frame<B, C, F, W>) -> bool {
        let Some(intensity) = frame.intensity.map(|intensity| intensity.steps()) else { return false };
        self.whole.most_intense = intensity.max(self.whole.most_intense - (self.whole.most_intense >> FORGOTTEN));
        LOST * i64::from(intensity) <= i64::from(self.whole.most_intense)
    }

    /// Readings that count in a judgement of the whole: of monitors that report and are not dead.
    pub(super) fn alive(&self, frame: &Frame<B, C, F, W>) -> impl Iterator<Item = (usize, &Monitor)> {
        let valid = frame.valid;
        self.monitors.iter().enumerate().filter(move |(b, m)| valid.has(*b) && m.state() != MonitorState::Dead)
    }

    pub(super) fn is_expected_but_for_a_few(&self, frame: &Frame<B, C, F, W>, expected: &Expected<B, W>) -> bool {
        let (mut all, mut surprising) = (0, 0);
        for (b, _) in self.alive(frame) {
            all += 1;
            surprising += u32::from(!expected.within.has(b));
        }
        FEW * surprising <= all
    }

    /// True if the readings within the gate are not all near its edge: an orbit that has moved by three standard deviations
    /// everywhere surprises no single monitor, and would be taken for a change of the vars.
    fn is_expected_together(&self, frame: &Frame<B, C, F, W>, expected: &Expected<B, W>) -> bool {
        let mut counts = Mask::NONE;
        self.alive(frame).for_each(|(b, _)| counts.put(b, expected.within.has(b)));
        let most = TOGETHER * f64::from(counts.count());
        // the uncertainty of the params is only worked out for frames that need it
        self.squares(expected, &counts, 0.0) <= most || self.squares(expected, &counts, 1.0 + UNDERWEIGHT) <= most
    }

    /// Sum of the squares of surprises over their variances, each by itself, with a multiple of what the uncertainty of the params
    /// adds to these.
    fn squares(&self, expected: &Expected<B, W>, counts: &Mask<W>, uncertain: f64) -> f64 {
        let each = expected.surprise.iter().zip(&expected.certain).enumerate().filter(|(b, _)| counts.has(*b));
        let square = |(b, (surprise, certain)): (usize, (&f32, &f32))| {
            let own = if uncertain > 0.0 { uncertain * self.variance_of_params(b) } else { 0.0 };
            f64::from(surprise * surprise) / (f64::from(*certain) + own)
        };
        each.map(square).sum()
    }

    /// Normalised innovation squared of the readings used, each by itself, before they are learnt. Without the uncertainty of the
    /// params, unless the frame would surprise.
    pub(super) fn surprise(&self, judged: &Judged<B, C, F, W>) -> f32 {
        let used = &judged.screened.accepted;
        let certain = self.squares(&judged.expected, used, 0.0) as f32;
        if !is_surprising(certain, used.count()) {
            return certain;
        }
        self.squares(&judged.expected, used, 1.0) as f32
    }

    /// Variance that the params' uncertainty gives a prediction [m^2].
    fn variance_of_params(&self, b: usize) -> f64 {
        let channel = self.predicted.first_channel + b;
        self.posterior.solution.variance_of(&self.posterior.gaussian.effective(channel, self.slope(b)).0)
    }

    fn resembles(&self, frame: &Frame<B, C, F, W>, expected: &Expected<B, W>) -> bool {
        let (mut surprises, mut orbit) = (0.0, 0.0);
        for (b, _) in self.alive(frame) {
            if let (Some(surprise), Some(reading)) = (expected.surprise.get(b), frame.reading.get(b)) {
                surprises += surprise * surprise;
                orbit += (reading.value() - surprise) * (reading.value() - surprise);
            }
        }
        RESEMBLES * surprises <= orbit
    }

    fn put_aside(&mut self, frame: &Frame<B, C, F, W>, expected: &Expected<B, W>) {
        self.whole.quarantine.add();
        for (b, (surprise, reading)) in expected.surprise.iter().zip(&frame.reading).enumerate() {
            if frame.valid.has(b) {
                self.whole.quarantine.note(b, *surprise, reading.value());
            }
        }
    }

    /// Take the baselines as moved, by as much at each time in the cycle: all that was read before is moved with them.
    fn move_baselines(&mut self, shift: &[Shift; B]) {
        self.posterior.gaussian.move_baselines(shift, Self::TIMES);
        self.past.loose.move_baselines(shift, Self::TIMES);
        self.past.campaign.move_readings(&shift.map(|shift| shift.by));
        self.reopen_pool();
        for frame in &mut self.past.recent {
            frame.reading.iter_mut().zip(shift).for_each(|(reading, shift)| *reading = reading.moved(shift.by));
        }
    }
}
