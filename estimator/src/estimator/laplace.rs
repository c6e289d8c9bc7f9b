//! How well the Gaussian at the MAP describes all frames so far.

use super::{Estimator, Model, about, follow};
use crate::estimate::MonitorState;
use crate::following;
use crate::linear::{column, dot};
use crate::monitor::Monitor;
use crate::surrogate::Surrogate;

/// How well the model at the MAP describes the readings of monitors in state ok.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitQuality {
    /// Sum of (residual / expected noise)^2.
    pub chi_square: f32,
    /// Readings less baselines less params.
    pub degrees_of_freedom: f32,
}

/// Standard deviations of chi-square beyond which model and machine disagree: one campaign in 700 by chance.
const DISAGREES: f32 = 3.0;

impl FitQuality {
    /// How far chi-square is above what a true model leaves, in its standard deviations: `(chi2/dof - 1)/sqrt(2/dof)`.
    pub fn excess(&self) -> f32 {
        if self.degrees_of_freedom < 1.0 {
            return 0.0;
        }
        (self.chi_square / self.degrees_of_freedom - 1.0) / libm::sqrtf(2.0 / self.degrees_of_freedom)
    }

    /// The mismatch alarm: the readings of healthy monitors are further off than noise explains. It sees all effects together and
    /// no single one: of 11,000 readings a missing effect has to take some 250 nat to raise it.
    pub fn is_mismatch(&self) -> bool {
        self.excess() > DISAGREES
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
    /// How well the model describes the readings of monitors in state ok, by the expected noise, and by what is not known of the
    /// surrogate and of a misaligned ring's dispersion.
    ///
    /// With constant vars: residuals of all frames that belong to a setting, at the MAP. With a random walk:
    /// innovations, each against the vars of its own time, counted in NIS.
    pub fn fit_quality(&mut self, model: &Model<'_, G, B, C, F>) -> FitQuality {
        if !self.posterior.is_still(&model.setup.walk) {
            return FitQuality { chi_square: self.nis.0 as f32, degrees_of_freedom: self.nis.1 as f32 };
        }
        let layout = model.surrogate.layout();
        let expected = |b: usize| f64::from(model.setup.noise.of(b)) * f64::from(model.setup.noise.of(b));
        let is_spare = |b: usize| (0..layout.monitors()).all(|index| layout.monitor(index) != b);
        let is_ok = |(b, monitor): &(usize, &Monitor)| monitor.health().state == MonitorState::Ok && !is_spare(*b);
        let (mut sum, mut readings, mut baselines) = (0.0, 0.0, 0.0);
        for ((b, _), following) in self.monitors.iter().enumerate().zip(&self.following).filter(|(m, _)| is_ok(m)) {
            sum +=
                following.chi_square(&following::Expected { variance: expected(b) as f32, ..self.follows(model, b) });
            readings += f64::from(following.repeats);
            baselines += self.times.count() as f64;
        }
        for cell in self.past.campaign.cells() {
            let first_channel = self.first_channel(cell.cycle_time());
            let drive = about(&self.believed(&cell.drive()), &self.tangent.supplies);
            model.surrogate.predict(&self.tangent.linearised, &drive, &mut self.predicted.prediction);
            follow(&self.following, &drive.strength, &mut self.predicted.prediction.reading);
            for (b, _) in self.monitors.iter().enumerate().filter(is_ok) {
                let (mean, count @ 1..) = cell.mean(b) else { continue };
                let (slope, channel) = (column(self.predicted.prediction.jacobian.as_slice(), N, b), first_channel + b);
                let (d, _) = self.posterior.gaussian.effective(channel, slope);
                let measured = mean - self.predicted.prediction.reading.get(b).copied().unwrap_or(0.0);
                let residual = f64::from(measured)
                    - self.posterior.gaussian.baseline(channel)
                    - dot(&d, &self.posterior.solution.delta);
                let shared = f64::from(self.shared_variance(model, &self.tangent, b, drive.rf_offset));
                sum += residual * residual / (expected(b) / f64::from(count) + shared);
                readings += 1.0;
            }
        }
        let degrees_of_freedom = (readings - baselines - layout.params() as f64) as f32;
        FitQuality { chi_square: sum as f32, degrees_of_freedom }
    }
}
