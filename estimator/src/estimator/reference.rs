//! The drive from which settings are counted, and the setting of a frame.
//!
//! A campaign moves one corrector at a time from 0 A. A machine under feedback holds all of them somewhere, and moves them seldom,
//! or one at a time about there. What is moved is told by the orbit that it makes, not by amperes, and where correctors that stay scatter by
//! more than is noticed, by that scatter.

use super::{Estimator, Model, RECENT, underweighted};
use crate::campaign::{Setting, is_moved};
use crate::drive::Drive;
use crate::gaussian::Reading;
use crate::linear::column;
use crate::state::state;
use crate::surrogate::Surrogate;
use crate::wire::Frame;

/// Mean square orbit over the noise's below which kicks count as none: the scatter of read-backs makes 0.004.
const IDLE: f32 = 0.1;
/// Largest share of a frame in the mean of the kicks that the baselines were read at. Where baselines walk fast, one frame makes half of them
/// and moves the params as well: the second order of its own kicks is an error of these, and is not to be put into the baselines.
const MOST: f64 = 1.0 / 16.0;
/// Of the recent frames, so many parts of four must belong to a setting about a new reference drive.
const PARTS: usize = 3;
/// Standard deviations that the scatter of an idle corrector reaches.
const SCATTERS: f32 = 6.0;
/// Kick of the corrector that is moved over the standard deviation of the others, from which on these are idle: with less, what the mean of a
/// setting loses of the params counts.
const STANDS_OUT: f32 = 16.0;
/// Mean square orbit of idle correctors that scatter, over its median, that they do not reach.
const REACHES: f32 = 3.0;

/// Kicks from which settings are counted.
#[derive(Debug, Clone)]
pub(super) struct Reference<const C: usize> {
    /// 0 at first, and one more for each that followed.
    number: u16,
    kick: [f32; C],
    /// Frames of no setting since it was last looked for.
    waited: u16,
    /// Mean of the kicks that the baselines were read at.
    read_at: [f32; C],
    scatter: Scatter,
}

state!([const C: usize] Reference<C> { number, kick, waited, read_at, scatter });

/// How idle correctors scatter about the reference drive; zero where nobody notices.
#[derive(Debug, Clone, Copy)]
struct Scatter {
    /// Standard deviation of a kick [rad].
    kick: f32,
    /// Mean square orbit that they reach, over that which is noticed.
    orbit: f32,
}

state!([] Scatter { kick, orbit });

impl Scatter {
    const NONE: Self = Self { kick: 0.0, orbit: 0.0 };

    /// How far the kick of an idle corrector is off the reference at most [rad].
    fn reach(&self) -> f32 {
        SCATTERS * self.kick
    }
}

impl<const C: usize> Reference<C> {
    /// All correctors at 0 A.
    pub const ZERO: Self = Self { number: 0, kick: [0.0; C], waited: 0, read_at: [0.0; C], scatter: Scatter::NONE };

    /// True if idle correctors scatter by more than is noticed.
    pub fn scatters(&self) -> bool {
        self.scatter.kick > 0.0
    }

    /// Kicks of idle correctors off the reference, the others 0 [rad].
    #[inline(never)]
    pub fn scattered(&self, kick: &[f32; C]) -> [f32; C] {
        let mut off = *kick;
        for (off, reference) in off.iter_mut().zip(&self.kick) {
            *off -= reference;
            *off = if off.abs() <= self.scatter.reach() { *off } else { 0.0 };
        }
        off
    }

    /// A frame's kicks, seen from it, and nothing else of its drive.
    #[inline(never)]
    fn moved<const F: usize>(&self, drive: &Drive<C, F>) -> Drive<C, F> {
        let mut kick = drive.kick;
        kick.iter_mut().zip(&self.kick).for_each(|(kick, reference)| *kick -= reference);
        Drive { kick, strength: [0.0; F], rf_offset: 0.0 }
    }

    /// A frame of no setting has come.
    pub fn wait(&mut self) {
        self.waited = self.waited.saturating_add(1);
    }
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
    /// The setting that a frame repeats. Several correctors at once belong to none, unless the reference drive has them, or all but one
    /// of them move the orbit by less than is noticed: what a setting's mean says of the params would lose it.
    #[inline(never)]
    pub(super) fn setting(
        &mut self,
        model: &Model<'_, G, B, C, F>,
        frame: &Frame<B, C, F, W>,
        drive: &Drive<C, F>,
    ) -> Option<Setting> {
        let reference = &self.past.reference;
        let time = self.setting_time(frame.cycle_time_us);
        let at_rest = Setting::at_rest(reference.number, frame.rf_offset, time);
        let mut moved = reference.moved(drive);
        if self.is_idle(model, &moved) {
            return Some(at_rest);
        }
        let largest = moved.kick.iter_mut().enumerate().reduce(|a, b| if b.1.abs() > a.1.abs() { b } else { a });
        let (corrector, kick) = largest.map(|(c, kick)| (c, core::mem::take(kick)))?;
        if is_moved(frame.rf_offset) || !self.is_idle(model, &moved) {
            return None;
        }
        let mut alone = Drive { kick: [0.0; C], ..moved };
        alone.kick.get_mut(corrector).into_iter().for_each(|own| *own = kick);
        let idle = kick.abs() / libm::sqrtf(self.noticed(model, &alone));
        Some(at_rest.with(u16::try_from(corrector).ok()?, kick, idle.max(self.past.reference.scatter.reach())))
    }

    /// True if kicks move the orbit by less than is noticed, or if they are no more than the scatter of idle correctors.
    fn is_idle(&mut self, model: &Model<'_, G, B, C, F>, moved: &Drive<C, F>) -> bool {
        let (noticed, scatter) = (self.noticed(model, moved), self.past.reference.scatter);
        let is_scatter = || moved.kick.iter().all(|kick| kick.abs() <= scatter.reach());
        noticed <= 1.0 || (noticed <= scatter.orbit && is_scatter())
    }

    /// Mean square orbit of kicks over that which is noticed.
    #[inline(never)]
    fn noticed(&mut self, model: &Model<'_, G, B, C, F>, moved: &Drive<C, F>) -> f32 {
        // work space: what the mean drive would have made is not known yet
        model.surrogate.orbit(&self.tangent.linearised, moved, &mut self.predicted.at_mean_drive);
        let over_noise = |(b, orbit): (usize, &f32)| orbit * orbit / self.noise_variance(b);
        let sum: f32 = self.predicted.at_mean_drive.iter().enumerate().map(over_noise).sum();
        sum / (IDLE * model.surrogate.layout().monitors() as f32)
    }

    /// Look for another reference drive, if for a while no frame has repeated a setting: the median of the recent drives, if most of
    /// them are settings about it. True if it was looked for.
    #[inline(never)]
    pub(super) fn seek_reference(&mut self, model: &Model<'_, G, B, C, F>) -> bool {
        let recent = self.past.recent.len();
        if !self.past.recent.is_full() || usize::from(self.past.reference.waited) < recent {
            return false;
        }
        self.past.reference.waited = 0;
        let former = (self.past.reference.kick, self.past.reference.scatter);
        self.past.reference.kick = core::array::from_fn(|c| self.median_kick(c));
        self.past.reference.scatter = self.scatter_about_reference(model);
        let repeats = (0..recent).filter(|&at| self.repeats_about_reference(model, at)).count();
        if 4 * repeats >= PARTS * recent {
            // not 0 again, which means that there is none
            self.past.reference.number = self.past.reference.number.checked_add(1).unwrap_or(1);
            self.anew.give_up(&mut self.past.stale);
        } else {
            (self.past.reference.kick, self.past.reference.scatter) = former;
        }
        true
    }

    /// Count a frame's kicks into those that the baselines were read at, by the share of it in the baselines: that by which it has
    /// reduced their variance.
    pub(super) fn note_kicks(&mut self, drive: &Drive<C, F>, before: f64) {
        let share = if before > 0.0 { (1.0 - self.baselines_variance() / before).min(MOST) } else { 0.0 };
        let each = self.past.reference.read_at.iter_mut().zip(&drive.kick);
        each.for_each(|(mean, kick)| *mean += share as f32 * (kick - *mean));
    }

    /// Sum of the variances of the baselines at the frame's time in the cycle, params given [m^2].
    pub(super) fn baselines_variance(&self) -> f64 {
        let first = self.predicted.first_channel;
        (first..first + B).map(|channel| self.posterior.gaussian.baseline_variance(channel)).sum()
    }

    /// Take the Gaussian to where the surrogate is linearised anew, while the params walk and the past cannot be counted anew. A baseline is
    /// what was read less what the kicks made of it: by the new linearisation, that is another orbit and another derivative of
    /// it, at the mean of the kicks that it was read at. Their second order would else be taken for news of the params by all frames
    /// that come: 0.1 mm for kicks of some amperes and vars that are off by 3 %.
    #[inline(never)]
    pub(super) fn recentre(&mut self, model: &Model<'_, G, B, C, F>) {
        let drive = Drive { kick: self.past.reference.read_at, ..Drive::NONE };
        model.surrogate.predict(&self.tangent.linearised, &drive, &mut self.predicted.prediction);
        self.posterior.gaussian.absorb(1.0, &self.predicted.prediction, Self::TIMES);
        self.posterior.gaussian.recentre(&self.anew.to);
        model.surrogate.predict(&self.anew.tangent.linearised, &drive, &mut self.predicted.prediction);
        self.posterior.gaussian.absorb(-1.0, &self.predicted.prediction, Self::TIMES);
    }

    /// Make room for new settings, if there is none, by one setting of a former reference drive: it counts on as it is linearised now.
    /// True if one was.
    #[inline(never)]
    pub(super) fn retire(&mut self, model: &Model<'_, G, B, C, F>) -> bool {
        let Some(cell) = self.past.campaign.retire(self.past.reference.number) else { return false };
        let drive = cell.drive();
        let first_channel = self.first_channel(cell.cycle_time());
        self.predict_drive(model, &drive);
        self.past.loose.recentre(self.posterior.gaussian.origin());
        for b in 0..B {
            if let (mean, number @ 1..) = cell.mean(b) {
                let variance = self.variance(model, &self.tangent, b, number, drive.rf_offset);
                let slope = column(self.predicted.prediction.jacobian.as_slice(), N, b);
                let innovation = mean - self.predicted.prediction.reading.get(b).copied().unwrap_or(0.0);
                let reading = Reading { channel: first_channel + b, innovation, variance, slope };
                self.past.loose.condition([reading], &underweighted(&self.posterior.solution, true));
                self.past.loose.add_repeats(number, self.noise_variance(b));
            }
        }
        true
    }

    /// Median of the recent kicks of a corrector, whatever share of them is the same.
    fn median_kick(&self, c: usize) -> f32 {
        let mut kicks = [0.0; RECENT];
        let recent = kicks.iter_mut().zip(self.past.recent.iter());
        recent.for_each(|(to, frame)| *to = frame.drive.kick.get(c).copied().unwrap_or_default());
        median(&kicks)
    }

    /// How the correctors that are not moved scatter about the reference in the recent frames; none if that is not noticed, or if no corrector
    /// that is moved stands out.
    fn scatter_about_reference(&mut self, model: &Model<'_, G, B, C, F>) -> Scatter {
        let others = model.surrogate.layout().correctors().saturating_sub(1).max(1) as f32;
        let (mut variance, mut orbit, mut most) = ([0.0; RECENT], [0.0; RECENT], 0.0_f32);
        for (at, (variance, orbit)) in variance.iter_mut().zip(&mut orbit).enumerate() {
            let Some((kick, rest)) = self.moved_in_recent(at) else { continue };
            most = most.max(kick.abs());
            *variance = rest.kick.iter().map(|kick| kick * kick).sum::<f32>() / others;
            *orbit = self.noticed(model, &rest);
        }
        let kick = libm::sqrtf(median(&variance));
        let orbit = median(&orbit);
        if orbit > 1.0 / REACHES && most > STANDS_OUT * kick {
            Scatter { kick, orbit: REACHES * orbit }
        } else {
            Scatter::NONE
        }
    }

    /// True if at most one corrector is moved from the reference in a recent frame.
    fn repeats_about_reference(&mut self, model: &Model<'_, G, B, C, F>, at: usize) -> bool {
        self.moved_in_recent(at).is_some_and(|(_, rest)| self.is_idle(model, &rest))
    }

    /// Largest kick off the reference in a recent frame [rad], and the others.
    #[inline(never)]
    fn moved_in_recent(&self, at: usize) -> Option<(f32, Drive<C, F>)> {
        let mut moved = self.past.reference.moved(&self.past.recent.get(at)?.drive);
        let largest = moved.kick.iter_mut().reduce(|a, b| if b.abs() > a.abs() { b } else { a })?;
        Some((core::mem::take(largest), moved))
    }
}

/// Median of some values, whatever share of them is the same: the mean of the smallest that half of them do not exceed, and of the largest that
/// half of them do not fall short of.
#[inline(never)]
fn median(values: &[f32; RECENT]) -> f32 {
    let half = RECENT / 2;
    let low = values.iter().filter(|value| values.iter().filter(|other| other <= value).count() >= half);
    let high = values.iter().filter(|value| values.iter().filter(|other| other >= value).count() >= half);
    0.5 * (low.copied().fold(f32::MAX, f32::min) + high.copied().fold(f32::MIN, f32::max))
}
