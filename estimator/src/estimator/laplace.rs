//! Linearising anew: the Gaussian at the MAP, rebuilt from all frames so far, and how well it describes them.

use super::{Estimator, Model, about};
use crate::estimate::MonitorState;
use crate::gaussian::Level;
use crate::linear::{column, dot};
use crate::monitor::Monitor;
use crate::sum::Sum;
use crate::surrogate::Surrogate;

/// How well the model at the MAP describes the readings of monitors in state ok.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitQuality {
    /// Sum of (residual / expected noise)^2.
    pub chi_square: f32,
    /// Readings less baselines less params.
    pub degrees_of_freedom: f32,
}

/// A param that has moved by this many error bars calls for a new linearisation.
const MOVED: f32 = 0.5;
/// Growth of chi-square that counts as uphill: more than rounding of a chi-square of 1e5.
const UPHILL: f32 = 1.0;
/// Halvings of a step that leads uphill or to an unstable ring.
const HALVINGS: u32 = 4;
/// A setting whose information on all params together is less than this share of the prior's on one tells of its
/// monitor's baseline only. A thousand of them leave a fiftieth of the prior's information on 48 params unused.
const QUIET: f32 = 1e-3;
/// While the params have walked less than this share of an error bar, the past still counts as one ring.
const WALKED: f32 = 0.1;

impl<G: Surrogate<B, C, N>, const B: usize, const C: usize, const N: usize, const S: usize, const T: usize>
    Estimator<G, B, C, N, S, T>
{
    /// True if the MAP has left the origin, or the past has to be weighted anew.
    pub(super) fn is_due(&self) -> bool {
        let each = self.solution.map_params.iter().zip(self.gaussian.origin()).zip(&self.solution.sigma);
        self.stale || each.into_iter().any(|((map, origin), sigma)| (map - origin).abs() > MOVED * sigma)
    }

    /// Linearise at the MAP, by a damped Gauss-Newton step: halved while it leads uphill or to an unstable ring.
    #[inline(never)]
    pub(super) fn linearise_anew(&mut self, model: &Model<'_, G>) -> bool {
        let from = *self.gaussian.origin();
        let mut to = self.solution.map_params;
        // A past that is weighted anew has another chi-square; the step is then judged with the next one.
        let uphill = if self.stale || !self.is_still(model) { f32::MAX } else { self.gaussian.cost() + UPHILL };
        self.stale = false;
        for _ in 0..HALVINGS {
            if self.linearise_at(model, &to) && self.gaussian.cost() <= uphill {
                self.solve(model);
                return true;
            }
            to.iter_mut().zip(&from).for_each(|(to, from)| *to = 0.5 * (*to + from));
        }
        let back = self.linearise_at(model, &from);
        self.solve(model);
        back
    }

    fn linearise_at(&mut self, model: &Model<'_, G>, params: &[f32; N]) -> bool {
        let supplies = self.campaign.mean_strength();
        let first = model.surrogate.first_family();
        let mut strength = [0.0; N];
        for (i, (strength, theta)) in strength.iter_mut().zip(params).enumerate() {
            *strength = libm::expf(theta + if i < first { supplies[0] } else { supplies[1] });
        }
        if model.surrogate.linearise(&strength, &mut self.linearised).is_err() {
            return false;
        }
        self.supplies = supplies;
        if self.is_still(model) {
            self.rebuild(model, params);
        } else {
            self.gaussian.recentre(params);
        }
        true
    }

    /// True while all frames so far have seen the same ring.
    pub(super) fn is_still(&self, model: &Model<'_, G>) -> bool {
        let walked = model.setup.process_noise * libm::sqrtf(self.frames as f32);
        self.solution.sigma.iter().all(|sigma| walked <= WALKED * sigma)
    }

    /// The Gaussian of all frames so far, linearised at `params`.
    fn rebuild(&mut self, model: &Model<'_, G>, params: &[f32; N]) {
        self.gaussian.clone_from(&self.loose);
        self.gaussian.recentre(params);
        let mut levels = [Level::default(); B];
        for cell in self.campaign.cells() {
            let drive = about(&cell.drive(), &self.supplies);
            model.surrogate.predict(&self.linearised, &drive, &mut self.prediction);
            for (b, level) in levels.iter_mut().enumerate() {
                let (mean, count) = cell.mean(b);
                if count == 0 {
                    continue;
                }
                let slope = column(self.prediction.jacobian.as_slice(), N, b);
                let innovation = mean - self.prediction.reading.get(b).copied().unwrap_or(0.0);
                let variance = self.variance(model, b, count, drive.rf_offset);
                if dot(slope, slope) < variance * quiet(model) {
                    self.gaussian.merge(level, innovation, variance);
                } else {
                    self.gaussian.condition(b, innovation, variance, slope);
                }
                self.gaussian.add_repeats(count, self.noise_variance(b));
            }
        }
        for frame in &self.recent {
            let drive = about(&frame.drive, &self.supplies);
            model.surrogate.predict(&self.linearised, &drive, &mut self.prediction);
            for b in (0..B).filter(|b| frame.accepted >> b & 1 == 1) {
                let slope = column(self.prediction.jacobian.as_slice(), N, b);
                let innovation = frame.innovation(b, &self.prediction.reading);
                self.gaussian.condition(b, innovation, self.variance(model, b, 1, drive.rf_offset), slope);
            }
        }
        for (b, level) in levels.iter().enumerate() {
            self.gaussian.condition_level(b, level);
            self.gaussian.add_scatter(self.campaign.scatter(b) / self.noise_variance(b));
        }
        self.gaussian.settle();
    }

    /// How well the model describes the readings of monitors in state ok, by the expected noise.
    ///
    /// With constant vars: residuals of all frames that belong to a setting, at the MAP. With a random walk:
    /// innovations, each against the vars of its own time, counted in NIS.
    pub fn fit_quality(&mut self, model: &Model<'_, G>) -> FitQuality {
        if !self.is_still(model) {
            return FitQuality { chi_square: self.nis.0.value(), degrees_of_freedom: self.nis.1 as f32 };
        }
        let expected = model.setup.noise * model.setup.noise;
        let is_ok = |(_, monitor): &(usize, &Monitor)| monitor.health().state == MonitorState::Ok;
        let (mut sum, mut readings, mut baselines) = (Sum::default(), 0.0, 0.0);
        for (b, _) in self.monitors.iter().enumerate().filter(is_ok) {
            sum.add(self.campaign.scatter(b) / expected);
            baselines += 1.0;
        }
        for cell in self.campaign.cells() {
            let drive = about(&cell.drive(), &self.supplies);
            model.surrogate.predict(&self.linearised, &drive, &mut self.prediction);
            for (b, _) in self.monitors.iter().enumerate().filter(is_ok) {
                let (mean, count) = cell.mean(b);
                let (d, _) = self.gaussian.effective(b, column(self.prediction.jacobian.as_slice(), N, b));
                let predicted = self.prediction.reading.get(b).copied().unwrap_or(0.0) + self.gaussian.baseline(b);
                let residual = mean - predicted - dot(&d, &self.solution.delta);
                sum.add(count as f32 * residual * residual / expected);
                readings += count as f32;
            }
        }
        FitQuality { chi_square: sum.value(), degrees_of_freedom: readings - baselines - N as f32 }
    }
}

/// Information below which a setting says nothing of the params: that of the stray currents of idle correctors.
fn quiet<G>(model: &Model<'_, G>) -> f32 {
    QUIET / (model.setup.prior.sigma * model.setup.prior.sigma)
}
