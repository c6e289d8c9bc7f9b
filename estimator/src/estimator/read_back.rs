//! Whether the beam follows the scatter of the correctors' read-backs: a current that fluctuates moves the orbit, noise of its read-back does not.
//!
//! Repeats of a setting tell. With `D` what the scatter would make of a reading, off the mean of its setting, and `z` the reading, off its own,
//!
//! `z = share D + noise`,      `share = sum z D/variance / sum D^2/variance`.

use super::{Estimator, Model};
use crate::campaign::before_last;
use crate::drive::Drive;
use crate::state::state;
use crate::surrogate::Surrogate;
use crate::wire::Frame;

/// Standard deviations by which repeats must contradict that the beam follows.
const SURE: f32 = 4.0;
/// The least share that it does not follow: the model and the gains are off by some percent.
const LEAST: f32 = 0.1;
/// Change of the share below which all frames so far need not be counted anew.
const SAME: f32 = 0.02;
/// Standard deviations beyond which a reading tells nothing.
const JUMP: f32 = 5.0;

/// What repeats have said of the read-backs.
#[derive(Debug, Clone, Copy)]
pub(super) struct ReadBack {
    /// Share of the scatter that the beam does not follow.
    ignored: f32,
    /// Sum of `z D/variance`, and of `D^2/variance`.
    moment: f32,
    information: f32,
}

state!([] ReadBack { ignored, moment, information });

impl ReadBack {
    /// The beam follows, as far as is known.
    pub const FOLLOWED: Self = Self { ignored: 0.0, moment: 0.0, information: 0.0 };

    /// Decide by what is known now; true if that changes anything.
    fn decide(&mut self) -> bool {
        let ignored = 1.0 - (self.moment / self.information).clamp(0.0, 1.0);
        let is_sure = ignored > LEAST.max(SURE / libm::sqrtf(self.information));
        let ignored = if is_sure { ignored } else { 0.0 };
        let changes = (ignored - self.ignored).abs() > SAME;
        self.ignored = if changes { ignored } else { self.ignored };
        changes
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
    /// A drive by its read-backs, or their mean, without the share of their scatter that the beam does not follow.
    #[inline(never)]
    pub(super) fn believed(&self, drive: &Drive<C, F>) -> Drive<C, F> {
        let (mut believed, ignored) = (*drive, self.past.read_back.ignored);
        if ignored > 0.0 {
            let scattered = self.past.reference.scattered(&drive.kick);
            believed.kick.iter_mut().zip(&scattered).for_each(|(kick, off)| *kick -= ignored * off);
        }
        believed
    }

    /// Learn from a frame that repeats a setting, whose drive is counted, and whose readings are not; true if the share has changed.
    #[inline(never)]
    pub(super) fn learn_read_back(
        &mut self,
        model: &Model<'_, G, B, C, F>,
        frame: &Frame<B, C, F, W>,
        drive: &Drive<C, F>,
        index: u16,
    ) -> bool {
        let Some(cell) = self.past.campaign.cells().get(usize::from(index)) else { return false };
        let (reference, mean) = (&self.past.reference, cell.drive());
        let (frames @ 2.., true) = (cell.frames(), reference.scatters()) else { return false };
        let mut kick = reference.scattered(&drive.kick);
        kick.iter_mut().zip(reference.scattered(&mean.kick)).for_each(|(kick, mean)| *kick -= mean);
        let mut scatter = [0.0; B];
        model.surrogate.orbit(&self.tangent.linearised, &Drive { kick, ..Drive::NONE }, &mut scatter);
        // the mean drive has the frame in it, the mean reading has not
        let before = before_last(frames);
        let (mut moment, mut information) = (0.0, 0.0);
        for (b, (off, reading)) in scatter.iter().zip(&frame.reading).enumerate().filter(|(b, _)| frame.valid.has(*b)) {
            let (read, count) = cell.mean(b);
            let others = self.predicted.prediction.reading.get(b).zip(self.predicted.at_mean_drive.get(b));
            let (Some((here, there)), true) = (others, count + 1 == frames) else { continue };
            let others = here - there - (1.0 - self.past.read_back.ignored) * off;
            let (z, d) = (reading.value() - read - before * others, before * off);
            let variance = before * self.noise_variance(b);
            if z.abs() <= JUMP * libm::sqrtf(variance) + d.abs() {
                moment += z * d / variance;
                information += d * d / variance;
            }
        }
        self.past.read_back.moment += moment;
        self.past.read_back.information += information;
        let changed = self.past.read_back.information > 0.0 && self.past.read_back.decide();
        self.past.stale |= changed;
        changed
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_beam_follows_unless_repeats_are_sure_that_it_does_not() {
        let decided = |moment: f32, information: f32| {
            let mut read_back = ReadBack { moment, information, ..ReadBack::FOLLOWED };
            (read_back.decide(), read_back.ignored)
        };
        assert_eq!(decided(10.0, 100.0), (true, 0.9));
        assert_eq!(decided(-1.0, 100.0), (true, 1.0));
        // 0.1 ± 0.3, and 0.95 ± 0.01: gains are off by as much
        assert_eq!((decided(1.0, 10.0), decided(9500.0, 10_000.0)), ((false, 0.0), (false, 0.0)));
    }
}
