//! The path of a frame: bytes, drive, prediction, innovation, gate ([`Estimator::judge`]), Gaussian ([`Estimator::learn`]), estimate.
//! What decides on readings stands in `screen.rs`, what linearises anew between frames in `anew.rs` and
//! `pooling.rs`, all below this file.
//!
//! The steps are not inlined: a chip's stack then holds one of them at a time, and instruction counts can name them.

mod anew;
mod drift;
mod laplace;
mod pooling;
mod posterior;
mod read_back;
mod reference;
mod remarks;
mod screen;
mod sequence;
mod steering;
mod times;
mod tunes;
mod whole;

use core::fmt;

use heapless::Deque;
use serde::{Deserialize, Serialize};

use crate::beyond::Beyond;
use crate::campaign::{Campaign, Setting};
use crate::drive::{Calibration, Drive, Each};
use crate::estimate::Estimate;
use crate::following::{self, Following};
use crate::gaussian::{Gaussian, Independent, Reading, Solution};
use crate::judged::{Judged, Screened};
use crate::linear::column;
use crate::mask::Mask;
use crate::monitor::{Gate, Monitor, Peers};
use crate::prior::Prior;
use crate::surrogate::{Prediction, Surrogate, Unstable};
use crate::tune::{TuneMeter, wrapped};
use crate::wire::{Frame, FrameError, PositionCode};

use crate::state::{self, Blank, Bytes, State, StateError, state};
use anew::Anew;
pub use anew::Prepared;
pub use laplace::FitQuality;
use pooling::Work;
use posterior::Posterior;
pub use posterior::Walk;
use read_back::ReadBack;
use reference::Reference;
use sequence::Sequence;
use times::Times;
use whole::{Whole, WholeFrames};

/// Priors that groups of params can have.
pub const GROUPS: usize = 8;

/// What is known beforehand, besides the ring.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Setup<const B: usize, const C: usize, const F: usize> {
    /// Prior of `theta = ln var`, for each group of params; which group a param is of stands in the surrogate's tables.
    pub prior: [Prior; GROUPS],
    /// From read-backs to kicks and gradients.
    pub calibration: Calibration<C, F>,
    /// Expected noise of a reading of each monitor [m].
    pub noise: Each<B>,
    /// When readings agree.
    pub gate: Gate,
    /// How params and baselines walk.
    pub walk: Walk,
    /// Calibration error of the tune meter [1], the same in all frames: the tunes of frames are readings. None, and they do
    /// not count.
    pub tune_calibration: Option<f32>,
}

impl<const B: usize, const C: usize, const F: usize> Setup<B, C, F> {
    /// True if every number is one, and every size positive.
    pub fn is_sound(&self) -> bool {
        let Self { prior, calibration, noise, gate, walk, tune_calibration } = self;
        let is_positive = |v: f32| v.is_finite() && v > 0.0;
        prior.iter().all(Prior::is_sound)
            && calibration.is_sound()
            && noise.is_positive()
            && is_positive(gate.sigmas)
            && walk.is_sound()
            && tune_calibration.is_none_or(is_positive)
    }

    fn prior_of(&self, group: usize) -> Prior {
        *self.prior.get(group).unwrap_or(&self.prior[0])
    }
}

/// The ring and all else that is known beforehand; read only. Two models can be compared on the same frames.
#[derive(Debug)]
pub struct Model<'a, G, const B: usize, const C: usize, const F: usize> {
    /// The ring.
    pub surrogate: &'a G,
    /// All else.
    pub setup: &'a Setup<B, C, F>,
}

/// The posterior that frames have made of a model: `B` monitors, `C` correctors, `F` supplies, `N` params, `S` settings; `K`
/// channels are the monitors, once for each time in the cycle that frames may be read at, and two of the tune meter, `T` entries make a triangle of `N`, `U` one of `K`, `W` words have a bit
/// for each monitor or param.
#[derive(Debug, Clone)]
pub struct Estimator<
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
> {
    started: bool,
    sequence: Sequence,
    times: Times,
    /// No frame has come since the last look at whether to linearise anew.
    looked: bool,
    /// Slices of work between frames since the last estimate.
    slices: u32,
    tangent: Tangent<G::Linearised, F>,
    /// [`Tangent::chromatic`] of the design.
    design_chromatic: [f32; 2],
    anew: Anew<G::Linearised, G::Progress, B, C, F, N, S, K, T, W>,
    predicted: Predicted<B, F, N>,
    monitors: [Monitor; B],
    /// How their baselines follow the supplies.
    following: [Following<F>; B],
    peers: Peers,
    tunes: [TuneMeter<F>; 2],
    past: Past<B, C, F, N, S, K, T, W>,
    posterior: Posterior<K, N, T, U, W>,
    whole: WholeFrames<B>,
    /// Sum of NIS, and the number of readings in it, [`REMEMBERED`] of them.
    nis: (f64, f64),
}

/// The surrogate at the origin of the Gaussian.
#[derive(Debug, Clone)]
struct Tangent<L, const F: usize> {
    linearised: L,
    /// `ln` of the supplies' mean factors at which it was linearised.
    supplies: [f32; F],
    /// Rms change of a misaligned ring's orbit per `ln` of each supply's factor and per rms orbit, in x and y [1]: that of kicks by
    /// all correctors, which is as well what the integer resonance next to the tune makes of it (`tests/ripple.rs`).
    ripple: [[f32; F]; 2],
    /// The same of all gradients.
    chromatic: [f32; 2],
    /// Linearised since the last estimate.
    is_new: bool,
}

state!([L: State, const F: usize] Tangent<L, F> { linearised, supplies, ripple, chromatic, is_new });

impl<L, const F: usize> Tangent<L, F> {
    /// Measured minus predicted tune at `ln` of the supplies' factors.
    fn tune_innovation<G: Surrogate<B, C, F, N, Linearised = L>, const B: usize, const C: usize, const N: usize>(
        &self,
        model: &Model<'_, G, B, C, F>,
        plane: usize,
        tune: f32,
        strength: &[f32; F],
    ) -> f32 {
        let (predicted, _) = model.surrogate.tune(&self.linearised, plane, &less(strength, &self.supplies));
        wrapped(tune - predicted)
    }

    /// Memory for one.
    const fn blank(unlinearised: L) -> Self {
        Self { linearised: unlinearised, supplies: [0.0; F], ripple: [[0.0; F]; 2], chromatic: [0.0; 2], is_new: false }
    }

    /// Work out how orbits of a plane follow the gradients there.
    fn follow<const B: usize, const C: usize, const N: usize>(
        &mut self,
        surrogate: &impl Surrogate<B, C, F, N, Linearised = L>,
        plane: usize,
    ) {
        if let (Some(ripple), Some(chromatic)) = (self.ripple.get_mut(plane), self.chromatic.get_mut(plane)) {
            (*ripple, *chromatic) = surrogate.follow(&self.linearised, plane);
        }
    }
}

/// What the surrogate makes of the frame at hand.
#[derive(Debug, Clone)]
struct Predicted<const B: usize, const F: usize, const N: usize> {
    prediction: Prediction<B, F, N>,
    /// Readings that the mean drive of the frame's setting would have made [m].
    at_mean_drive: [f32; B],
    /// `ln` of the supplies' factors, off where the surrogate was linearised.
    strength: [f32; F],
    /// The same, off the mean of the frame's setting.
    off_mean: [f32; F],
    rf_offset: f32,
    /// First channel of the baselines at the frame's time in the cycle.
    first_channel: usize,
}

state!([const B: usize, const F: usize, const N: usize] Predicted<B, F, N> {
    prediction,
    at_mean_drive,
    strength,
    off_mean,
    rf_offset,
    first_channel,
});

/// All frames so far, in the form in which they can be linearised anew.
#[derive(Debug, Clone)]
struct Past<
    const B: usize,
    const C: usize,
    const F: usize,
    const N: usize,
    const S: usize,
    const K: usize,
    const T: usize,
    const W: usize,
> {
    campaign: Campaign<B, C, F, S>,
    reference: Reference<C>,
    read_back: ReadBack,
    /// The last frames that belong to no setting.
    recent: Deque<Loose<B, C, F, W>, RECENT>,
    /// The prior, and older ones: they cannot be linearised anew.
    loose: Gaussian<K, N, T, Independent<K, f32>>,
    /// All of it has to be weighted anew.
    stale: bool,
}

state!([const B: usize, const C: usize, const F: usize, const N: usize, const S: usize, const K: usize, const T: usize, const W: usize] Past<B, C, F, N, S, K, T, W> {
    campaign,
    reference,
    read_back,
    recent,
    loose,
    stale,
});

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
struct Loose<const B: usize, const C: usize, const F: usize, const W: usize> {
    drive: Drive<C, F>,
    reading: [PositionCode; B],
    accepted: Mask<W>,
    /// First channel of its baselines.
    first_channel: u16,
}

state!([const B: usize, const C: usize, const F: usize, const W: usize] Loose<B, C, F, W> { drive, reading, accepted, first_channel });

impl<const B: usize, const C: usize, const F: usize, const W: usize> Blank for Loose<B, C, F, W> {
    const BLANK: Self =
        Self { drive: Drive::NONE, reading: [PositionCode::ZERO; B], accepted: Mask::NONE, first_channel: 0 };
}

/// Prior standard deviation of a monitor's baseline [m]: offsets reach 10 mm.
const BASELINE: f32 = 0.02;

/// Frames without a setting that are linearised anew with the rest; older ones keep the linearisation that they had when
/// they left this window. At the start of a stream it holds 15 times 33 readings, enough for 48 params.
const RECENT: usize = 15;

impl<const B: usize, const C: usize, const F: usize, const W: usize> Loose<B, C, F, W> {
    /// Its readings that are used, each of a variance, as a prediction linearises them.
    fn readings<'h, const N: usize>(
        &'h self,
        variances: &'h [f32; B],
        prediction: &'h Prediction<B, F, N>,
    ) -> impl Iterator<Item = Reading<'h>> {
        let each = self.reading.iter().zip(&prediction.reading).zip(variances).enumerate();
        each.filter(|(b, _)| self.accepted.has(*b)).map(|(b, ((reading, predicted), &variance))| Reading {
            channel: usize::from(self.first_channel) + b,
            innovation: reading.value() - predicted,
            variance,
            slope: column(prediction.jacobian.as_slice(), N, b),
        })
    }
}

/// Readings whose NIS counts: an exponential mean once there are more, so that the mismatch of a machine that has run for months is that
/// of now, and ends when it has ended. Three standard deviations of so many are 1.7 %; 7 minutes of the Booster at 5 Hz.
const REMEMBERED: f64 = 65_536.0;

/// Share of a prediction's own variance that is added to the noise of a reading which cannot be linearised anew: while
/// params are uncertain, so is the linearisation.
///
/// Source: W. M. Lear's underweighting; R. Zanetti, K. DeMars and R. Bishop, J. Guid. Control Dyn. 33 (2010) 1670.
const UNDERWEIGHT: f64 = 0.2;

/// An error bar below which a param is certain enough for that: the second order of 0.5 % of all 48 is 1 um in an orbit of 5 mm.
const CERTAIN: f32 = 0.005;

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
    const FITS: () = assert!(
        K >= B + 2 && K - 2 == B * Self::TIMES && K <= u16::MAX as usize,
        "a channel for each monitor and time, and for each tune"
    );

    /// Memory for one, all zero, so that it costs no flash; [`Estimator::restart`] gives it a posterior.
    pub const BLANK: Self = Self {
        started: false,
        sequence: Sequence::EMPTY,
        times: Times::NONE,
        looked: false,
        slices: 0,
        tangent: Tangent::blank(G::UNLINEARISED),
        design_chromatic: [0.0; 2],
        anew: Anew::blank(G::UNLINEARISED),
        predicted: Predicted {
            prediction: Prediction::BLANK,
            at_mean_drive: [0.0; B],
            strength: [0.0; F],
            off_mean: [0.0; F],
            rf_offset: 0.0,
            first_channel: 0,
        },
        monitors: [const { Monitor::BLANK }; B],
        following: [Following::NONE; B],
        peers: Peers::EXPECTED,
        tunes: [const { TuneMeter::BLANK }; 2],
        past: Past {
            campaign: Campaign::BLANK,
            reference: Reference::ZERO,
            read_back: ReadBack::FOLLOWED,
            recent: Deque::new(),
            loose: Gaussian::BLANK,
            stale: false,
        },
        posterior: Posterior::BLANK,
        whole: WholeFrames::NONE,
        nis: (0.0, 0.0),
    };

    /// Start from the prior, linearised at vars = 1, all frames forgotten.
    ///
    /// # Errors
    /// [`Unstable`] if the surrogate has no design.
    pub fn restart(&mut self, model: &Model<'_, G, B, C, F>) -> Result<(), Unstable> {
        let () = Self::FITS;
        self.started = false;
        self.linearise_design(model)?;
        (self.tangent.is_new, self.predicted.rf_offset) = (false, 0.0);
        (self.sequence, self.whole, self.looked, self.slices) = (Sequence::EMPTY, WholeFrames::NONE, true, 0);
        (self.times, self.predicted.first_channel) = (Times::NONE, 0);
        (self.nis, self.past.stale) = ((0.0, 0.0), false);
        self.posterior.clear();
        for (b, monitor) in self.monitors.iter_mut().enumerate() {
            monitor.expect(model.setup.noise.of(b));
        }
        self.following = [Following::NONE; B];
        self.peers = Peers::EXPECTED;
        self.tunes.iter_mut().for_each(TuneMeter::clear);
        self.past.campaign.clear();
        (self.past.reference, self.past.read_back) = (Reference::ZERO, ReadBack::FOLLOWED);
        self.past.recent.clear();
        let calibration = model.setup.tune_calibration.unwrap_or(1.0);
        self.past.loose.reset(
            |i| prior_of::<G, B, C, F, N>(model, i),
            |channel| if channel < K - 2 { BASELINE } else { calibration },
        );
        self.posterior.gaussian.copy(&self.past.loose);
        self.posterior.gaussian.recentre(&[0.0; N]);
        self.solve(model);
        self.started = true;
        Ok(())
    }

    /// Take one machine cycle in: bytes to estimate.
    ///
    /// # Errors
    /// [`IngestError`]; the posterior is then as it was before.
    #[inline(never)]
    pub fn ingest(
        &mut self,
        model: &Model<'_, G, B, C, F>,
        bytes: &mut [u8],
    ) -> Result<Estimate<B, N, W>, IngestError> {
        // at its place from the start: a copy is more than a kilobyte of stack
        let mut judged = self.judge(model, bytes);
        let judged = judged.as_mut().map_err(|error| *error)?;
        self.learn(model, judged);
        Ok(self.estimate(model, judged))
    }

    /// The first step of [`Estimator::ingest`]: which readings count, by all that is known before the frame. A feedback acts on that;
    /// [`Estimator::learn`] must follow.
    ///
    /// # Errors
    /// [`IngestError`]; the posterior is then as it was before.
    pub fn judge(
        &mut self,
        model: &Model<'_, G, B, C, F>,
        bytes: &mut [u8],
    ) -> Result<Judged<B, C, F, W>, IngestError> {
        let (frame, drive) = self.decode(model, bytes)?;
        Ok(self.judge_frame(model, frame, drive))
    }

    /// Judge a decoded frame, and what drove the beam in it.
    #[inline(never)]
    fn judge_frame(
        &mut self,
        model: &Model<'_, G, B, C, F>,
        frame: Frame<B, C, F, W>,
        drive: Drive<C, F>,
    ) -> Judged<B, C, F, W> {
        self.pass_time(model, &frame);
        self.note_time(model, &frame);
        self.predict(model, &drive);
        let setting = self.setting(model, &frame, &drive);
        if setting.is_none() {
            self.past.reference.wait();
        }
        let repeats = setting.is_some_and(|setting| self.repeats_decide(model, &setting));
        let (whole, expected) = self.judge_whole(model, &frame, repeats);
        if whole == Whole::Aside {
            let none = Screened::none_of(&frame.valid);
            return self.judged(frame, drive, (whole, expected), (None, none));
        }
        let cell = setting.and_then(|setting| self.find_cell(model, &setting, &drive));
        if let Some(cell) = cell
            && self.learn_read_back(model, &frame, &drive, cell)
        {
            self.predict(model, &drive);
            self.predict_mean(model, cell);
        }
        let screened = self.screen(model, &frame, &drive, cell, whole, &expected);
        self.judged(frame, drive, (whole, expected), (cell, screened))
    }

    /// The second step of [`Estimator::ingest`]: what a frame that was judged says of the params.
    #[inline(never)]
    pub fn learn(&mut self, model: &Model<'_, G, B, C, F>, judged: &mut Judged<B, C, F, W>) {
        if judged.remarks.put_aside {
            // its drive tells where correctors stand, as long as there is room and no setting tells it
            if !self.past.recent.is_full() && self.past.campaign.cells().is_empty() {
                self.keep_loose(model, &judged.frame, &judged.drive, &judged.screened);
            }
            return;
        }
        let Judged { frame, drive, cell, screened, nis, .. } = judged;
        if let Some(cell) = *cell {
            self.note_late(model, frame, drive, cell, screened);
        }
        let before = self.posterior.solution.cost;
        self.posterior.expect();
        let unknown = self.baselines_variance();
        self.condition(model, frame, *cell, screened);
        self.note_kicks(drive, unknown);
        self.solve(model);
        *nis = self.count_nis(before, screened);
        self.look_for_steps(model);
        if cell.is_none() {
            self.keep_loose(model, frame, drive, screened);
        }
    }

    /// One slice of what can be done between frames, so that the next one is answered at once: let the params walk, and linearise
    /// anew, if that is due. To be called until there is [`Prepared::Nothing`] to do, or a frame has come:
    /// that is answered with the old linearisation, and counts in the new one.
    #[inline(never)]
    pub fn prepare(&mut self, model: &Model<'_, G, B, C, F>) -> Prepared {
        if !self.started {
            return Prepared::Nothing;
        }
        let prior = |i| prior_of::<G, B, C, F, N>(model, i);
        let walked = self.posterior.walk(&model.setup.walk, &model.surrogate.layout(), prior);
        // what changes the past counts as a slice, or the number of slices would not tell whether it was done; frames that leave no time to
        // linearise anew would else never belong to a setting
        if !walked && self.seek_reference(model) {
            self.slices = self.slices.saturating_add(1);
            return Prepared::Slice;
        }
        if !walked && !self.anew.under_way {
            if core::mem::replace(&mut self.looked, true) {
                return Prepared::Nothing;
            }
            if self.retire(model) {
                self.looked = false;
                self.slices = self.slices.saturating_add(1);
                return Prepared::Slice;
            }
            if !self.is_due(model) {
                return Prepared::Nothing;
            }
            self.begin();
        }
        self.slices = self.slices.saturating_add(1);
        if walked { Prepared::Slice } else { self.slice(model) }
    }

    /// Take the next frame as new, whatever its number: its sender counts anew without a new epoch.
    pub fn forget_sequence(&mut self) {
        self.sequence.forget();
    }

    /// Go over to another model of the same machine, all slices at once. All settings so far are weighed anew by it, as if their frames had
    /// just come, and then walk for the time that has passed. Where this cannot be trusted, since a param has stepped meanwhile or since
    /// the settings and this model disagree, params are as unknown as at the start, about where they were.
    ///
    /// # Errors
    /// [`Unstable`] if it has no ring at the vars at hand; the former model is then to be adopted again.
    pub fn adopt(&mut self, model: &Model<'_, G, B, C, F>) -> Result<(), Unstable> {
        self.past.stale = true;
        if !self.started {
            return Ok(());
        }
        self.linearise_design(model)?;
        let (layout, prior) = (model.surrogate.layout(), |i| prior_of::<G, B, C, F, N>(model, i));
        let walked = !self.posterior.is_still(&model.setup.walk);
        let passed = self.posterior.pause();
        let adopted = self.linearise_anew(model);
        let doubtful = self.posterior.has_stepped() || self.fit_quality(model).is_mismatch();
        self.posterior.pass(&model.setup.walk, passed, &layout, prior);
        adopted?;
        if walked && doubtful {
            self.posterior.doubt(BASELINE, &layout, prior);
        }
        self.nis = (0.0, 0.0);
        Ok(())
    }

    /// Linearise at vars = 1, all steps at once, and keep how orbits follow the gradients there.
    fn linearise_design(&mut self, model: &Model<'_, G, B, C, F>) -> Result<(), Unstable> {
        (self.anew.work, self.anew.under_way) = (Work::Surrogate(G::BEGIN), false);
        while let Work::Surrogate(progress) = &mut self.anew.work {
            if model.surrogate.advance(&[0.0; N], &[0.0; F], progress, &mut self.tangent.linearised)? {
                break;
            }
        }
        self.tangent.supplies = [0.0; F];
        (0..2).for_each(|plane| self.tangent.follow(model.surrogate, plane));
        self.design_chromatic = self.tangent.chromatic;
        Ok(())
    }

    /// A frame that is sound, new, and of a machine state that the model describes; and what drove the beam in it. One that is not
    /// is counted.
    #[inline(never)]
    fn decode(
        &mut self,
        model: &Model<'_, G, B, C, F>,
        bytes: &mut [u8],
    ) -> Result<(Frame<B, C, F, W>, Drive<C, F>), IngestError> {
        self.admit(model, bytes).inspect_err(|_| self.sequence.rejected = self.sequence.rejected.saturating_add(1))
    }

    fn admit(
        &self,
        model: &Model<'_, G, B, C, F>,
        bytes: &mut [u8],
    ) -> Result<(Frame<B, C, F, W>, Drive<C, F>), IngestError> {
        if !self.started {
            return Err(IngestError::NotStarted);
        }
        let frame = Frame::decode(&model.surrogate.layout(), bytes)?;
        self.sequence.check(&frame)?;
        let drive = model.setup.calibration.drive(&frame).map_err(IngestError::Beyond)?;
        self.check_time(model, &frame)?;
        Ok((frame, drive))
    }

    /// Count the time since the frame before.
    fn pass_time(&mut self, model: &Model<'_, G, B, C, F>, frame: &Frame<B, C, F, W>) {
        let seconds = self.sequence.advance(frame);
        let prior = |i| prior_of::<G, B, C, F, N>(model, i);
        self.posterior.pass(&model.setup.walk, seconds, &model.surrogate.layout(), prior);
        self.looked = false;
    }

    /// The cell of a setting, the frame's drive counted in, and what its mean drive would have made.
    #[inline(never)]
    fn find_cell(&mut self, model: &Model<'_, G, B, C, F>, setting: &Setting, drive: &Drive<C, F>) -> Option<u16> {
        let index = self.past.campaign.find(setting)?;
        self.past.campaign.cell_mut(index)?.add_drive(drive);
        self.predict_mean(model, index);
        Some(index)
    }

    /// What the mean drive of a cell would have made of the frame.
    fn predict_mean(&mut self, model: &Model<'_, G, B, C, F>, cell: u16) {
        let Some(cell) = self.past.campaign.cells().get(usize::from(cell)) else { return };
        let mean = about(&self.believed(&cell.drive()), &self.tangent.supplies);
        model.surrogate.orbit(&self.tangent.linearised, &mean, &mut self.predicted.at_mean_drive);
        follow(&self.following, &mean.strength, &mut self.predicted.at_mean_drive);
        self.predicted.off_mean = less(&self.predicted.strength, &mean.strength);
    }

    /// Predict the frame.
    #[inline(never)]
    fn predict(&mut self, model: &Model<'_, G, B, C, F>, drive: &Drive<C, F>) {
        self.predict_drive(model, drive);
        self.predicted.strength = less(&drive.strength, &self.tangent.supplies);
        self.predicted.rf_offset = drive.rf_offset;
    }

    #[inline(never)]
    fn predict_drive(&mut self, model: &Model<'_, G, B, C, F>, drive: &Drive<C, F>) {
        let drive = about(&self.believed(drive), &self.tangent.supplies);
        model.surrogate.predict(&self.tangent.linearised, &drive, &mut self.predicted.prediction);
        follow(&self.following, &drive.strength, &mut self.predicted.prediction.reading);
    }

    /// Measured minus predicted at the origin, before the baseline [m].
    fn innovation(&self, b: usize, reading: PositionCode) -> f32 {
        reading.value() - self.predicted.prediction.reading.get(b).copied().unwrap_or(0.0)
    }

    fn slope(&self, b: usize) -> &[f32] {
        column(self.predicted.prediction.jacobian.as_slice(), N, b)
    }

    /// Variance of the mean of `n` repeats: the monitor's noise, and the stated error of the surrogate, which is the same
    /// in all of them [m^2].
    fn variance(
        &self,
        model: &Model<'_, G, B, C, F>,
        at: &Tangent<G::Linearised, F>,
        b: usize,
        n: u32,
        rf_offset: f32,
    ) -> f32 {
        self.noise_variance(b) / n.max(1) as f32 + self.shared_variance(model, at, b, rf_offset)
    }

    /// Variance of a reading at a drive, seen from the supplies' mean [m^2].
    fn variance_at(
        &self,
        model: &Model<'_, G, B, C, F>,
        at: &Tangent<G::Linearised, F>,
        b: usize,
        drive: &Drive<C, F>,
    ) -> f32 {
        self.own_variance(model, b, &drive.strength) + self.shared_variance(model, at, b, drive.rf_offset)
    }

    /// Variance of a reading that no other shares: the monitor's noise, and what is not known of how its baseline follows the
    /// supplies to `ln` of these factors [m^2].
    fn own_variance(&self, model: &Model<'_, G, B, C, F>, b: usize, strength: &[f32; F]) -> f32 {
        let following = self.following.get(b).unwrap_or(&Following::NONE);
        self.noise_variance(b) + following.variance(strength, &self.follows(model, b))
    }

    /// Variance that repeats of a reading share: the stated error of the surrogate [m^2].
    #[inline(never)]
    fn shared_variance(
        &self,
        model: &Model<'_, G, B, C, F>,
        at: &Tangent<G::Linearised, F>,
        b: usize,
        rf_offset: f32,
    ) -> f32 {
        let plane = usize::from(b >= model.surrogate.layout().first_vertical());
        let of_plane = |pair: &[f32; 2]| pair.get(plane).copied().unwrap_or(0.0);
        let (now, design) = (of_plane(&at.chromatic), of_plane(&self.design_chromatic));
        let growth = if design > 0.0 { now / design } else { 1.0 };
        model.surrogate.error_variance(b, rf_offset, growth * self.times.root() * of_plane(&self.posterior.orbit))
    }

    /// What a reading adds to its earlier repeats, as one of its own: innovation [m] and variance [m^2].
    ///
    /// The `n`-th repeat `z` of mean `m` (itself included), with noise `v` of its own and an error of variance `e` that all
    /// share, moves the mean as would an independent reading `z + n e/v (z - m)` of variance
    /// `(v + (n - 1) e)(v + n e)/v`: both means then have variance `v/n + e`.
    fn news_of(&self, model: &Model<'_, G, B, C, F>, b: usize, innovation: f32, cell: Option<u16>) -> (f32, f32) {
        let own = self.own_variance(model, b, &self.predicted.strength);
        let shared = self.shared_variance(model, &self.tangent, b, self.predicted.rf_offset);
        let cell = cell.and_then(|index| self.past.campaign.cells().get(usize::from(index)));
        let (n, distance) = cell.map_or((1, 0.0), |cell| (cell.mean(b).1.max(1), cell.distance(b)));
        let ratio = shared / own;
        let n = n as f32;
        (innovation + n * ratio * distance, own * (1.0 + (n - 1.0) * ratio) * (1.0 + n * ratio))
    }

    /// What the unknown misalignments let be expected of how a monitor's baseline follows the supplies.
    fn follows(&self, model: &Model<'_, G, B, C, F>, b: usize) -> following::Expected<F> {
        let ([ripple_x, ripple_y], [orbit_x, orbit_y]) = (&self.tangent.ripple, self.posterior.orbit);
        let is_horizontal = b < model.surrogate.layout().first_vertical();
        let (ripple, orbit) = if is_horizontal { (ripple_x, orbit_x) } else { (ripple_y, orbit_y) };
        following::Expected { sigma: ripple.map(|ratio| ratio * orbit), variance: self.noise_variance(b) }
    }

    fn noise_variance(&self, b: usize) -> f32 {
        self.monitors.get(b).map_or(f32::MAX, Monitor::variance)
    }

    /// Add the readings that passed.
    #[inline(never)]
    fn condition(
        &mut self,
        model: &Model<'_, G, B, C, F>,
        frame: &Frame<B, C, F, W>,
        cell: Option<u16>,
        screened: &Screened<W>,
    ) {
        let still = self.posterior.is_still(&model.setup.walk);
        let linearised_once = cell.is_none() || !still;
        // a mean over frames that have not seen the same ring says nothing
        let cell = cell.filter(|_| still);
        let mut news = [(0.0, 0.0); B];
        for (b, (news, reading)) in news.iter_mut().zip(&frame.reading).enumerate() {
            *news = self.news_of(model, b, self.innovation(b, *reading), cell);
        }
        let used = news.iter().enumerate().filter(|(b, _)| screened.accepted.has(*b));
        let readings = used.map(|(b, &(innovation, variance))| Reading {
            channel: self.predicted.first_channel + b,
            innovation,
            variance,
            slope: column(self.predicted.prediction.jacobian.as_slice(), N, b),
        });
        let Posterior { gaussian, solution, .. } = &mut self.posterior;
        gaussian.condition(readings, &underweighted(solution, linearised_once));
        self.condition_tunes(model, screened);
        // readings confirmed late or outvoted are counted when the past is weighted anew
        self.past.stale |= !screened.confirmed.is_empty() || !screened.restarted.is_empty();
    }

    /// Joint NIS of a frame: the growth of the smallest chi-square from what it was before.
    fn count_nis(&mut self, before: f64, screened: &Screened<W>) -> f32 {
        let nis = self.posterior.solution.cost - before;
        let (sum, readings) = (self.nis.0 + nis, self.nis.1 + f64::from(screened.count()));
        let kept = readings.min(REMEMBERED);
        self.nis = (finite(sum * kept / readings.max(1.0)), kept);
        finite(nis) as f32
    }

    /// Look for steps of single vars in what the frame has said, if vars may step.
    fn look_for_steps(&mut self, model: &Model<'_, G, B, C, F>) {
        self.posterior.narrow();
        if model.setup.walk.params > 0.0 {
            self.posterior.let_loose(&model.surrogate.layout(), |i| prior_of::<G, B, C, F, N>(model, i));
        }
    }

    /// Keep a frame that belongs to no setting among the recent ones; the oldest of them is linearised for the last time.
    #[inline(never)]
    fn keep_loose(
        &mut self,
        model: &Model<'_, G, B, C, F>,
        frame: &Frame<B, C, F, W>,
        drive: &Drive<C, F>,
        screened: &Screened<W>,
    ) {
        if self.past.recent.is_full()
            && !self.drop_silent()
            && let Some(oldest) = self.past.recent.pop_front()
        {
            self.note_leaving(model, &oldest);
            // a past that has seen another ring is not counted anew
            if self.posterior.is_still(&model.setup.walk) {
                self.let_go(model, &oldest);
            }
        }
        let first_channel = self.predicted.first_channel as u16;
        let kept = Loose { drive: *drive, reading: frame.reading, accepted: screened.accepted, first_channel };
        // there is room: one has just left
        let _ = self.past.recent.push_back(kept);
    }

    /// Drop the oldest recent frame of which no reading counts, so that none which counts leaves in its place; false if there is none.
    fn drop_silent(&mut self) -> bool {
        let recent = &mut self.past.recent;
        let Some(silent) = recent.iter().position(|frame| frame.accepted.count() == 0) else { return false };
        for at in 0..recent.len() {
            let frame = recent.pop_front().filter(|_| at != silent);
            // as many as there were, in their order
            let _ = frame.map(|frame| recent.push_back(frame));
        }
        self.note_dropped(silent);
        true
    }

    /// Linearise a frame for the last time.
    #[inline(never)]
    fn let_go(&mut self, model: &Model<'_, G, B, C, F>, frame: &Loose<B, C, F, W>) {
        self.past.loose.recentre(self.posterior.gaussian.origin());
        self.predict_drive(model, &frame.drive);
        let drive = about(&frame.drive, &self.tangent.supplies);
        let variances: [f32; B] = core::array::from_fn(|b| self.variance_at(model, &self.tangent, b, &drive));
        let readings = frame.readings(&variances, &self.predicted.prediction);
        self.past.loose.condition(readings, &underweighted(&self.posterior.solution, true));
    }

    fn solve(&mut self, model: &Model<'_, G, B, C, F>) {
        self.posterior.solve(&model.surrogate.layout(), |i| prior_of::<G, B, C, F, N>(model, i));
    }

    /// The estimate after a frame that was learnt; its remarks are said with it.
    #[inline(never)]
    pub fn estimate(&mut self, model: &Model<'_, G, B, C, F>, judged: &Judged<B, C, F, W>) -> Estimate<B, N, W> {
        let remarks = self.remark(judged);
        let Judged { frame, screened, .. } = judged;
        let solution = &self.posterior.solution;
        let mut estimate = Estimate {
            sequence: frame.sequence,
            time_us: frame.time_us,
            frames: self.sequence.frames,
            rejected_frames: self.sequence.rejected,
            mean: [0.0; N],
            sigma: [0.0; N],
            map_params: solution.map_params,
            centre: core::array::from_fn(|i| self.centre(i)),
            params_sigma: solution.sigma,
            clipped: solution.clipped,
            nis: judged.nis,
            accepted: screened.accepted,
            rejected: screened.rejected,
            confirmed: screened.confirmed,
            restarted: screened.restarted,
            tune_innovation: screened.tune,
            setting: judged.cell,
            // without a number it is none
            log_evidence: -finite(-solution.log_evidence) as f32,
            linearised: judged.linearised,
            remarks,
            health: judged.health,
        };
        for i in 0..N {
            let moments = estimate.marginal(i, &prior_of::<G, B, C, F, N>(model, i)).map(|m| m.moments());
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
        let clipped = self.posterior.solution.clipped.has(i);
        let origin = self.posterior.gaussian.origin().get(i).copied().unwrap_or(0.0);
        let delta = self.posterior.solution.delta.get(i).copied().unwrap_or(0.0);
        let unbounded = finite(f64::from(origin) + delta) as f32;
        if clipped { unbounded } else { self.posterior.solution.map_params.get(i).copied().unwrap_or(unbounded) }
    }

    /// Evidence that a param has stepped lately [nat].
    pub fn step_evidence(&self, model: &Model<'_, G, B, C, F>) -> f32 {
        self.posterior.step_evidence(|i| prior_of::<G, B, C, F, N>(model, i))
    }

    /// Write all that frames have made of the posterior, between two frames and with nothing left to [`Estimator::prepare`];
    /// returns how many bytes it takes.
    ///
    /// # Errors
    /// [`StateError::Truncated`] without room for it, [`StateError::UnderWay`].
    pub fn save(&mut self, to: &mut [u8]) -> Result<usize, StateError> {
        if self.anew.under_way { Err(StateError::UnderWay) } else { state::save(self, to) }
    }

    /// Go on where another one with the same model was saved, to the bit.
    ///
    /// # Errors
    /// [`StateError`]; it is then to be restarted.
    pub fn load(&mut self, from: &[u8]) -> Result<(), StateError> {
        self.anew.under_way = false;
        let loaded = state::load(self, from);
        self.started &= loaded.is_ok();
        loaded
    }

    /// CRC-32 of the names and lengths of what is saved: a program that saves other things has another one.
    pub fn state_layout(&mut self) -> u32 {
        state::layout(self)
    }

    /// Frames taken in so far, those that were put aside included.
    pub fn frames(&self) -> u32 {
        self.sequence.frames
    }

    /// Covariance of two params `theta = ln var`.
    pub fn covariance(&self, i: usize, j: usize) -> f32 {
        if i < N && j < N { self.posterior.solution.covariance(i, j) as f32 } else { 0.0 }
    }

    /// What the covariance of the params is made of, to be worked out elsewhere, see [`Solution::inverse_factor`].
    pub fn inverse_factor(&self) -> &[f64] {
        self.posterior.solution.inverse_factor()
    }

    /// What the posterior after a frame expects of its reading at a monitor [m], baseline included; before the next
    /// [`Estimator::prepare`].
    pub fn fitted(&self, b: usize) -> f32 {
        let channel = self.predicted.first_channel + b;
        let Posterior { gaussian, solution, .. } = &self.posterior;
        let (off_origin, _) = gaussian.expected(channel, self.slope(b), &solution.delta);
        self.predicted.prediction.reading.get(b).copied().unwrap_or(0.0) + off_origin as f32
    }
}

/// A number as estimates have it: what absurd numbers of a state make infinite or NaN is as large as can be told.
fn finite(number: f64) -> f64 {
    let [least, most] = [f32::MIN, f32::MAX].map(f64::from);
    if number.is_nan() { most } else { number.clamp(least, most) }
}

/// All but the work between frames, which is finished or begun anew.
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
> State for Estimator<G, B, C, F, N, S, K, T, U, W>
{
    fn pass(&mut self, bytes: &mut impl Bytes) -> Result<(), StateError> {
        let Self {
            started,
            sequence,
            times,
            looked,
            slices,
            tangent,
            design_chromatic,
            anew: _,
            predicted,
            monitors,
            following,
            peers,
            tunes,
            past,
            posterior,
            whole,
            nis,
        } = self;
        State::pass(started, bytes)?;
        State::pass(sequence, bytes)?;
        State::pass(times, bytes)?;
        State::pass(looked, bytes)?;
        State::pass(slices, bytes)?;
        State::pass(tangent, bytes)?;
        State::pass(design_chromatic, bytes)?;
        State::pass(predicted, bytes)?;
        State::pass(monitors, bytes)?;
        State::pass(following, bytes)?;
        State::pass(peers, bytes)?;
        State::pass(tunes, bytes)?;
        State::pass(past, bytes)?;
        State::pass(posterior, bytes)?;
        State::pass(whole, bytes)?;
        State::pass(nis, bytes)
    }
}

/// What the uncertain linearisation adds to the variance of a reading, for a derivative of its difference from the baseline; nothing
/// where it can be linearised anew, and once all params are certain enough.
fn underweighted<const N: usize, const T: usize, const W: usize>(
    solution: &Solution<N, T, W>,
    linearised_once: bool,
) -> impl Fn(&[f64; N]) -> f64 {
    let is_loose = linearised_once && solution.sigma.iter().any(|sigma| *sigma > CERTAIN);
    move |d| if is_loose { UNDERWEIGHT * solution.variance_of(d) } else { 0.0 }
}

/// Prior of a param.
fn prior_of<G: Surrogate<B, C, F, N>, const B: usize, const C: usize, const F: usize, const N: usize>(
    model: &Model<'_, G, B, C, F>,
    param: usize,
) -> Prior {
    model.setup.prior_of(model.surrogate.prior_group(param))
}

/// A drive seen from the supplies' mean: what is left for first order.
fn about<const C: usize, const F: usize>(drive: &Drive<C, F>, supplies: &[f32; F]) -> Drive<C, F> {
    Drive { strength: less(&drive.strength, supplies), ..*drive }
}

fn less<const F: usize>(strength: &[f32; F], supplies: &[f32; F]) -> [f32; F] {
    let mut rest = *strength;
    rest.iter_mut().zip(supplies).for_each(|(rest, supply)| *rest -= supply);
    rest
}

/// Add to readings what their baselines are off their means, at `ln` of the supplies' factors about these.
fn follow<const B: usize, const F: usize>(following: &[Following<F>; B], strength: &[f32; F], readings: &mut [f32; B]) {
    readings.iter_mut().zip(following).for_each(|(reading, following)| *reading += following.shift(strength));
}
