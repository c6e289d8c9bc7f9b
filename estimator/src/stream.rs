//! The interface of a core to the loop around it, independent of its sizes.

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::estimate::Estimate;
use crate::estimator::{Estimator, FitQuality, IngestError, Model, Prepared, Setup};
use crate::surrogate::{Surrogate, Tables, Unstable};
use crate::wire::link::Answer;

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

    /// Memory for one, all zero.
    const BLANK: Self;

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
    /// True if an operator should look: a monitor is not ok, or a var is clipped.
    fn needs_attention(estimate: &Self::Estimate) -> bool;
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

    const BLANK: Self = Self::BLANK;

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

    fn needs_attention(estimate: &Self::Estimate) -> bool {
        let is_faulty = |h: &crate::estimate::Health| h.state != crate::estimate::MonitorState::Ok;
        estimate.health.iter().any(is_faulty) || !estimate.clipped.is_empty()
    }
}
