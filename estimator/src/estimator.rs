//! The path of a frame: bytes, drive, prediction, innovation, gate, Gaussian, estimate. What decides on readings stands
//! in `screen.rs`, what linearises anew in `laplace.rs`, both below this file.

mod laplace;
mod screen;

use core::fmt;

use heapless::Deque;

use crate::campaign::{Campaign, Setting};
use crate::drive::{Beyond, Calibration, Drive};
use crate::estimate::Estimate;
use crate::frame::{Frame, FrameError, PositionCode};
use crate::gaussian::{Gaussian, Solution, Sum};
use crate::linear::column;
use crate::monitor::{Gate, Monitor};
use crate::prior::Prior;
use crate::surrogate::{Prediction, Surrogate};

pub use laplace::FitQuality;
use screen::Screened;

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
            surprises: 0,
            stale: false,
            model,
        })
    }

    /// Take one machine cycle in: bytes to estimate.
    ///
    /// # Errors
    /// [`IngestError`]; the posterior is then as it was before.
    pub fn ingest(&mut self, bytes: &mut [u8]) -> Result<Estimate<B, N>, IngestError> {
        let (frame, drive) =
            self.decode(bytes).inspect_err(|_| self.rejected_frames = self.rejected_frames.saturating_add(1))?;
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

    /// Measured minus predicted at the origin, before the baseline [m].
    fn innovation(&self, b: usize, code: i32) -> f32 {
        metres(code) - self.prediction.reading.get(b).copied().unwrap_or(0.0)
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
        let linearised_once = cell.is_none() || !self.is_still();
        for b in (0..B).filter(|b| screened.accepted >> b & 1 == 1) {
            let Some(code) = frame.reading.get(b).map(|r| r.steps()) else { continue };
            let (innovation, variance) = (self.innovation(b, code), self.variance(b, 1, self.rf_offset));
            let slope = column(self.prediction.jacobian.as_slice(), N, b);
            let own = if linearised_once {
                UNDERWEIGHT * self.solution.variance_of(&self.gaussian.effective(b, slope).0)
            } else {
                0.0
            };
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
}

/// A drive seen from the supplies' mean: what is left for first order.
fn about<const C: usize>(drive: &Drive<C>, supplies: &[f32; 2]) -> Drive<C> {
    Drive { strength: [drive.strength[0] - supplies[0], drive.strength[1] - supplies[1]], ..*drive }
}

fn metres(code: i32) -> f32 {
    code as f32 * PositionCode::METRES_PER_LSB
}
