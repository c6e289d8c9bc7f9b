//! The path of a frame: bytes, drive, prediction, innovation, gate, Gaussian, estimate. What decides on readings stands
//! in `screen.rs`, what linearises anew in `laplace.rs`, both below this file.
//!
//! The steps are not inlined: a chip's stack then holds one of them at a time, and instruction counts can name them.

mod laplace;
mod screen;

use core::fmt;

use heapless::Deque;
use serde::{Deserialize, Serialize};

use crate::campaign::{Campaign, Setting};
use crate::drive::{Beyond, Calibration, Drive};
use crate::estimate::Estimate;
use crate::frame::{Frame, FrameError, PositionCode};
use crate::gaussian::{Gaussian, Solution};
use crate::linear::column;
use crate::monitor::{Gate, Monitor};
use crate::prior::Prior;
use crate::sum::Sum;
use crate::surrogate::{Prediction, Surrogate};

pub use laplace::FitQuality;
use screen::Screened;

/// What is known beforehand, besides the ring.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Setup {
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

impl Setup {
    /// True if every number is one, and every size positive.
    pub fn is_sound(&self) -> bool {
        let Self { prior, calibration, noise, gate, process_noise } = self;
        let sizes = [prior.sigma, *noise, gate.sigmas, calibration.powered, prior.upper - prior.lower];
        let numbers = calibration.transfer.iter().chain(&calibration.nominal);
        let mut numbers = numbers.chain([&calibration.kick_per_ampere, &prior.mean, process_noise]).chain(&sizes);
        numbers.all(|v| v.is_finite())
            && sizes.iter().chain(&calibration.nominal).all(|v| *v > 0.0)
            && *process_noise >= 0.0
    }
}

/// The ring and all else that is known beforehand; read only. Two models can be compared on the same frames.
#[derive(Debug)]
pub struct Model<'a, G> {
    /// The ring.
    pub surrogate: &'a G,
    /// All else.
    pub setup: &'a Setup,
}

/// The posterior that frames have made of a model: `B` monitors, `C` correctors, `N` params, `S` settings; `T` entries make
/// a triangle of `N`.
#[derive(Debug, Clone)]
pub struct Estimator<
    G: Surrogate<B, C, N>,
    const B: usize,
    const C: usize,
    const N: usize,
    const S: usize,
    const T: usize,
> {
    started: bool,
    last_sequence: Option<u32>,
    /// All is done that can be before the next frame: linearised if due, and the params walked one cycle ahead.
    prepared: bool,
    frames: u32,
    rejected_frames: u32,
    /// The surrogate at the origin of the Gaussian.
    linearised: G::Linearised,
    /// Linearised since the last estimate.
    news: bool,
    /// `ln` of the supplies' mean factors at which it was linearised.
    supplies: [f32; 2],
    prediction: Prediction<B, N>,
    /// Readings that the mean drive of the frame's setting would have made [m].
    at_mean_drive: [f32; B],
    monitors: [Monitor; B],
    campaign: Campaign<B, C, S>,
    gaussian: Gaussian<B, N, T>,
    /// The prior, and frames that belong to no setting and are not recent: they cannot be linearised anew.
    loose: Gaussian<B, N, T>,
    /// The last frames that belong to no setting.
    recent: Deque<Loose<B, C>, RECENT>,
    solution: Solution<N, T>,
    /// Rms of the baseline orbit in x and y [m].
    orbit: [f32; 2],
    /// RF offset of the frame at hand.
    rf_offset: f32,
    /// Sum of NIS, and the number of readings in it.
    nis: (Sum, u32),
    /// Frames without a setting in a row that surprised all over.
    surprises: u32,
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
    /// No posterior yet: [`Estimator::restart`] was not called, or found no design.
    NotStarted,
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
            Self::NotStarted => write!(f, "frame before the estimator was started"),
        }
    }
}

impl core::error::Error for IngestError {}

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

impl<const B: usize, const C: usize> Loose<B, C> {
    /// Measured minus predicted, before the baseline [m].
    fn innovation(&self, b: usize, predicted: &[f32; B]) -> f32 {
        match (self.reading.get(b), predicted.get(b)) {
            (Some(reading), Some(predicted)) => reading.value() - predicted,
            _ => 0.0,
        }
    }
}

/// Share of a prediction's own variance that is added to the noise of a reading which cannot be linearised anew: while
/// the params are uncertain, so is the linearisation.
///
/// Source: W. M. Lear's underweighting; R. Zanetti, K. DeMars and R. Bishop, J. Guid. Control Dyn. 33 (2010) 1670.
const UNDERWEIGHT: f32 = 0.2;

impl<G: Surrogate<B, C, N>, const B: usize, const C: usize, const N: usize, const S: usize, const T: usize>
    Estimator<G, B, C, N, S, T>
{
    /// Memory for one, all zero, so that it costs no flash; [`Estimator::restart`] gives it a posterior.
    pub const BLANK: Self = Self {
        started: false,
        last_sequence: None,
        prepared: false,
        frames: 0,
        rejected_frames: 0,
        linearised: G::BLANK,
        news: false,
        supplies: [0.0; 2],
        prediction: Prediction::BLANK,
        at_mean_drive: [0.0; B],
        monitors: [const { Monitor::BLANK }; B],
        campaign: Campaign::BLANK,
        gaussian: Gaussian::BLANK,
        loose: Gaussian::BLANK,
        recent: Deque::new(),
        solution: Solution::BLANK,
        orbit: [0.0; 2],
        rf_offset: 0.0,
        nis: (Sum::ZERO, 0),
        surprises: 0,
        stale: false,
    };

    /// Start from the prior, linearised at vars = 1, all frames forgotten.
    ///
    /// # Errors
    /// [`crate::surrogate::Unstable`] if the surrogate has no design.
    pub fn restart(&mut self, model: &Model<'_, G>) -> Result<(), crate::surrogate::Unstable> {
        self.started = false;
        model.surrogate.linearise(&[1.0; N], &mut self.linearised)?;
        (self.last_sequence, self.prepared, self.frames, self.rejected_frames) = (None, true, 0, 0);
        (self.supplies, self.orbit, self.rf_offset) = ([0.0; 2], [0.0; 2], 0.0);
        (self.nis, self.surprises, self.stale, self.news) = ((Sum::ZERO, 0), 0, false, false);
        self.monitors.iter_mut().for_each(|monitor| monitor.expect(model.setup.noise));
        self.campaign.clear();
        self.recent.clear();
        self.loose.reset(&model.setup.prior);
        self.gaussian.clone_from(&self.loose);
        self.gaussian.recentre(&[0.0; N]);
        self.solution.solve(&self.gaussian, &model.setup.prior);
        self.started = true;
        Ok(())
    }

    /// Take one machine cycle in: bytes to estimate.
    ///
    /// # Errors
    /// [`IngestError`]; the posterior is then as it was before.
    #[inline(never)]
    pub fn ingest(&mut self, model: &Model<'_, G>, bytes: &mut [u8]) -> Result<Estimate<B, N>, IngestError> {
        let (frame, drive) =
            self.decode(model, bytes).inspect_err(|_| self.rejected_frames = self.rejected_frames.saturating_add(1))?;
        self.catch_up(model, &frame);
        let cell = self.find_setting(model, &frame, &drive);
        self.predict(model, &drive, cell);
        let screened = self.screen(model, &frame, cell);
        let nis = self.condition(model, &frame, cell, &screened);
        if cell.is_none() {
            self.keep_loose(model, &frame, &drive, &screened);
        }
        Ok(self.estimate(model, &frame, cell, &screened, nis))
    }

    /// What can be done between frames, so that the next one is answered at once: linearise anew if that is due (true if
    /// it was done), and let the params walk for one cycle. To be called after each frame; a second call does nothing.
    #[inline(never)]
    pub fn prepare(&mut self, model: &Model<'_, G>) -> bool {
        if !self.started || self.prepared {
            return false;
        }
        self.prepared = true;
        let linearised = self.is_due() && self.linearise_anew(model);
        self.news |= linearised;
        self.walk(model, 1);
        linearised
    }

    /// Take the next frame as new, whatever its number: its sender counts anew.
    pub fn forget_sequence(&mut self) {
        self.last_sequence = None;
    }

    /// Go over to another model of the same machine: all frames so far are weighed anew by it.
    ///
    /// # Errors
    /// [`crate::surrogate::Unstable`] if it has no ring at the vars at hand; the former model is then to be adopted again.
    pub fn adopt(&mut self, model: &Model<'_, G>) -> Result<(), crate::surrogate::Unstable> {
        self.stale = true;
        if self.started && !self.linearise_anew(model) {
            return Err(crate::surrogate::Unstable);
        }
        self.news |= self.started;
        Ok(())
    }

    /// A frame that is sound, new, and of a machine state that the model describes; and what drove the beam in it.
    #[inline(never)]
    fn decode(&self, model: &Model<'_, G>, bytes: &mut [u8]) -> Result<(Frame<B, C>, Drive<C>), IngestError> {
        if !self.started {
            return Err(IngestError::NotStarted);
        }
        let frame = Frame::decode(bytes)?;
        match self.last_sequence {
            Some(last) if frame.sequence == last => return Err(IngestError::Repeated { sequence: last }),
            Some(last) if frame.sequence < last => return Err(IngestError::OutOfOrder { last, got: frame.sequence }),
            _ => {}
        }
        let drive = model.setup.calibration.drive(&frame).map_err(IngestError::Beyond)?;
        Ok((frame, drive))
    }

    /// Let the params walk for cycles that were lost since the last frame.
    fn catch_up(&mut self, model: &Model<'_, G>, frame: &Frame<B, C>) {
        let cycles = self.last_sequence.map_or(0, |last| frame.sequence.saturating_sub(last));
        self.walk(model, cycles.saturating_sub(u32::from(self.prepared)));
        self.last_sequence = Some(frame.sequence);
        self.frames = self.frames.saturating_add(1);
        self.prepared = false;
    }

    #[inline(never)]
    fn walk(&mut self, model: &Model<'_, G>, cycles: u32) {
        let noise = model.setup.process_noise;
        if noise > 0.0 && cycles > 0 {
            // After a long silence the vars are unknown, but not more than the range of the prior allows.
            let prior = model.setup.prior.sigma * model.setup.prior.sigma;
            let largest = self.solution.sigma.iter().fold(0.0, |a: f32, sigma| a.max(sigma * sigma));
            let variance = noise * noise * cycles as f32;
            let sigma = libm::sqrtf(variance.min((2.0 * prior - largest).max(0.0)));
            self.gaussian.walk(sigma, &mut self.solution);
            self.solve(model);
        }
    }

    /// The cell of the frame's setting, its drive counted in. Several correctors at once belong to none.
    fn find_setting(&mut self, model: &Model<'_, G>, frame: &Frame<B, C>, drive: &Drive<C>) -> Option<u16> {
        let setting = Setting::of(frame, model.setup.calibration.powered)?;
        let index = self.campaign.find(&setting)?;
        self.campaign.cell_mut(index)?.add_drive(drive);
        Some(index)
    }

    /// Predict what the mean drive of the frame's setting would have made, and the frame.
    #[inline(never)]
    fn predict(&mut self, model: &Model<'_, G>, drive: &Drive<C>, cell: Option<u16>) {
        let mean = cell.and_then(|index| self.campaign.cells().get(usize::from(index))).map(|cell| cell.drive());
        if let Some(mean) = mean {
            model.surrogate.orbit(&self.linearised, &about(&mean, &self.supplies), &mut self.at_mean_drive);
        }
        self.predict_drive(model, drive);
        self.rf_offset = drive.rf_offset;
    }

    fn predict_drive(&mut self, model: &Model<'_, G>, drive: &Drive<C>) {
        model.surrogate.predict(&self.linearised, &about(drive, &self.supplies), &mut self.prediction);
    }

    /// Measured minus predicted at the origin, before the baseline [m].
    fn innovation(&self, b: usize, code: i32) -> f32 {
        metres(code) - self.prediction.reading.get(b).copied().unwrap_or(0.0)
    }

    fn slope(&self, b: usize) -> &[f32] {
        column(self.prediction.jacobian.as_slice(), N, b)
    }

    /// Variance of the mean of `n` repeats: the monitor's noise, and the stated error of the surrogate, which is the same
    /// in all of them [m^2].
    fn variance(&self, model: &Model<'_, G>, b: usize, n: u32, rf_offset: f32) -> f32 {
        self.noise_variance(b) / n.max(1) as f32 + self.shared_variance(model, b, rf_offset)
    }

    /// Variance that repeats of a reading share: the stated error of the surrogate [m^2].
    fn shared_variance(&self, model: &Model<'_, G>, b: usize, rf_offset: f32) -> f32 {
        let [orbit_x, orbit_y] = self.orbit;
        let orbit = if b < model.surrogate.horizontal_monitors() { orbit_x } else { orbit_y };
        model.surrogate.error_variance(b, rf_offset, orbit)
    }

    /// What a reading adds to its earlier repeats, as one of its own: innovation [m] and variance [m^2].
    ///
    /// The `n`-th repeat `z` of mean `m` (itself included), with noise `v` of its own and an error of variance `e` that all
    /// share, moves the mean as would an independent reading `z + n e/v (z - m)` of variance
    /// `(v + (n - 1) e)(v + n e)/v`: both means then have variance `v/n + e`.
    fn news_of(&self, model: &Model<'_, G>, b: usize, innovation: f32, cell: Option<u16>) -> (f32, f32) {
        let (own, shared) = (self.noise_variance(b), self.shared_variance(model, b, self.rf_offset));
        let cell = cell.and_then(|index| self.campaign.cells().get(usize::from(index)));
        let (n, distance) = cell.map_or((1, 0.0), |cell| (cell.mean(b).1.max(1), cell.distance(b)));
        let ratio = shared / own;
        let n = n as f32;
        (innovation + n * ratio * distance, own * (1.0 + (n - 1.0) * ratio) * (1.0 + n * ratio))
    }

    fn noise_variance(&self, b: usize) -> f32 {
        self.monitors.get(b).map_or(f32::MAX, Monitor::variance)
    }

    /// Add the readings that passed; returns their joint NIS, the growth of the smallest chi-square.
    #[inline(never)]
    fn condition(&mut self, model: &Model<'_, G>, frame: &Frame<B, C>, cell: Option<u16>, screened: &Screened) -> f32 {
        let before = self.solution.cost;
        let linearised_once = cell.is_none() || !self.is_still(model);
        for b in (0..B).filter(|b| screened.accepted >> b & 1 == 1) {
            let Some(code) = frame.reading.get(b).map(|r| r.steps()) else { continue };
            let (innovation, variance) = self.news_of(model, b, self.innovation(b, code), cell);
            let slope = column(self.prediction.jacobian.as_slice(), N, b);
            let own = if linearised_once {
                UNDERWEIGHT * self.solution.variance_of(&self.gaussian.effective(b, slope).0)
            } else {
                0.0
            };
            self.gaussian.condition(b, innovation, variance + own, slope);
        }
        self.gaussian.settle();
        // readings confirmed late or outvoted are counted when the past is weighted anew
        self.stale |= screened.confirmed != 0 || screened.restarted != 0;
        self.solve(model);
        let nis = self.solution.cost - before;
        self.nis.0.add(nis);
        self.nis.1 = self.nis.1.saturating_add(screened.accepted.count_ones());
        nis
    }

    /// Keep a frame that belongs to no setting among the recent ones; the oldest of them is linearised for the last time.
    #[inline(never)]
    fn keep_loose(&mut self, model: &Model<'_, G>, frame: &Frame<B, C>, drive: &Drive<C>, screened: &Screened) {
        if self.recent.is_full()
            && let Some(oldest) = self.recent.pop_front()
        {
            self.loose.recentre(self.gaussian.origin());
            self.predict_drive(model, &oldest.drive);
            for b in (0..B).filter(|b| oldest.accepted >> b & 1 == 1) {
                let variance = self.variance(model, b, 1, oldest.drive.rf_offset);
                let slope = column(self.prediction.jacobian.as_slice(), N, b);
                let own = UNDERWEIGHT * self.solution.variance_of(&self.loose.effective(b, slope).0);
                let innovation = oldest.innovation(b, &self.prediction.reading);
                self.loose.condition(b, innovation, variance + own, slope);
            }
            self.loose.settle();
        }
        let kept = Loose { drive: *drive, reading: frame.reading, accepted: screened.accepted };
        // there is room: one has just left
        let _ = self.recent.push_back(kept);
    }

    #[inline(never)]
    fn solve(&mut self, model: &Model<'_, G>) {
        self.solution.solve(&self.gaussian, &model.setup.prior);
        let split = model.surrogate.horizontal_monitors();
        self.orbit = [self.gaussian.orbit(0, split), self.gaussian.orbit(split, B)];
    }

    #[inline(never)]
    fn estimate(
        &mut self,
        model: &Model<'_, G>,
        frame: &Frame<B, C>,
        cell: Option<u16>,
        screened: &Screened,
        nis: f32,
    ) -> Estimate<B, N> {
        let linearised = core::mem::take(&mut self.news);
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
            let moments = estimate.marginal(i, &model.setup.prior).map(|m| m.moments());
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
        let unbounded = origin + self.solution.delta.get(i).copied().unwrap_or(0.0);
        if clipped { unbounded } else { self.solution.map_params.get(i).copied().unwrap_or(unbounded) }
    }

    /// Frames used so far.
    pub fn frames(&self) -> u32 {
        self.frames
    }

    /// Covariance of two params `theta = ln var`.
    pub fn covariance(&self, i: usize, j: usize) -> f32 {
        if i < N && j < N { self.solution.covariance(i, j) } else { 0.0 }
    }
}

/// A drive seen from the supplies' mean: what is left for first order.
fn about<const C: usize>(drive: &Drive<C>, supplies: &[f32; 2]) -> Drive<C> {
    Drive { strength: [drive.strength[0] - supplies[0], drive.strength[1] - supplies[1]], ..*drive }
}

fn metres(code: i32) -> f32 {
    code as f32 * PositionCode::METRES_PER_LSB
}
