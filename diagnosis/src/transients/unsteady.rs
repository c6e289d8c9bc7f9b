//! A corrector whose kick differs from frame to frame of a setting, as where its supply hunts.
//!
//! In the runs in which it is on, each frame has a kick of its own, of standard deviation `omega`, which moves the monitors along the measured response
//! `p` (over their noise). With `w` the whitened differences of a run of `n` frames, less its mean,
//!
//! `z = p.w/sqrt(v p.p)`, `ln Bayes factor = sum of z^2 q/(1 + q)/2 - (n - 1) ln(1 + q)/2`, `q = omega^2 p.p/v`,
//!
//! averaged over omega. The variance `v` along `p` is that in the runs in which the corrector is off, which hold half of the frames or more: what moves the
//! monitors in every setting is no corrector's; where the noise across `p` is larger in its own runs, so is `v`. One trip is no unsteady supply: all frames
//! but the most telling one have to confirm it. Without a frame `k` of a run `sum of (p.w)^2` is less by `(p.w_k)^2 n/(n - 1)`.

use core::ops::Range;

use evidence::log_bayes_factor_of_alike;
use nalgebra::{DMatrix, DVector};

use super::Shown;
use super::differences::Differences;
use crate::discrepancy::{Discrepancy, SIZES};
use crate::location::Location;

/// `ln` Bayes factor, of 19, at which all frames but the most telling one confirm it.
const CONFIRMED: f64 = 2.94;

/// What the runs of frames say of one corrector.
pub struct Unsteady<'d> {
    differences: &'d Differences,
    /// Whitened differences, rows frames.
    white: &'d DMatrix<f64>,
    /// The corrector's response, of rms 1 over the monitors that count.
    response: DVector<f64>,
    /// What that does to whitened readings per metre, rows frames.
    pattern: DMatrix<f64>,
}

/// Sums over one run, or over several.
#[derive(Default)]
struct Sums {
    /// Differences: frames less runs.
    count: f64,
    /// Sum of `(p.w)^2/p.p`, and by how much it would be less without the frame that tells most.
    along: f64,
    most: f64,
    /// Sum of `w.w` without that, and how many numbers that is of.
    across: f64,
    numbers: f64,
    /// Sum of `p.p` over the frames, and their number.
    power: f64,
    frames: f64,
}

impl<'d> Unsteady<'d> {
    /// `response`: what the corrector does to each monitor, in any unit; none if it does nothing.
    pub fn from_response(
        differences: &'d Differences,
        white: &'d DMatrix<f64>,
        response: DVector<f64>,
    ) -> Option<Self> {
        let seen: Vec<f64> = (0..response.len()).filter(|&b| differences.sees(b)).map(|b| response[b]).collect();
        let rms = (seen.iter().map(|p| p * p).sum::<f64>() / seen.len().max(1) as f64).sqrt();
        let response = response / rms;
        (rms > 0.0).then(|| Self { differences, white, pattern: differences.of_orbit(&response), response })
    }

    /// The discrepancy, if there are two runs or more in which the corrector is on, and as many frames in which it is off; one of some `sites`.
    pub fn judge(&self, corrector: usize, is_on: impl Fn(usize) -> bool, sites: usize) -> Option<Discrepancy> {
        let (own, others): (Vec<Range<usize>>, Vec<Range<usize>>) =
            self.differences.runs.iter().cloned().partition(|run| is_on(run.start));
        let mut each: Vec<Sums> = own.iter().map(|run| self.sums([run])).collect();
        each.retain(|run| run.frames > 0.0);
        let (all, of_others) = (self.sums(&own), self.sums(&others));
        if each.len() < 2 || of_others.frames < all.frames {
            return None;
        }
        let louder = all.variance_across() / of_others.variance_across().max(f64::MIN_POSITIVE);
        let variance = (of_others.along / of_others.count).max(1.0) * louder.max(1.0);
        let discrepancy = |runs: &[Sums]| {
            let logs = SIZES.map(|size| runs.iter().map(|run| run.log_bayes(size, variance)).sum());
            Discrepancy::averaged(Location::UnsteadyCorrector(corrector), logs, sites)
        };
        let found = discrepancy(&each);
        let telling = each.iter_mut().max_by(|one, other| one.most.total_cmp(&other.most))?;
        (telling.along, telling.count) = (telling.along - telling.most, telling.count - 1.0);
        (discrepancy(&each).log_bayes > CONFIRMED).then_some(found)
    }

    /// In each frame in which it is on the readings less the mean of their run, against what the kick that suits the frame's other monitors best should make
    /// of them.
    pub fn shown(&self, readings: &DMatrix<f64>, is_on: impl Fn(usize) -> bool) -> Vec<Shown> {
        let mut shown = Vec::new();
        let within = self.differences.within(readings);
        for run in self.differences.runs.iter().filter(|run| is_on(run.start)) {
            for b in 0..readings.ncols() {
                let noise = self.differences.noise(b);
                let frames: Vec<usize> = run.clone().filter(|&frame| self.differences.counts(frame, b)).collect();
                let sigma = noise * (1.0 - (frames.len() as f64).recip()).sqrt();
                for frame in frames {
                    let (p, w) = (self.pattern.row(frame), self.white.row(frame));
                    let power = p.norm_squared() - p[b] * p[b];
                    if power > 0.0 && sigma > 0.0 {
                        let kick = (p.dot(&w) - p[b] * w[b]) / power;
                        let (predicted, measured) = (self.response[b] * kick, within[(frame, b)] * noise);
                        shown.push(Shown { predicted, measured, sigma });
                    }
                }
            }
        }
        shown
    }

    /// Of some runs, of their frames in which the corrector shows.
    fn sums<'r>(&self, runs: impl IntoIterator<Item = &'r Range<usize>>) -> Sums {
        let mut sums = Sums::default();
        for run in runs {
            let frames: Vec<usize> =
                run.clone().filter(|&frame| self.pattern.row(frame).iter().any(|p| *p != 0.0)).collect();
            if frames.len() < 2 {
                continue;
            }
            // of n numbers less their mean, n - 1 are free
            let free = 1.0 - (frames.len() as f64).recip();
            for frame in frames {
                let (p, w) = (self.pattern.row(frame), self.white.row(frame));
                let (power, square) = (p.norm_squared(), w.norm_squared());
                let along = p.dot(&w).powi(2) / power;
                sums.count += free;
                sums.along += along;
                sums.most = sums.most.max(along / free);
                sums.across += square - along;
                sums.numbers += free * (w.iter().filter(|x| **x != 0.0).count() as f64 - 1.0).max(0.0);
                sums.power += power;
                sums.frames += 1.0;
            }
        }
        sums
    }
}

impl Sums {
    /// Variance across the pattern, 0 where one monitor counts alone.
    fn variance_across(&self) -> f64 {
        self.across / self.numbers.max(1.0)
    }

    /// Of kicks that move the monitors by `size` [m] rms; `variance` along the pattern without them.
    fn log_bayes(&self, size: f64, variance: f64) -> f64 {
        let q = size * size * self.power / (self.frames * variance);
        log_bayes_factor_of_alike(self.along / variance * q, q, self.count)
    }
}

#[cfg(test)]
mod tests {
    use inference::Recording;
    use inference::simulate::Beyond;
    use rand::SeedableRng;
    use rand::rngs::StdRng;
    use twin::Cycle;

    use super::*;
    use crate::alternatives::Cause;
    use crate::testing::{Coloured, normal, template};
    use crate::transients::Transients;

    /// A corrector whose kick is off by a share that depends on the frame.
    struct Unsteadied<S> {
        corrector: usize,
        share: S,
    }

    impl<S: Fn(usize) -> f64 + Sync> Beyond for Unsteadied<S> {
        fn alter_cycles(&self, cycles: &mut [Cycle]) {
            for (frame, cycle) in cycles.iter_mut().enumerate() {
                cycle.kick[self.corrector] *= 1.0 + (self.share)(frame);
            }
        }
    }

    fn found(
        corrector: usize,
        share: impl Fn(usize) -> f64 + Sync,
        noise: impl Fn(&mut Coloured),
    ) -> (Recording, Vec<Cause>) {
        let (ring, recording) = template();
        let mut made = Coloured::white(&ring, &recording, 7);
        noise(&mut made);
        let made = made.campaign_with(&ring, &recording, &[], &[&Unsteadied { corrector, share }]);
        let Transients { found, campaign } = Transients::find(&ring, &made).unwrap();
        (campaign.recording, found.into_iter().map(|mut one| one.alternatives.remove(0).cause).collect())
    }

    fn is_unsteady(causes: &[Cause], corrector: usize) -> bool {
        let is_it =
            |cause: &Cause| matches!(cause, Cause::Unmodelled(one) if one.at == Location::UnsteadyCorrector(corrector));
        causes.len() == 1 && causes.iter().all(is_it)
    }

    /// By 19 to 75 % rms of its kick; its frames are left out.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn a_corrector_that_hunts_is_found_and_left_out() {
        for (corrector, share) in [(4, 0.25), (9, 0.3), (15, 0.6), (20, 1.0)] {
            let hunting = |frame: usize| share * [1.0, -0.6, 0.3, -0.9][frame % 4];
            let (recording, causes) = found(corrector, hunting, |_| ());
            assert!(is_unsteady(&causes, corrector), "{share}: {causes:?}");
            let kicked = recording.rows.iter().filter(|row| row.reading.iter().all(Option::is_none)).count();
            assert!((5..12).contains(&kicked), "two runs of three or four frames: {kicked}");
        }
    }

    /// Off, or by a third too weak, in one frame; and noise that is larger in its frames, which all monitors have.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn neither_a_trip_nor_noise_is_an_unsteady_supply() {
        let (_, recording) = template();
        let on = |i: usize| recording.rows[i].correctors.iter().find(|(_, current)| current.abs() > 1.0);
        let first = (100..recording.rows.len()).find(|&i| on(i).is_some()).unwrap();
        let corrector = on(first).unwrap().0;
        for lost in [1.0, 0.3] {
            let tripped = found(corrector, |frame| if frame == first + 1 { -lost } else { 0.0 }, |_| ()).1;
            assert!(tripped.is_empty(), "{lost}: {tripped:?}");
        }
        let frames: Vec<usize> =
            (0..recording.rows.len()).filter(|&i| on(i).is_some_and(|(c, _)| *c == corrector)).collect();
        let louder = |made: &mut Coloured| {
            let mut random = StdRng::seed_from_u64(3);
            let monitors = made.dispersion.len();
            made.common = DMatrix::from_fn(recording.rows.len(), monitors, |i, _| {
                let draw = normal(&mut random);
                if frames.contains(&i) { 3.0 * made.noise * draw } else { 0.0 }
            });
        };
        let noisy = found(corrector, |_| 0.0, louder).1;
        assert!(!noisy.iter().any(|cause| matches!(cause, Cause::Unmodelled(_))), "{noisy:?}");
    }
}
