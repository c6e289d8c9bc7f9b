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
/// While the params have walked less than this share of an error bar, the past still counts as one ring.
const WALKED: f32 = 0.1;

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
    /// True if the MAP has left the origin, or the past has to be weighted anew.
    pub(super) fn is_due(&self) -> bool {
        let each = self.solution.map_params.iter().zip(self.gaussian.origin()).zip(&self.solution.sigma);
        self.stale || each.into_iter().any(|((map, origin), sigma)| (map - origin).abs() > MOVED * sigma)
    }

    /// Linearise at the MAP, by a damped Gauss-Newton step: halved while it leads uphill or to an unstable ring.
    #[inline(never)]
    pub(super) fn linearise_anew(&mut self, model: &Model<'_, G, B, C, F>) -> bool {
        let from = *self.gaussian.origin();
        let mut to = self.solution.map_params;
        // A past that is weighted anew has another chi-square; the step is then judged with the next one.
        let uphill = if self.stale || !self.is_still(model) { f64::MAX } else { self.gaussian.cost() + UPHILL };
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

    fn linearise_at(&mut self, model: &Model<'_, G, B, C, F>, params: &[f32; N]) -> bool {
        let supplies = self.campaign.mean_strength();
        if model.surrogate.linearise(params, &supplies, &mut self.linearised).is_err() {
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
    pub(super) fn is_still(&self, model: &Model<'_, G, B, C, F>) -> bool {
        let walked = model.setup.process_noise * libm::sqrtf(self.walked as f32);
        self.solution.sigma.iter().all(|sigma| walked <= WALKED * sigma)
    }

    /// The Gaussian of all frames so far, linearised at `params`.
    ///
    /// Settings of one kind differ by the powered corrector's current, so that one derivative serves them all. The 20 mA by
    /// which idle correctors scatter count in the orbit and not in its derivative, a thousandth of it.
    #[inline(never)]
    fn rebuild(&mut self, model: &Model<'_, G, B, C, F>, params: &[f32; N]) {
        self.gaussian.recentre(params);
        let level = *self.gaussian.baselines();
        self.gaussian.copy(&self.loose);
        self.gaussian.recentre(params);
        let mut pool = self.gaussian.open(level);
        for (i, first) in self.campaign.cells().iter().enumerate() {
            let (before, from_here) = self.campaign.cells().split_at_checked(i).unwrap_or_default();
            if before.iter().any(|cell| cell.is_kind_of(first)) {
                continue;
            }
            model.surrogate.predict(&self.linearised, &first.alone(), &mut self.prediction);
            let by_supply = self.prediction.by_supply;
            let mut lines = [Line::default(); B];
            for cell in from_here.iter().filter(|cell| cell.is_kind_of(first)) {
                let (drive, share) = (cell.drive(), cell.share(first));
                let strength = about(&drive, &self.supplies).strength;
                let direct = Drive { strength: [0.0; F], ..drive };
                model.surrogate.orbit(&self.linearised, &direct, &mut self.prediction.reading);
                for (b, (line, by_supply)) in lines.iter_mut().zip(&by_supply).enumerate() {
                    let (mean, number) = cell.mean(b);
                    let (Some(orbit), Some(level), 1..) = (self.prediction.reading.get(b), level.get(b), number) else {
                        continue;
                    };
                    let residual = f64::from(mean - orbit - share * dot(&strength, by_supply)) - level;
                    let variance = self.variance(model, b, number, drive.rf_offset);
                    let repeats = Repeats { number, noise: self.noise_variance(b), variance };
                    self.gaussian.count(line, share, residual, &repeats);
                }
            }
            for ((b, line), h) in lines.iter().enumerate().zip(self.prediction.jacobian.as_slice().as_chunks().0) {
                self.gaussian.add_line(&mut pool, b, line, h);
            }
        }
        self.gaussian.close(&mut pool);
        self.count_tunes(model);
        for frame in &self.recent {
            let drive = about(&frame.drive, &self.supplies);
            model.surrogate.predict(&self.linearised, &drive, &mut self.prediction);
            let variances: [f32; B] = core::array::from_fn(|b| self.variance(model, b, 1, drive.rf_offset));
            self.gaussian.condition(frame.readings(&variances, &self.prediction), |_| 0.0);
        }
        for b in 0..B {
            self.gaussian.add_scatter(self.campaign.scatter(b) / f64::from(self.noise_variance(b)));
        }
    }

    /// Count the tunes of all frames so far, as their mean.
    fn count_tunes(&mut self, model: &Model<'_, G, B, C, F>) {
        for plane in 0..2 {
            let Some(meter) = self.tunes.get(plane) else { continue };
            if let (Some(variance), (mean, strength, count @ 1..)) = (meter.variance(), meter.mean()) {
                let squares = meter.scatter();
                let innovation = self.tune_innovation(model, plane, mean, &strength);
                let (_, slope) = model.surrogate.tune(&self.linearised, plane, &[0.0; F]);
                let mean = Reading { channel: B + plane, innovation, variance: variance / count as f32, slope: &slope };
                self.gaussian.condition([mean], |_| 0.0);
                self.gaussian.add_repeats(count, variance);
                self.gaussian.add_scatter(squares / f64::from(variance));
            }
        }
    }

    /// How well the model describes the readings of monitors in state ok, by the expected noise.
    ///
    /// With constant vars: residuals of all frames that belong to a setting, at the MAP. With a random walk:
    /// innovations, each against the vars of its own time, counted in NIS.
    pub fn fit_quality(&mut self, model: &Model<'_, G, B, C, F>) -> FitQuality {
        if !self.is_still(model) {
            return FitQuality { chi_square: self.nis.0 as f32, degrees_of_freedom: self.nis.1 as f32 };
        }
        let layout = model.surrogate.layout();
        let expected = |b: usize| f64::from(model.setup.noise.of(b)) * f64::from(model.setup.noise.of(b));
        let is_spare = |b: usize| (0..layout.monitors()).all(|index| layout.monitor(index) != b);
        let is_ok = |(b, monitor): &(usize, &Monitor)| monitor.health().state == MonitorState::Ok && !is_spare(*b);
        let (mut sum, mut readings, mut baselines) = (0.0, 0.0, 0.0);
        for (b, _) in self.monitors.iter().enumerate().filter(is_ok) {
            sum += self.campaign.scatter(b) / expected(b);
            baselines += 1.0;
        }
        for cell in self.campaign.cells() {
            let drive = about(&cell.drive(), &self.supplies);
            model.surrogate.predict(&self.linearised, &drive, &mut self.prediction);
            for (b, _) in self.monitors.iter().enumerate().filter(is_ok) {
                let (mean, count) = cell.mean(b);
                let (d, _) = self.gaussian.effective(b, column(self.prediction.jacobian.as_slice(), N, b));
                let measured = mean - self.prediction.reading.get(b).copied().unwrap_or(0.0);
                let residual = f64::from(measured) - self.gaussian.baseline(b) - dot(&d, &self.solution.delta);
                sum += f64::from(count) * residual * residual / expected(b);
                readings += f64::from(count);
            }
        }
        let degrees_of_freedom = (readings - baselines - layout.params() as f64) as f32;
        FitQuality { chi_square: sum as f32, degrees_of_freedom }
    }
}
