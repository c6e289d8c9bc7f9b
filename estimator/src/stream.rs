//! The interfaces of a core, and of a feedback on it, to the loop around them, independent of their sizes.

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::estimate::Estimate;
use crate::estimator::{Estimator, FitQuality, IngestError, Model, Prepared, Setup};
use crate::sizes::Sizes;
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
    fn prepare(&mut self, tables: &Self::Tables, setup: &Self::Setup) -> Prepared;
    fn adopt(&mut self, tables: &Self::Tables, setup: &Self::Setup) -> Result<(), Unstable>;
    fn fit_quality(&mut self, tables: &Self::Tables, setup: &Self::Setup) -> FitQuality;
    fn forget_sequence(&mut self);
    fn frames(&self) -> u32;
    fn covariance(&self, i: usize, j: usize) -> f32;
    /// Number of the frame that an estimate is of.
    fn sequence(estimate: &Self::Estimate) -> u32;
    /// What feedback needs of an estimate, with a correction if there is one.
    fn short(estimate: &Self::Estimate, correction: Option<Correction<Self::Setpoints>>) -> Short<Self::Setpoints>;
    /// True if an operator should look: a monitor is not ok, or a var is clipped.
    fn needs_attention(estimate: &Self::Estimate) -> bool;
}

/// A feedback on a core; see [`Steer`] for what each method does.
#[allow(missing_docs)] // those of `Steer` and of `Estimator`
pub trait Steering<E: Core>: Sized {
    /// What is wanted of the orbit, and what the correctors may do.
    type Feedback: Clone + Serialize + DeserializeOwned;

    /// Memory for one, all zero: it begins with the first frame.
    const BLANK: Self;

    fn is_sound(feedback: &Self::Feedback) -> bool;
    /// Bytes to estimate to setpoints. See [`Estimator::ingest_and_steer`].
    fn ingest(
        &mut self,
        core: &mut E,
        model: (&E::Tables, &E::Setup),
        feedback: &Self::Feedback,
        bytes: &mut [u8],
    ) -> Result<E::Estimate, IngestError>;
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

    fn frames(&self) -> u32 {
        self.frames()
    }

    fn covariance(&self, i: usize, j: usize) -> f32 {
        self.covariance(i, j)
    }

    fn sequence(estimate: &Self::Estimate) -> u32 {
        estimate.sequence
    }

    fn short(e: &Self::Estimate, correction: Option<Correction<Self::Setpoints>>) -> Short<Self::Setpoints> {
        let attention = Self::needs_attention(e);
        Short { sequence: e.sequence, remarks: e.remarks, attention, nis: e.nis, correction }
    }

    fn needs_attention(estimate: &Self::Estimate) -> bool {
        let is_faulty = |h: &crate::estimate::Health| h.state != crate::estimate::MonitorState::Ok;
        estimate.health.iter().any(is_faulty) || !estimate.clipped.is_empty()
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

    fn ingest(
        &mut self,
        core: &mut Estimator<G, B, C, F, N, S, K, T, U, W>,
        (surrogate, setup): (&G, &Setup<B, C, F>),
        feedback: &Self::Feedback,
        bytes: &mut [u8],
    ) -> Result<Estimate<B, N, W>, IngestError> {
        core.ingest_and_steer(&Model { surrogate, setup }, feedback, self, bytes)
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
