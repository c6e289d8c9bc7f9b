//! A core of some size, behind an interface without sizes.

use core::fmt;

use estimator::surrogate::{Surrogate, Unstable};
use estimator::{Core, Estimator, FitQuality, IngestError, Prepared, StateError};
use training::{Tables, with_stack};

use super::steering::{Correction, Feedback, Loop, Steers};
use super::{Estimate, Setup};

/// What [`super::Core`] needs of a core.
pub trait Stream: fmt::Debug + Send + Sync {
    fn ingest(&mut self, bytes: &mut [u8]) -> Result<Estimate, IngestError>;
    fn prepare(&mut self) -> Prepared;
    fn adopt(&mut self, tables: &Tables) -> Result<(), Unstable>;
    fn fit_quality(&mut self) -> FitQuality;
    fn steer(&mut self, feedback: Option<&Feedback>);
    fn correction(&self) -> Option<Correction>;
    fn covariance(&self, i: usize, j: usize) -> f32;
    fn inverse_factor(&self) -> Vec<f64>;
    fn fitted(&self) -> Vec<f32>;
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
    /// What its covariance is made of.
    fn inverse_factor(&self) -> &[f64];
    /// What it expects of the readings of the last frame [B] [m].
    fn fitted(&self, tables: &Self::Tables) -> Vec<f32>;
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
        Estimate::from_core(estimate, &tables.layout())
    }

    fn inverse_factor(&self) -> &[f64] {
        self.inverse_factor()
    }

    fn fitted(&self, tables: &G) -> Vec<f32> {
        let layout = tables.layout();
        (0..layout.monitors()).map(|b| self.fitted(layout.monitor(b))).collect()
    }
}

/// A core, its tables and its setup. Boxed: the Booster's state is some 150 kB, the largest some 42 MB.
pub struct Held<E: Core, S: Steers<E>> {
    tables: Box<E::Tables>,
    setup: E::Setup,
    core: Box<E>,
    steering: Option<Box<Loop<E, S>>>,
}

/// Size of a core from which on its work, and putting it together, may exceed the stack of a thread [B].
const LARGE: usize = 1 << 20;

/// Work on a core of this size, on a thread of its own if it is large.
fn on_its_stack<E, R: Send>(work: impl FnOnce() -> R + Send) -> R {
    if size_of::<E>() < LARGE { work() } else { with_stack(work) }
}

impl<E: Room, S: Steers<E>> Held<E, S>
where
    E::Tables: Clone + Send + Sync + 'static,
    E::Setup: Send + Sync + 'static,
    S::Feedback: Send + Sync + 'static,
{
    /// The core at its prior.
    pub fn boxed(tables: &Tables, setup: &Setup) -> Result<Box<dyn Stream>, Unstable> {
        on_its_stack::<E, _>(|| {
            let mut own = Box::new(<E::Tables as estimator::Tables>::BLANK);
            tables.fill(&mut *own).expect("the room was chosen for them");
            let mut held = Self { setup: E::setup(&own, setup), tables: own, core: Box::new(E::BLANK), steering: None };
            held.core.restart(&held.tables, &held.setup)?;
            Ok(Box::new(held) as Box<dyn Stream>)
        })
    }
}

impl<E: Room, S: Steers<E>> Stream for Held<E, S>
where
    E::Tables: Clone + Send + Sync + 'static,
    E::Setup: Send + Sync + 'static,
    S::Feedback: Send + Sync + 'static,
{
    fn ingest(&mut self, bytes: &mut [u8]) -> Result<Estimate, IngestError> {
        let Self { tables, setup, core, steering } = self;
        let estimate = match steering {
            None => core.ingest(tables, setup, bytes)?,
            Some(steering) => {
                let mut judged = steering.state.judge(core, (tables, setup), &steering.feedback, bytes)?;
                core.learn(tables, setup, &mut judged);
                steering.is_due = true;
                core.estimate(tables, setup, &judged)
            }
        };
        Ok(<E as Room>::estimate(tables, &estimate))
    }

    fn prepare(&mut self) -> Prepared {
        on_its_stack::<E, _>(|| {
            let prepared = self.core.prepare(&self.tables, &self.setup);
            // the feedback's share comes last, once a frame
            if let (Prepared::Nothing, Some(steering)) = (&prepared, &mut self.steering)
                && core::mem::replace(&mut steering.is_due, false)
            {
                let model = (&*self.tables, &self.setup);
                let _ = steering.state.prepare(&self.core, model, &steering.feedback);
            }
            prepared
        })
    }

    fn steer(&mut self, feedback: Option<&Feedback>) {
        let tables: &E::Tables = &self.tables;
        self.steering = on_its_stack::<E, _>(|| feedback.map(|wanted| Box::new(Loop::new(tables, wanted))));
    }

    fn correction(&self) -> Option<Correction> {
        let steering = self.steering.as_ref()?;
        Some(steering.state.correction(&self.tables, &steering.feedback))
    }

    fn adopt(&mut self, tables: &Tables) -> Result<(), Unstable> {
        on_its_stack::<E, _>(|| {
            tables.fill(&mut *self.tables).expect("they are of this machine");
            // its gains are those of the former tables
            self.steering.iter_mut().for_each(|steering| steering.restart());
            self.core.adopt(&self.tables, &self.setup)
        })
    }

    fn fit_quality(&mut self) -> FitQuality {
        self.core.fit_quality(&self.tables, &self.setup)
    }

    fn covariance(&self, i: usize, j: usize) -> f32 {
        self.core.covariance(i, j)
    }

    fn inverse_factor(&self) -> Vec<f64> {
        <E as Room>::inverse_factor(&self.core).to_vec()
    }

    fn fitted(&self) -> Vec<f32> {
        <E as Room>::fitted(&self.core, &self.tables)
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
            let Self { tables, setup, core, steering } = self;
            let (tables, setup, core) = (tables.clone(), setup.clone(), core.clone());
            Box::new(Self { tables, setup, core, steering: steering.clone() }) as Box<dyn Stream>
        })
    }
}

impl<E: Core, S: Steers<E>> fmt::Debug for Held<E, S> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "core of {} bytes after {} frames", size_of::<E>(), self.core.frames())
    }
}
