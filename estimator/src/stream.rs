//! The interfaces of a core, and of a feedback on it, to the loop around them, independent of their sizes.

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::estimate::Estimate;
use crate::estimator::{Estimator, FitQuality, IngestError, Model, Prepared, Setup};
use crate::judged::Judged;
use crate::sizes::Sizes;
use crate::state::StateError;
use crate::steer::{Feedback, Steer, Steered};
use crate::surrogate::{Steerable, Surrogate, Tables, Unstable};
use crate::wire::link::{Answer, Correction, Setpoints, Short};
use crate::wire::{Frame, listed};

/// A core with its types; see [`Estimator`] for what each method does.
#[allow(missing_docs)] // those of `Estimator`
pub trait Core: Sized {
    /// The model's tables.
    type Tables: Tables;
    /// Priors, noise and calibration.
    type Setup: Clone + Serialize + DeserializeOwned;
    /// A frame that was judged.
    type Judged;
    /// The estimate after a frame.
    type Estimate;
    /// The same on the wire.
    type Answer: Serialize + DeserializeOwned + for<'e> From<&'e Self::Estimate>;
    /// Setpoints of the correctors.
    type Setpoints: Serialize + DeserializeOwned;

    /// Memory for one, all zero.
    const BLANK: Self;
    /// What it has room for.
    const ROOM: Sizes;
    /// Version of its frames.
    const FRAME_VERSION: u8;

    fn is_sound(setup: &Self::Setup) -> bool;
    fn restart(&mut self, tables: &Self::Tables, setup: &Self::Setup) -> Result<(), Unstable>;
    fn ingest(
        &mut self,
        tables: &Self::Tables,
        setup: &Self::Setup,
        bytes: &mut [u8],
    ) -> Result<Self::Estimate, IngestError>;
    fn learn(&mut self, tables: &Self::Tables, setup: &Self::Setup, judged: &mut Self::Judged);
    fn estimate(&mut self, tables: &Self::Tables, setup: &Self::Setup, judged: &Self::Judged) -> Self::Estimate;
    fn prepare(&mut self, tables: &Self::Tables, setup: &Self::Setup) -> Prepared;
    fn adopt(&mut self, tables: &Self::Tables, setup: &Self::Setup) -> Result<(), Unstable>;
    fn fit_quality(&mut self, tables: &Self::Tables, setup: &Self::Setup) -> FitQuality;
    fn forget_sequence(&mut self);
    fn save(&mut self, to: &mut [u8]) -> Result<usize, StateError>;
    fn load(&mut self, from: &[u8]) -> Result<(), StateError>;
    fn state_layout(&mut self) -> u32;
    fn frames(&self) -> u32;
    fn covariance(&self, i: usize, j: usize) -> f32;
    /// Number of the frame that an estimate is of.
    fn sequence(estimate: &Self::Estimate) -> u32;
    /// What feedback needs of an estimate.
    fn short(&self, estimate: &Self::Estimate) -> Short<Self::Setpoints>;
    /// The same of a frame that was steered by, learnt or not.
    fn corrected(&mut self, judged: &Self::Judged, correction: Correction<Self::Setpoints>) -> Short<Self::Setpoints>;
    /// Number of the frame that was judged.
    fn number(judged: &Self::Judged) -> u32;
    fn needs_attention(&self) -> bool;
    /// See [`Estimator::is_within`].
    fn is_within(&self, tables: &Self::Tables) -> bool;
}

/// A feedback on a core; see [`Steer`] for what each method does.
#[allow(missing_docs)] // those of `Steer` and of `Estimator`
pub trait Steering<E: Core>: Sized {
    /// What is wanted of the orbit, and what the correctors may do.
    type Feedback: Clone + Serialize + DeserializeOwned;

    /// Memory for one, all zero: it begins with the first frame.
    const BLANK: Self;

    fn is_sound(feedback: &Self::Feedback) -> bool;
    /// Bytes to setpoints; the frame is to be learnt then. See [`Estimator::judge_and_steer`].
    fn judge(
        &mut self,
        core: &mut E,
        model: (&E::Tables, &E::Setup),
        feedback: &Self::Feedback,
        bytes: &mut [u8],
    ) -> Result<E::Judged, IngestError>;
    /// See [`Estimator::prepare_steer`].
    fn prepare(&mut self, core: &E, model: (&E::Tables, &E::Setup), feedback: &Self::Feedback) -> bool;
    fn steered(&self) -> Steered;
    fn setpoints(&self) -> E::Setpoints;
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
> Core for Estimator<G, B, C, F, N, S, K, T, U, W>
{
    type Tables = G;
    type Setup = Setup<B, C, F>;
    type Judged = Judged<B, C, F, W>;
    type Estimate = Estimate<B, N, W>;
    type Answer = Answer<B, N, W>;
    type Setpoints = Setpoints<C>;

    const BLANK: Self = Self::BLANK;
    const ROOM: Sizes = Sizes { supplies: F as u16, ..G::ROOM };
    const FRAME_VERSION: u8 = Frame::<B, C, F, W>::VERSION;

    fn is_sound(setup: &Self::Setup) -> bool {
        setup.is_sound()
    }

    fn restart(&mut self, surrogate: &G, setup: &Self::Setup) -> Result<(), Unstable> {
        self.restart(&Model { surrogate, setup })
    }

    fn ingest(&mut self, surrogate: &G, setup: &Self::Setup, bytes: &mut [u8]) -> Result<Self::Estimate, IngestError> {
        self.ingest(&Model { surrogate, setup }, bytes)
    }

    fn learn(&mut self, surrogate: &G, setup: &Self::Setup, judged: &mut Self::Judged) {
        self.learn(&Model { surrogate, setup }, judged);
    }

    fn estimate(&mut self, surrogate: &G, setup: &Self::Setup, judged: &Self::Judged) -> Self::Estimate {
        self.estimate(&Model { surrogate, setup }, judged)
    }

    fn prepare(&mut self, surrogate: &G, setup: &Self::Setup) -> Prepared {
        self.prepare(&Model { surrogate, setup })
    }

    fn adopt(&mut self, surrogate: &G, setup: &Self::Setup) -> Result<(), Unstable> {
        self.adopt(&Model { surrogate, setup })
    }

    fn fit_quality(&mut self, surrogate: &G, setup: &Self::Setup) -> FitQuality {
        self.fit_quality(&Model { surrogate, setup })
    }

    fn forget_sequence(&mut self) {
        self.forget_sequence();
    }

    fn save(&mut self, to: &mut [u8]) -> Result<usize, StateError> {
        self.save(to)
    }

    fn load(&mut self, from: &[u8]) -> Result<(), StateError> {
        self.load(from)
    }

    fn state_layout(&mut self) -> u32 {
        self.state_layout()
    }

    fn frames(&self) -> u32 {
        self.frames()
    }

    fn covariance(&self, i: usize, j: usize) -> f32 {
        self.covariance(i, j)
    }

    fn sequence(estimate: &Self::Estimate) -> u32 {
        estimate.sequence
    }

    fn short(&self, e: &Self::Estimate) -> Short<Self::Setpoints> {
        let attention = self.needs_attention();
        Short { sequence: e.sequence, remarks: e.remarks, attention, nis: e.nis, correction: None }
    }

    fn corrected(&mut self, judged: &Self::Judged, correction: Correction<Self::Setpoints>) -> Short<Self::Setpoints> {
        let (remarks, attention) = (self.remark(judged), self.needs_attention());
        Short { sequence: judged.frame.sequence, remarks, attention, nis: judged.nis, correction: Some(correction) }
    }

    fn number(judged: &Self::Judged) -> u32 {
        judged.frame.sequence
    }

    fn needs_attention(&self) -> bool {
        self.needs_attention()
    }

    fn is_within(&self, surrogate: &G) -> bool {
        self.is_within(surrogate)
    }
}

impl<
    G: Steerable<B, C, F, N>,
    const B: usize,
    const C: usize,
    const F: usize,
    const N: usize,
    const S: usize,
    const K: usize,
    const T: usize,
    const U: usize,
    const W: usize,
    const CX: usize,
    const CY: usize,
    const TX: usize,
    const TY: usize,
> Steering<Estimator<G, B, C, F, N, S, K, T, U, W>> for Steer<B, C, CX, CY, TX, TY>
{
    type Feedback = Feedback<B, C>;

    const BLANK: Self = Self::BLANK;

    fn is_sound(feedback: &Self::Feedback) -> bool {
        feedback.is_sound()
    }

    fn judge(
        &mut self,
        core: &mut Estimator<G, B, C, F, N, S, K, T, U, W>,
        (surrogate, setup): (&G, &Setup<B, C, F>),
        feedback: &Self::Feedback,
        bytes: &mut [u8],
    ) -> Result<Judged<B, C, F, W>, IngestError> {
        core.judge_and_steer(&Model { surrogate, setup }, feedback, self, bytes)
    }

    fn prepare(
        &mut self,
        core: &Estimator<G, B, C, F, N, S, K, T, U, W>,
        (surrogate, setup): (&G, &Setup<B, C, F>),
        feedback: &Self::Feedback,
    ) -> bool {
        core.prepare_steer(&Model { surrogate, setup }, feedback, self)
    }

    fn steered(&self) -> Steered {
        self.steered()
    }

    fn setpoints(&self) -> Setpoints<C> {
        listed(self.setpoints().iter().copied())
    }
}
