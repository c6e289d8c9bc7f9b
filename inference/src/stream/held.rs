//! A core of some size, behind an interface without sizes.

use core::fmt;

use estimator::surrogate::{Surrogate, Unstable};
use estimator::{Core, Estimator, FitQuality, IngestError, Prepared, StateError};
use training::{Tables, with_stack};

use super::{Estimate, Setup};

/// What [`super::Core`] needs of a core.
pub trait Stream: fmt::Debug + Send + Sync {
    fn ingest(&mut self, bytes: &mut [u8]) -> Result<Estimate, IngestError>;
    fn prepare(&mut self) -> Prepared;
    fn adopt(&mut self, tables: &Tables) -> Result<(), Unstable>;
    fn fit_quality(&mut self) -> FitQuality;
    fn covariance(&self, i: usize, j: usize) -> f32;
    fn covariance_row(&self, i: usize) -> Vec<f32>;
    fn save(&mut self, to: &mut Vec<u8>) -> Result<(), StateError>;
    fn load(&mut self, from: &[u8]) -> Result<(), StateError>;
    fn state_layout(&mut self) -> u32;
    fn is_within(&self) -> bool;
    fn boxed_clone(&self) -> Box<dyn Stream>;
}

impl Clone for Box<dyn Stream> {
    fn clone(&self) -> Self {
        self.boxed_clone()
    }
}

/// A core whose setup and estimates can be had without their sizes.
pub trait Room: Core + Clone + Send + Sync + 'static {
    /// For this core, which uses these tables.
    fn setup(tables: &Self::Tables, setup: &Setup) -> Self::Setup;
    /// Without spare slots.
    fn estimate(tables: &Self::Tables, estimate: &Self::Estimate) -> Estimate;
}

impl<
    G: Surrogate<B, C, F, N> + Clone + Send + Sync + 'static,
    const B: usize,
    const C: usize,
    const F: usize,
    const N: usize,
    const S: usize,
    const K: usize,
    const T: usize,
    const U: usize,
    const W: usize,
> Room for Estimator<G, B, C, F, N, S, K, T, U, W>
where
    G::Linearised: Clone + Send + Sync,
    G::Progress: Clone + Send + Sync,
{
    fn setup(tables: &G, setup: &Setup) -> Self::Setup {
        setup.in_room(&tables.layout())
    }

    fn estimate(tables: &G, estimate: &Self::Estimate) -> Estimate {
        Estimate::of(estimate, &tables.layout())
    }
}

/// A core, its tables and its setup. Boxed: the Booster's state is some 150 kB, the largest some 6 MB.
pub struct Held<E: Core> {
    tables: Box<E::Tables>,
    setup: E::Setup,
    core: Box<E>,
}

/// Size of a core from which on its work, and putting it together, may exceed the stack of a thread [B].
const LARGE: usize = 1 << 20;

/// Work on a core of this size, on a thread of its own if it is large.
fn on_its_stack<E, R: Send>(work: impl FnOnce() -> R + Send) -> R {
    if size_of::<E>() < LARGE { work() } else { with_stack(work) }
}

impl<E: Room> Held<E>
where
    E::Tables: Clone + Send + Sync + 'static,
    E::Setup: Send + Sync + 'static,
{
    /// The core at its prior.
    pub fn boxed(tables: &Tables, setup: &Setup) -> Result<Box<dyn Stream>, Unstable> {
        on_its_stack::<E, _>(|| {
            let mut own = Box::new(<E::Tables as estimator::Tables>::BLANK);
            tables.fill(&mut *own).expect("the room was chosen for them");
            let mut held = Self { setup: E::setup(&own, setup), tables: own, core: Box::new(E::BLANK) };
            held.core.restart(&held.tables, &held.setup)?;
            Ok(Box::new(held) as Box<dyn Stream>)
        })
    }
}

impl<E: Room> Stream for Held<E>
where
    E::Tables: Clone + Send + Sync + 'static,
    E::Setup: Send + Sync + 'static,
{
    fn ingest(&mut self, bytes: &mut [u8]) -> Result<Estimate, IngestError> {
        let estimate = self.core.ingest(&self.tables, &self.setup, bytes)?;
        Ok(<E as Room>::estimate(&self.tables, &estimate))
    }

    fn prepare(&mut self) -> Prepared {
        on_its_stack::<E, _>(|| self.core.prepare(&self.tables, &self.setup))
    }

    fn adopt(&mut self, tables: &Tables) -> Result<(), Unstable> {
        on_its_stack::<E, _>(|| {
            tables.fill(&mut *self.tables).expect("they are of this machine");
            self.core.adopt(&self.tables, &self.setup)
        })
    }

    fn fit_quality(&mut self) -> FitQuality {
        self.core.fit_quality(&self.tables, &self.setup)
    }

    fn covariance(&self, i: usize, j: usize) -> f32 {
        self.core.covariance(i, j)
    }

    fn covariance_row(&self, i: usize) -> Vec<f32> {
        self.core.covariance_row(i).as_ref().to_vec()
    }

    fn save(&mut self, to: &mut Vec<u8>) -> Result<(), StateError> {
        // no number takes more room there than here, and those that say how long a list is take less than what ends it here
        to.resize(size_of::<E>(), 0);
        let length = self.core.save(to)?;
        to.truncate(length);
        Ok(())
    }

    fn load(&mut self, from: &[u8]) -> Result<(), StateError> {
        let loaded = self.core.load(from);
        if loaded.is_err() {
            on_its_stack::<E, _>(|| self.core.restart(&self.tables, &self.setup)).expect("it has started before");
        }
        loaded
    }

    fn state_layout(&mut self) -> u32 {
        on_its_stack::<E, _>(|| self.core.state_layout())
    }

    fn is_within(&self) -> bool {
        self.core.is_within(&self.tables)
    }

    fn boxed_clone(&self) -> Box<dyn Stream> {
        on_its_stack::<E, _>(|| {
            Box::new(Self { tables: self.tables.clone(), setup: self.setup.clone(), core: self.core.clone() })
                as Box<dyn Stream>
        })
    }
}

impl<E: Core> fmt::Debug for Held<E> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "core of {} bytes after {} frames", size_of::<E>(), self.core.frames())
    }
}
