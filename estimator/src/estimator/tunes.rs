//! The tunes of frames as readings of the params.
//!
//! A tune is not linear in gradients, and a meter's calibration error is 3e-4. Of params that are off by `sigma_i`, each by itself, the
//! derivative `h` of the tune leaves out
//!
//! `pi/|sin 2 pi Q| sum of (h_i sigma_i)^2` rms:
//!
//! a gradient `q` changes the tune by `beta q/(4 pi)`, and the beta of another place by `-beta beta' q cos(2 |phi - phi'| - 2 pi Q)/
//! (2 sin 2 pi Q)`, so that `d^2 Q/d theta_i d theta_j = -2 pi h_i h_j cos(..)/sin 2 pi Q`, whose phases are taken as random. Exact
//! tunes confirm it within a quarter (`tests/tune_curvature.rs`): 8e-3 when nothing is known of the Booster's vars, 1e-3 when they are
//! known to 1 %. After a campaign errors are correlated, and what is left out is a third of what the formula says.
//!
//! Until it is below two calibration errors, tunes do not count: two directions of 48 would be known to a thirtieth of what they are off by.
//!
//! Source: E. Courant and H. Snyder, Ann. Phys. 3 (1958) 1.

use super::pooling::{Pooling, Work};
use super::posterior::Posterior;
use super::{Estimator, Model, underweighted};
use crate::gaussian::Reading;
use crate::judged::Screened;
use crate::surrogate::Surrogate;
use crate::tune::TuneMeter;

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
    /// Add the tunes that passed.
    pub(super) fn condition_tunes(&mut self, model: &Model<'_, G, B, C, F>, screened: &Screened<W>) {
        let linearised_once = !self.posterior.is_still(&model.setup.walk);
        for plane in 0..2 {
            let variance = self.tunes.get(plane).and_then(TuneMeter::variance);
            if let (Some(Some(innovation)), Some(variance)) = (screened.tune.get(plane), variance) {
                let (_, slope) = model.surrogate.tune(&self.tangent.linearised, plane, &[0.0; F]);
                let reading = Reading { channel: K - 2 + plane, innovation: *innovation, variance, slope: &slope };
                let Posterior { gaussian, solution, .. } = &mut self.posterior;
                gaussian.condition([reading], &underweighted(solution, linearised_once));
            }
        }
    }

    /// Count the tunes of all frames so far, as their mean.
    pub(super) fn count_tunes(&mut self, model: &Model<'_, G, B, C, F>) {
        for plane in 0..2 {
            let Some(meter) = self.tunes.get(plane).filter(|meter| meter.is_linear) else { continue };
            if let (Some(variance), (mean, strength, count @ 1..)) = (meter.variance(), meter.mean()) {
                let squares = meter.scatter();
                let innovation = self.anew.tangent.tune_innovation(model, plane, mean, &strength);
                let (_, slope) = model.surrogate.tune(&self.anew.tangent.linearised, plane, &[0.0; F]);
                let mean =
                    Reading { channel: K - 2 + plane, innovation, variance: variance / count as f32, slope: &slope };
                let Work::Past(Pooling { gaussian, .. }) = &mut self.anew.work else { return };
                gaussian.condition([mean], &|_| 0.0);
                gaussian.add_repeats(count, variance);
                gaussian.add_scatter(squares / f64::from(variance), 0.0);
            }
        }
    }

    /// True if the tune in a plane is linear in the params as far as they are known.
    #[inline(never)]
    pub(super) fn is_linear(&self, model: &Model<'_, G, B, C, F>, plane: usize) -> bool {
        let (tune, slope) = model.surrogate.tune(&self.tangent.linearised, plane, &[0.0; F]);
        let off = |(h, sigma): (&f32, &f32)| h * sigma * h * sigma;
        let squares: f32 = slope.iter().zip(&self.posterior.solution.sigma).map(off).sum();
        let calibration = model.setup.tune_calibration.unwrap_or(0.0);
        core::f32::consts::PI * squares <= 2.0 * calibration * libm::sinf(core::f32::consts::TAU * tune).abs()
    }
}
