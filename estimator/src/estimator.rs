//! The path of a frame: bytes, drive, prediction, innovation, gate, Gaussian, estimate.

use core::fmt;

use heapless::Deque;

use crate::campaign::{Campaign, Setting, Verdict};
use crate::drive::{Beyond, Calibration, Drive};
use crate::estimate::{Estimate, MonitorState};
use crate::frame::{Frame, FrameError, PositionCode};
use crate::gaussian::{Gaussian, Level, Solution, Sum};
use crate::linear::{column, dot};
use crate::monitor::{Gate, Monitor};
use crate::prior::Prior;
use crate::surrogate::{Prediction, Surrogate};

/// What is known beforehand; read only. Two models can be compared on the same frames.
#[derive(Debug, Clone)]
pub struct Model<G> {
    /// The ring.
    pub surrogate: G,
    /// Prior of each `theta = ln var`.
    pub prior: Prior,
    /// From read-backs to kicks and gradients.
    pub calibration: Calibration,
    /// Expected noise of a reading [m].
    pub noise: f32,
    /// When readings agree.
    pub gate: Gate,
    /// Random walk of each theta, standard deviation per `sqrt(frame)`; 0 for constant vars.
    pub process_noise: f32,
}

/// A model, and the posterior that frames have made of it: `B` monitors, `C` correctors, `N` params, `S` settings.
#[derive(Debug, Clone)]
pub struct Estimator<G: Surrogate<B, C, N>, const B: usize, const C: usize, const N: usize, const S: usize> {
    model: Model<G>,
    last_sequence: Option<u32>,
    frames: u32,
    rejected_frames: u32,
    /// The surrogate at the origin of the Gaussian.
    linearised: G::Linearised,
    /// `ln` of the supplies' mean factors at which it was linearised.
    supplies: [f32; 2],
    prediction: Prediction<B, N>,
    at_mean_drive: Prediction<B, N>,
    monitors: [Monitor; B],
    campaign: Campaign<B, C, S>,
    gaussian: Gaussian<B, N>,
    /// The prior, and frames that belong to no setting and are not recent: they cannot be linearised anew.
    loose: Gaussian<B, N>,
    /// The last frames that belong to no setting.
    recent: Deque<Loose<B, C>, RECENT>,
    solution: Solution<N>,
    /// Rms of the baseline orbit in x and y [m].
    orbit: [f32; 2],
    /// RF offset of the frame at hand.
    rf_offset: f32,
    /// Sum of NIS, and the number of readings in it.
    nis: (Sum, u32),
    /// The past has to be weighted anew.
    stale: bool,
}

/// Why a frame was refused. The posterior is as it was.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum IngestError {
    /// The bytes are not a frame.
    Frame(FrameError),
    /// The frame has come before.
    Repeated {
        /// Its sequence number.
        sequence: u32,
    },
    /// A later frame has come already.
    OutOfOrder {
        /// The last sequence number.
        last: u32,
        /// This one.
        got: u32,
    },
    /// The currents are beyond what the model describes.
    Beyond(Beyond),
}

impl From<FrameError> for IngestError {
    fn from(error: FrameError) -> Self {
        Self::Frame(error)
    }
}

impl fmt::Display for IngestError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Frame(error) => error.fmt(f),
            Self::Repeated { sequence } => write!(f, "frame {sequence} has come before"),
            Self::OutOfOrder { last, got } => write!(f, "frame {got} after frame {last}"),
            Self::Beyond(Beyond { what, limit, got }) => write!(f, "{what} is {got}, the model ends at {limit}"),
        }
    }
}

impl core::error::Error for IngestError {}

/// How well the model at the MAP describes the readings of monitors in state ok.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitQuality {
    /// Sum of (residual / expected noise)^2.
    pub chi_square: f32,
    /// Readings less baselines less params.
    pub degrees_of_freedom: f32,
}

/// A frame that belongs to no setting.
#[derive(Debug, Clone)]
struct Loose<const B: usize, const C: usize> {
    drive: Drive<C>,
    reading: [PositionCode; B],
    accepted: u64,
}

/// Frames without a setting that are linearised anew with the rest; older ones keep the linearisation that they had when
/// they left this window. At the start of a stream it holds 16 times 33 readings, enough for 48 params.
const RECENT: usize = 16;

/// Which readings of a frame are used.
#[derive(Debug, Clone, Copy, Default)]
struct Screened {
    accepted: u64,
    rejected: u64,
    confirmed: u64,
    restarted: u64,
}

impl<const B: usize, const C: usize> Loose<B, C> {
    /// Measured minus predicted, before the baseline [m].
    fn innovation(&self, b: usize, predicted: &[f32; B]) -> f32 {
        match (self.reading.get(b), predicted.get(b)) {
            (Some(reading), Some(predicted)) => reading.value() - predicted,
            _ => 0.0,
        }
    }
}

impl Screened {
    fn note(&mut self, b: usize, verdict: Verdict) {
        let bit = 1 << b;
        match verdict {
            Verdict::Accepted => self.accepted |= bit,
            Verdict::Held => self.rejected |= bit,
            Verdict::Confirms { outvotes } => {
                self.accepted |= bit;
                self.confirmed |= bit;
                self.restarted |= if outvotes { bit } else { 0 };
            }
        }
    }
}

/// A param that has moved by this many error bars calls for a new linearisation.
const MOVED: f32 = 0.5;
/// Share of a prediction's own variance that is added to the noise of a reading which cannot be linearised anew: while
/// the params are uncertain, so is the linearisation.
///
/// Source: W. M. Lear's underweighting; R. Zanetti, K. DeMars and R. Bishop, J. Guid. Control Dyn. 33 (2010) 1670.
const UNDERWEIGHT: f32 = 0.2;
/// Growth of chi-square that counts as uphill: more than rounding of a chi-square of 1e5.
const UPHILL: f32 = 1.0;
/// Halvings of a step that leads uphill or to an unstable ring.
const HALVINGS: u32 = 4;
/// A setting whose information on all params together is less than this share of the prior's on one tells of its
/// monitor's baseline only. A thousand of them leave less than a hundredth of the prior's information unused.
const QUIET: f32 = 2e-4;
/// While the params have walked less than this share of an error bar, the past still counts as one ring.
const WALKED: f32 = 0.1;

impl<G: Surrogate<B, C, N>, const B: usize, const C: usize, const N: usize, const S: usize> Estimator<G, B, C, N, S> {
    /// Start from the prior, linearised at vars = 1.
    ///
    /// # Errors
    /// [`crate::surrogate::Unstable`] if the surrogate has no design.
    pub fn try_new(model: Model<G>) -> Result<Self, crate::surrogate::Unstable> {
        let mut linearised = G::Linearised::default();
        model.surrogate.linearise(&[1.0; N], &mut linearised)?;
        let loose = Gaussian::prior(&model.prior);
        let mut gaussian = loose.clone();
        gaussian.recentre(&[0.0; N]);
        let mut solution = Solution::default();
        solution.solve(&gaussian, &model.prior);
        Ok(Self {
            last_sequence: None,
            frames: 0,
            rejected_frames: 0,
            linearised,
            supplies: [0.0; 2],
            prediction: Prediction::default(),
            at_mean_drive: Prediction::default(),
            monitors: core::array::from_fn(|_| Monitor::expecting(model.noise)),
            campaign: Campaign::default(),
            gaussian,
            loose,
            recent: Deque::new(),
            solution,
            orbit: [0.0; 2],
            rf_offset: 0.0,
            nis: (Sum::default(), 0),
            stale: false,
            model,
        })
    }

    /// Take one machine cycle in: bytes to estimate.
    ///
    /// # Errors
    /// [`IngestError`]; the posterior is then as it was before.
    pub fn ingest(&mut self, bytes: &mut [u8]) -> Result<Estimate<B, N>, IngestError> {
        let (frame, drive) = self.decode(bytes).inspect_err(|_| self.rejected_frames += 1)?;
        self.walk(&frame);
        let cell = self.find_setting(&frame, &drive);
        self.predict(&drive, cell);
        let screened = self.screen(&frame, cell);
        let nis = self.condition(&frame, cell, &screened);
        if cell.is_none() {
            self.keep_loose(&frame, &drive, &screened);
        }
        let linearised = self.is_due() && self.linearise_anew();
        Ok(self.estimate(&frame, cell, &screened, nis, linearised))
    }

    /// A frame that is sound, new, and of a machine state that the model describes; and what drove the beam in it.
    fn decode(&self, bytes: &mut [u8]) -> Result<(Frame<B, C>, Drive<C>), IngestError> {
        let frame = Frame::decode(bytes)?;
        match self.last_sequence {
            Some(last) if frame.sequence == last => return Err(IngestError::Repeated { sequence: last }),
            Some(last) if frame.sequence < last => return Err(IngestError::OutOfOrder { last, got: frame.sequence }),
            _ => {}
        }
        let drive = self.model.calibration.drive(&frame).map_err(IngestError::Beyond)?;
        Ok((frame, drive))
    }

    /// Let the params walk for the cycles since the last frame.
    fn walk(&mut self, frame: &Frame<B, C>) {
        let cycles = self.last_sequence.map_or(0, |last| frame.sequence.saturating_sub(last));
        self.last_sequence = Some(frame.sequence);
        self.frames = self.frames.saturating_add(1);
        if self.model.process_noise > 0.0 && cycles > 0 {
            // After a long silence the vars are unknown, but not more than the range of the prior allows.
            let prior = self.model.prior.sigma * self.model.prior.sigma;
            let largest = self.solution.sigma.iter().fold(0.0, |a: f32, sigma| a.max(sigma * sigma));
            let variance = self.model.process_noise * self.model.process_noise * cycles as f32;
            let sigma = libm::sqrtf(variance.min((2.0 * prior - largest).max(0.0)));
            self.gaussian.walk(sigma, &mut self.solution);
            self.solve();
        }
    }

    /// The cell of the frame's setting, its drive counted in. Several correctors at once belong to none.
    fn find_setting(&mut self, frame: &Frame<B, C>, drive: &Drive<C>) -> Option<u16> {
        let setting = Setting::of(frame, self.model.calibration.powered)?;
        let index = self.campaign.find(&setting)?;
        self.campaign.cell_mut(index)?.add_drive(drive);
        Some(index)
    }

    /// Predict the frame, and what the mean drive of its setting would have made.
    fn predict(&mut self, drive: &Drive<C>, cell: Option<u16>) {
        let drive = about(drive, &self.supplies);
        self.model.surrogate.predict(&self.linearised, &drive, &mut self.prediction);
        self.rf_offset = drive.rf_offset;
        let mean = cell.and_then(|index| self.campaign.cells().get(usize::from(index))).map(|cell| cell.drive());
        if let Some(mean) = mean {
            let mean = about(&mean, &self.supplies);
            self.model.surrogate.predict(&self.linearised, &mean, &mut self.at_mean_drive);
        }
    }

    /// Decide which readings to use, and learn each monitor's noise from its repeats.
    fn screen(&mut self, frame: &Frame<B, C>, cell: Option<u16>) -> Screened {
        let mut screened = Screened::default();
        for b in 0..B {
            let Some(code) = frame.reading.get(b).map(|r| r.steps()) else { continue };
            let valid = frame.is_valid(b);
            let usable = self.monitors.get_mut(b).is_some_and(|m| m.hear(valid.then_some(code)));
            if usable {
                match cell {
                    Some(index) => self.screen_repeat(b, code, index, &mut screened),
                    None => self.screen_loose(b, code, &mut screened),
                }
            }
            if self.monitors.get_mut(b).is_some_and(Monitor::judge) {
                self.stale = true;
            }
        }
        if cell.is_none() {
            self.excuse(&mut screened);
        }
        screened
    }

    /// Monitors fail one at a time: when more than an eighth of a frame without a setting surprises, the model is at
    /// fault, and all of it is used. (In a setting the repeats decide.)
    fn excuse(&mut self, screened: &mut Screened) {
        let (accepted, rejected) = (screened.accepted.count_ones(), screened.rejected.count_ones());
        if 8 * rejected > accepted + rejected {
            let each = self.monitors.iter_mut().enumerate();
            each.filter(|(b, _)| screened.rejected >> b & 1 == 1).for_each(|(_, monitor)| monitor.pardon());
            screened.accepted |= screened.rejected;
            screened.rejected = 0;
        }
    }

    /// A reading in a setting is judged by its repeats, the first one by the model.
    fn screen_repeat(&mut self, b: usize, code: i32, index: u16, screened: &mut Screened) {
        let (expected, moved) = (self.is_expected(b, code), self.moved_to_mean_drive(b, code));
        let (Some(monitor), Some(cell)) = (self.monitors.get_mut(b), self.campaign.cell_mut(index)) else { return };
        if let Some(difference) = cell.difference(b, moved) {
            monitor.noise.learn(difference);
        }
        let verdict = cell.judge(b, moved, monitor.noise.sigma(), self.model.gate, expected);
        let scatter = cell.take(b, code, moved, verdict);
        match verdict {
            Verdict::Accepted => {}
            Verdict::Confirms { .. } => monitor.pardon(),
            Verdict::Held => monitor.reject(),
        }
        screened.note(b, verdict);
        self.campaign.add_scatter(b, scatter);
    }

    /// A reading without a setting passes if the model expects it.
    fn screen_loose(&mut self, b: usize, code: i32, screened: &mut Screened) {
        let verdict = if self.is_expected(b, code) { Verdict::Accepted } else { Verdict::Held };
        if let (Verdict::Held, Some(monitor)) = (verdict, self.monitors.get_mut(b)) {
            monitor.reject();
        }
        screened.note(b, verdict);
    }

    /// True if the model, with all its uncertainty, expects a reading.
    fn is_expected(&self, b: usize, code: i32) -> bool {
        let (d, baseline_variance) = self.gaussian.effective(b, self.slope(b));
        let predicted = self.gaussian.baseline(b) + dot(&d, self.solution.delta.as_slice());
        let surprise = self.innovation(b, code) - predicted;
        let certain = self.variance(b, 1, self.rf_offset) + baseline_variance;
        // the uncertainty of the params is only worked out for readings that need it
        self.model.gate.expects(surprise, certain)
            || self.model.gate.expects(surprise, certain + (1.0 + UNDERWEIGHT) * self.solution.variance_of(&d))
    }

    /// Measured minus predicted at the origin, before the baseline [m].
    fn innovation(&self, b: usize, code: i32) -> f32 {
        metres(code) - self.prediction.reading.get(b).copied().unwrap_or(0.0)
    }

    /// A reading as the mean drive of its setting would have made it, in steps.
    fn moved_to_mean_drive(&self, b: usize, code: i32) -> i32 {
        let shift = match (self.at_mean_drive.reading.get(b), self.prediction.reading.get(b)) {
            (Some(mean), Some(this)) => mean - this,
            _ => 0.0,
        };
        let moved = code.saturating_add(libm::roundf(shift / PositionCode::METRES_PER_LSB) as i32);
        moved.clamp(-PositionCode::LIMIT, PositionCode::LIMIT)
    }

    fn slope(&self, b: usize) -> &[f32] {
        column(self.prediction.jacobian.as_slice(), N, b)
    }

    /// Variance of the mean of `n` repeats: the monitor's noise, and the stated error of the surrogate, which is the same
    /// in all of them [m^2].
    fn variance(&self, b: usize, n: u32, rf_offset: f32) -> f32 {
        let orbit = self.orbit[usize::from(b >= self.model.surrogate.horizontal_monitors())];
        let error = self.model.surrogate.error_variance(b, rf_offset, orbit);
        self.noise_variance(b) / n.max(1) as f32 + error
    }

    fn noise_variance(&self, b: usize) -> f32 {
        self.monitors.get(b).map_or(f32::MAX, Monitor::variance)
    }

    /// Add the readings that passed; returns their joint NIS, the growth of the smallest chi-square.
    fn condition(&mut self, frame: &Frame<B, C>, cell: Option<u16>, screened: &Screened) -> f32 {
        let before = self.solution.cost;
        let underweight = if cell.is_none() || !self.is_still() { UNDERWEIGHT } else { 0.0 };
        for b in (0..B).filter(|b| screened.accepted >> b & 1 == 1) {
            let Some(code) = frame.reading.get(b).map(|r| r.steps()) else { continue };
            let (innovation, variance) = (self.innovation(b, code), self.variance(b, 1, self.rf_offset));
            let slope = column(self.prediction.jacobian.as_slice(), N, b);
            let own = underweight * self.solution.variance_of(&self.gaussian.effective(b, slope).0);
            self.gaussian.condition(b, innovation, variance + own, slope);
        }
        self.gaussian.settle();
        // Readings confirmed late or outvoted are counted when the past is weighted anew, and so is an error that repeats
        // share.
        self.stale |= screened.confirmed != 0 || screened.restarted != 0 || frame.rf_offset.steps() != 0;
        self.solve();
        let nis = self.solution.cost - before;
        self.nis.0.add(nis);
        self.nis.1 = self.nis.1.saturating_add(screened.accepted.count_ones());
        nis
    }

    /// Keep a frame that belongs to no setting among the recent ones; the oldest of them is linearised for the last time.
    fn keep_loose(&mut self, frame: &Frame<B, C>, drive: &Drive<C>, screened: &Screened) {
        if self.recent.is_full()
            && let Some(oldest) = self.recent.pop_front()
        {
            self.loose.recentre(self.gaussian.origin());
            let drive = about(&oldest.drive, &self.supplies);
            self.model.surrogate.predict(&self.linearised, &drive, &mut self.at_mean_drive);
            for b in (0..B).filter(|b| oldest.accepted >> b & 1 == 1) {
                let variance = self.variance(b, 1, drive.rf_offset);
                let slope = column(self.at_mean_drive.jacobian.as_slice(), N, b);
                let own = UNDERWEIGHT * self.solution.variance_of(&self.loose.effective(b, slope).0);
                let innovation = oldest.innovation(b, &self.at_mean_drive.reading);
                self.loose.condition(b, innovation, variance + own, slope);
            }
            self.loose.settle();
        }
        let kept = Loose { drive: *drive, reading: frame.reading, accepted: screened.accepted };
        // there is room: one has just left
        let _ = self.recent.push_back(kept);
    }

    fn solve(&mut self) {
        self.solution.solve(&self.gaussian, &self.model.prior);
        let split = self.model.surrogate.horizontal_monitors();
        self.orbit = [self.gaussian.orbit(0, split), self.gaussian.orbit(split, B)];
    }

    /// True if the MAP has left the origin, or the past has to be weighted anew.
    fn is_due(&self) -> bool {
        let each = self.solution.map_params.iter().zip(self.gaussian.origin()).zip(&self.solution.sigma);
        self.stale || each.into_iter().any(|((map, origin), sigma)| (map - origin).abs() > MOVED * sigma)
    }

    /// Linearise at the MAP, by a damped Gauss-Newton step: halved while it leads uphill or to an unstable ring.
    fn linearise_anew(&mut self) -> bool {
        let from = *self.gaussian.origin();
        let mut to = self.solution.map_params;
        // A past that is weighted anew has another chi-square; the step is then judged with the next one.
        let uphill = if self.stale || !self.is_still() { f32::MAX } else { self.gaussian.cost() + UPHILL };
        self.stale = false;
        for _ in 0..HALVINGS {
            if self.linearise_at(&to) && self.gaussian.cost() <= uphill {
                self.solve();
                return true;
            }
            to.iter_mut().zip(&from).for_each(|(to, from)| *to = 0.5 * (*to + from));
        }
        let back = self.linearise_at(&from);
        self.solve();
        back
    }

    fn linearise_at(&mut self, params: &[f32; N]) -> bool {
        let supplies = self.campaign.mean_strength();
        let first = self.model.surrogate.first_family();
        let mut strength = [0.0; N];
        for (i, (strength, theta)) in strength.iter_mut().zip(params).enumerate() {
            *strength = libm::expf(theta + supplies[usize::from(i >= first)]);
        }
        if self.model.surrogate.linearise(&strength, &mut self.linearised).is_err() {
            return false;
        }
        self.supplies = supplies;
        if self.is_still() {
            self.rebuild(params);
        } else {
            self.gaussian.recentre(params);
        }
        true
    }

    /// True while all frames so far have seen the same ring.
    fn is_still(&self) -> bool {
        let walked = self.model.process_noise * libm::sqrtf(self.frames as f32);
        self.solution.sigma.iter().all(|sigma| walked <= WALKED * sigma)
    }

    /// The Gaussian of all frames so far, linearised at `params`.
    fn rebuild(&mut self, params: &[f32; N]) {
        self.gaussian.clone_from(&self.loose);
        self.gaussian.recentre(params);
        let mut levels = [Level::default(); B];
        for cell in self.campaign.cells() {
            let drive = about(&cell.drive(), &self.supplies);
            self.model.surrogate.predict(&self.linearised, &drive, &mut self.prediction);
            for (b, level) in levels.iter_mut().enumerate() {
                let (mean, count) = cell.mean(b);
                if count == 0 {
                    continue;
                }
                let slope = column(self.prediction.jacobian.as_slice(), N, b);
                let innovation = mean - self.prediction.reading.get(b).copied().unwrap_or(0.0);
                let variance = self.variance(b, count, drive.rf_offset);
                if dot(slope, slope) < variance * self.quiet() {
                    self.gaussian.merge(level, innovation, variance);
                } else {
                    self.gaussian.condition(b, innovation, variance, slope);
                }
                self.gaussian.add_repeats(count, self.noise_variance(b));
            }
        }
        for frame in &self.recent {
            let drive = about(&frame.drive, &self.supplies);
            self.model.surrogate.predict(&self.linearised, &drive, &mut self.prediction);
            for b in (0..B).filter(|b| frame.accepted >> b & 1 == 1) {
                let slope = column(self.prediction.jacobian.as_slice(), N, b);
                let innovation = frame.innovation(b, &self.prediction.reading);
                self.gaussian.condition(b, innovation, self.variance(b, 1, drive.rf_offset), slope);
            }
        }
        for (b, level) in levels.iter().enumerate() {
            self.gaussian.condition_level(b, level);
            self.gaussian.add_scatter(self.campaign.scatter(b) / self.noise_variance(b));
        }
        self.gaussian.settle();
    }

    /// Information below which a setting says nothing of the params: that of the stray currents of idle correctors.
    fn quiet(&self) -> f32 {
        QUIET / (self.model.prior.sigma * self.model.prior.sigma)
    }

    fn estimate(
        &self,
        frame: &Frame<B, C>,
        cell: Option<u16>,
        screened: &Screened,
        nis: f32,
        linearised: bool,
    ) -> Estimate<B, N> {
        let solution = &self.solution;
        let mut estimate = Estimate {
            sequence: frame.sequence,
            time_us: frame.time_us,
            frames: self.frames,
            rejected_frames: self.rejected_frames,
            mean: [0.0; N],
            sigma: [0.0; N],
            map_params: solution.map_params,
            centre: core::array::from_fn(|i| self.centre(i)),
            params_sigma: solution.sigma,
            clipped: solution.clipped,
            nis,
            accepted: screened.accepted,
            rejected: screened.rejected,
            confirmed: screened.confirmed,
            restarted: screened.restarted,
            setting: cell,
            log_evidence: solution.log_evidence,
            linearised,
            health: core::array::from_fn(|b| self.monitors.get(b).map(Monitor::health).unwrap_or_default()),
        };
        for i in 0..N {
            let moments = estimate.marginal(i, &self.model.prior).map(|m| m.moments());
            if let (Some((var, spread)), Some(mean), Some(sigma)) =
                (moments, estimate.mean.get_mut(i), estimate.sigma.get_mut(i))
            {
                (*mean, *sigma) = (var, spread);
            }
        }
        estimate
    }

    /// Centre of a param's normal before truncation: the MAP, or for a clipped param the unbounded optimum.
    fn centre(&self, i: usize) -> f32 {
        let clipped = self.solution.clipped >> i & 1 == 1;
        let origin = self.gaussian.origin().get(i).copied().unwrap_or(0.0);
        let unbounded = origin + self.solution.delta.as_slice().get(i).copied().unwrap_or(0.0);
        if clipped { unbounded } else { self.solution.map_params.get(i).copied().unwrap_or(unbounded) }
    }

    /// The model.
    pub fn model(&self) -> &Model<G> {
        &self.model
    }

    /// Covariance of two params `theta = ln var`.
    pub fn covariance(&self, i: usize, j: usize) -> f32 {
        if i < N && j < N { self.solution.covariance(i, j) } else { 0.0 }
    }

    /// How well the model describes the readings of monitors in state ok, by the expected noise.
    ///
    /// With constant vars: residuals of all frames that belong to a setting, at the MAP. With a random walk: innovations, each
    /// against the vars of its own time, counted in NIS.
    pub fn fit_quality(&mut self) -> FitQuality {
        if !self.is_still() {
            return FitQuality { chi_square: self.nis.0.value(), degrees_of_freedom: self.nis.1 as f32 };
        }
        let expected = self.model.noise * self.model.noise;
        let is_ok = |(_, monitor): &(usize, &Monitor)| monitor.health().state == MonitorState::Ok;
        let (mut sum, mut readings, mut baselines) = (Sum::default(), 0.0, 0.0);
        for (b, _) in self.monitors.iter().enumerate().filter(is_ok) {
            sum.add(self.campaign.scatter(b) / expected);
            baselines += 1.0;
        }
        for cell in self.campaign.cells() {
            let drive = about(&cell.drive(), &self.supplies);
            self.model.surrogate.predict(&self.linearised, &drive, &mut self.prediction);
            for (b, _) in self.monitors.iter().enumerate().filter(is_ok) {
                let (mean, count) = cell.mean(b);
                let (d, _) = self.gaussian.effective(b, column(self.prediction.jacobian.as_slice(), N, b));
                let predicted = self.prediction.reading.get(b).copied().unwrap_or(0.0) + self.gaussian.baseline(b);
                let residual = mean - predicted - dot(&d, self.solution.delta.as_slice());
                sum.add(count as f32 * residual * residual / expected);
                readings += count as f32;
            }
        }
        FitQuality { chi_square: sum.value(), degrees_of_freedom: readings - baselines - N as f32 }
    }
}

/// A drive seen from the supplies' mean: what is left for first order.
fn about<const C: usize>(drive: &Drive<C>, supplies: &[f32; 2]) -> Drive<C> {
    Drive { strength: [drive.strength[0] - supplies[0], drive.strength[1] - supplies[1]], ..*drive }
}

fn metres(code: i32) -> f32 {
    code as f32 * PositionCode::METRES_PER_LSB
}
