//! Linearising anew: the Gaussian at the MAP, rebuilt from all frames so far, and how well it describes them.

use super::{Estimator, Model, about};
use crate::drive::Drive;
use crate::estimate::MonitorState;
use crate::gaussian::{Line, Reading, Repeats};
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

/// Share of chi-square that the baseline orbit's dance with the supplies makes on a machine that is as its model (`docs/model.md`).
const ORDINARY: f32 = 0.008;
/// Standard deviations of chi-square beyond which model and machine disagree: one campaign in 700 by chance.
const DISAGREES: f32 = 3.0;

impl FitQuality {
    /// How far chi-square is above what a true model leaves, in its standard deviations: `(chi2/dof - 1 - 0.008)/sqrt(2/dof)`.
    pub fn excess(&self) -> f32 {
        if self.degrees_of_freedom < 1.0 {
            return 0.0;
        }
        (self.chi_square / self.degrees_of_freedom - 1.0 - ORDINARY) / libm::sqrtf(2.0 / self.degrees_of_freedom)
    }

    /// The mismatch alarm: the readings of healthy monitors are further off than noise explains. It sees all effects together and
    /// no single one: of 11,000 readings a missing effect has to take some 250 nat to raise it.
    pub fn is_mismatch(&self) -> bool {
        self.excess() > DISAGREES
    }
}

/// A param that has moved by this many error bars calls for a new linearisation.
const MOVED: f32 = 0.5;
/// Growth of chi-square that counts as uphill: more than rounding of the readings' means.
const UPHILL: f64 = 1.0;
/// Halvings of a step that leads uphill or to an unstable ring.
const HALVINGS: u32 = 4;

impl<
    G: Surrogate<B, C, F, N>,
    const B: usize,
    const C: usize,
    const F: usize,
    const N: usize,
    const S: usize,
    const K: usize,
    const T: usize,
    const W: usize,
> Estimator<G, B, C, F, N, S, K, T, W>
{
    /// True if the MAP has left the origin, or a past that still counts has to be weighted anew.
    pub(super) fn is_due(&self, model: &Model<'_, G, B, C, F>) -> bool {
        let each = self
            .posterior
            .solution
            .map_params
            .iter()
            .zip(self.posterior.gaussian.origin())
            .zip(&self.posterior.solution.sigma);
        let stale = self.past.stale && self.posterior.is_still::<B>(&model.setup.walk);
        stale || each.into_iter().any(|((map, origin), sigma)| (map - origin).abs() > MOVED * sigma)
    }

    /// Linearise at the MAP, by a damped Gauss-Newton step: halved while it leads uphill or to an unstable ring.
    #[inline(never)]
    pub(super) fn linearise_anew(&mut self, model: &Model<'_, G, B, C, F>) -> bool {
        let from = *self.posterior.gaussian.origin();
        let mut to = self.posterior.solution.map_params;
        // A past that is weighted anew has another chi-square; the step is then judged with the next one.
        let uphill = if self.past.stale || !self.posterior.is_still::<B>(&model.setup.walk) {
            f64::MAX
        } else {
            self.posterior.gaussian.cost() + UPHILL
        };
        self.past.stale = false;
        for _ in 0..HALVINGS {
            if self.linearise_at(model, &to) && self.posterior.gaussian.cost() <= uphill {
                self.solve(model);
                return true;
            }
            to.iter_mut().zip(&from).for_each(|(to, from)| *to = 0.5 * (*to + from));
        }
        let back = self.linearise_at(model, &from);
        self.solve(model);
        back
    }

    fn linearise_at(&mut self, model: &Model<'_, G, B, C, F>, params: &[f32; N]) -> bool {
        let supplies = self.past.campaign.mean_strength();
        if model.surrogate.linearise(params, &supplies, &mut self.tangent.linearised).is_err() {
            return false;
        }
        self.tangent.supplies = supplies;
        if self.posterior.is_still::<B>(&model.setup.walk) {
            self.rebuild(model, params);
        } else {
            self.posterior.gaussian.recentre(params);
        }
        true
    }

    /// The Gaussian of all frames so far, linearised at `params`.
    ///
    /// Settings of one kind differ by the powered corrector's current, so that one derivative serves them all. The 20 mA by
    /// which idle correctors scatter count in the orbit and not in its derivative, a thousandth of it.
    #[inline(never)]
    fn rebuild(&mut self, model: &Model<'_, G, B, C, F>, params: &[f32; N]) {
        self.posterior.gaussian.recentre(params);
        let level = *self.posterior.gaussian.baselines();
        self.posterior.gaussian.copy(&self.past.loose);
        self.posterior.gaussian.recentre(params);
        let mut pool = self.posterior.gaussian.open(level);
        for (i, first) in self.past.campaign.cells().iter().enumerate() {
            let (before, from_here) = self.past.campaign.cells().split_at_checked(i).unwrap_or_default();
            if before.iter().any(|cell| cell.is_kind_of(first)) {
                continue;
            }
            model.surrogate.predict(&self.tangent.linearised, &first.alone(), &mut self.predicted.prediction);
            let by_supply = self.predicted.prediction.by_supply;
            let mut lines = [Line::default(); B];
            for cell in from_here.iter().filter(|cell| cell.is_kind_of(first)) {
                let (drive, share) = (cell.drive(), cell.share(first));
                let strength = about(&drive, &self.tangent.supplies).strength;
                let direct = Drive { strength: [0.0; F], ..drive };
                model.surrogate.orbit(&self.tangent.linearised, &direct, &mut self.predicted.prediction.reading);
                for (b, (line, by_supply)) in lines.iter_mut().zip(&by_supply).enumerate() {
                    let (mean, number) = cell.mean(b);
                    let (Some(orbit), Some(level), 1..) =
                        (self.predicted.prediction.reading.get(b), level.get(b), number)
                    else {
                        continue;
                    };
                    let residual = f64::from(mean - orbit - share * dot(&strength, by_supply)) - level;
                    let variance = self.variance(model, b, number, drive.rf_offset);
                    let repeats = Repeats { number, noise: self.noise_variance(b), variance };
                    self.posterior.gaussian.count(line, share, residual, &repeats);
                }
            }
            for ((b, line), h) in
                lines.iter().enumerate().zip(self.predicted.prediction.jacobian.as_slice().as_chunks().0)
            {
                self.posterior.gaussian.add_line(&mut pool, b, line, h);
            }
        }
        self.posterior.gaussian.close(&mut pool);
        self.count_tunes(model);
        for frame in &self.past.recent {
            let drive = about(&frame.drive, &self.tangent.supplies);
            model.surrogate.predict(&self.tangent.linearised, &drive, &mut self.predicted.prediction);
            let variances: [f32; B] = core::array::from_fn(|b| self.variance(model, b, 1, drive.rf_offset));
            self.posterior.gaussian.condition(frame.readings(&variances, &self.predicted.prediction), |_| 0.0);
        }
        for b in 0..B {
            self.posterior.gaussian.add_scatter(self.past.campaign.scatter(b) / f64::from(self.noise_variance(b)));
        }
    }

    /// Count the tunes of all frames so far, as their mean.
    fn count_tunes(&mut self, model: &Model<'_, G, B, C, F>) {
        for plane in 0..2 {
            let Some(meter) = self.tunes.get(plane) else { continue };
            if let (Some(variance), (mean, strength, count @ 1..)) = (meter.variance(), meter.mean()) {
                let squares = meter.scatter();
                let innovation = self.tune_innovation(model, plane, mean, &strength);
                let (_, slope) = model.surrogate.tune(&self.tangent.linearised, plane, &[0.0; F]);
                let mean = Reading { channel: B + plane, innovation, variance: variance / count as f32, slope: &slope };
                self.posterior.gaussian.condition([mean], |_| 0.0);
                self.posterior.gaussian.add_repeats(count, variance);
                self.posterior.gaussian.add_scatter(squares / f64::from(variance));
            }
        }
    }

    /// How well the model describes the readings of monitors in state ok, by the expected noise.
    ///
    /// With constant vars: residuals of all frames that belong to a setting, at the MAP. With a random walk:
    /// innovations, each against the vars of its own time, counted in NIS.
    pub fn fit_quality(&mut self, model: &Model<'_, G, B, C, F>) -> FitQuality {
        if !self.posterior.is_still::<B>(&model.setup.walk) {
            return FitQuality { chi_square: self.nis.0 as f32, degrees_of_freedom: self.nis.1 as f32 };
        }
        let layout = model.surrogate.layout();
        let expected = |b: usize| f64::from(model.setup.noise.of(b)) * f64::from(model.setup.noise.of(b));
        let is_spare = |b: usize| (0..layout.monitors()).all(|index| layout.monitor(index) != b);
        let is_ok = |(b, monitor): &(usize, &Monitor)| monitor.health().state == MonitorState::Ok && !is_spare(*b);
        let (mut sum, mut readings, mut baselines) = (0.0, 0.0, 0.0);
        for (b, _) in self.monitors.iter().enumerate().filter(is_ok) {
            sum += self.past.campaign.scatter(b) / expected(b);
            baselines += 1.0;
        }
        for cell in self.past.campaign.cells() {
            let drive = about(&cell.drive(), &self.tangent.supplies);
            model.surrogate.predict(&self.tangent.linearised, &drive, &mut self.predicted.prediction);
            for (b, _) in self.monitors.iter().enumerate().filter(is_ok) {
                let (mean, count) = cell.mean(b);
                let (d, _) =
                    self.posterior.gaussian.effective(b, column(self.predicted.prediction.jacobian.as_slice(), N, b));
                let measured = mean - self.predicted.prediction.reading.get(b).copied().unwrap_or(0.0);
                let residual =
                    f64::from(measured) - self.posterior.gaussian.baseline(b) - dot(&d, &self.posterior.solution.delta);
                sum += f64::from(count) * residual * residual / expected(b);
                readings += f64::from(count);
            }
        }
        let degrees_of_freedom = (readings - baselines - layout.params() as f64) as f32;
        FitQuality { chi_square: sum as f32, degrees_of_freedom }
    }
}
