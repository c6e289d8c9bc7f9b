//! Orbit feedback on a core of any size: what is wanted, and the set points that follow.

use estimator::{Core, CurrentCode, Each, Estimator, Layout, Steer, Steerable, Steered, Steering};

/// What is wanted of the orbit, and what the correctors may do; [`estimator::Feedback`] for a ring of any size.
#[derive(Debug, Clone, PartialEq)]
pub struct Feedback {
    /// Wanted reading of each monitor [m] [B].
    pub orbit: Vec<f32>,
    /// Largest current of each corrector [A] [C]; one with 0 is moved by others.
    pub limit: Vec<f32>,
    /// How far the orbit walks by itself at a monitor [m/sqrt(s)].
    pub walk: f32,
    /// Kick in one frame that costs as much as an orbit of one standard deviation at one monitor [rad].
    pub step_kick: f32,
    /// The same of the whole kick [rad].
    pub total_kick: f32,
    /// Largest change of a set point in one frame [A].
    pub rate: f32,
    /// By how much each corrector is moved while the model is in doubt [A].
    pub probe: f32,
    /// Read-backs this close to their set points follow them [A].
    pub close: f32,
    /// Frames further apart than this do not belong together [us].
    pub patience_us: u64,
}

/// What a feedback made of the last frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Correction {
    /// Why the set points stayed as they were, and how many correctors are left out or at their limit.
    pub steered: Steered,
    /// Set points of the correctors [A] [C].
    pub setpoint: Vec<f32>,
    /// What holds for each corrector [C].
    pub role: Vec<Role>,
}

/// What a corrector is to the feedback; the numbers are those in shared memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum Role {
    /// Others move it: its set point is its read-back.
    Unused = 0,
    /// The feedback moves it.
    Used = 1,
    /// It does not follow its set point, and is left out.
    LeftOut = 2,
}

/// A feedback that can be told what is wanted, and asked for its set points, without its sizes.
pub trait Steers<E: Core>: Steering<E> + Clone + Send + Sync + 'static {
    /// For a core that uses these tables.
    fn wanted(tables: &E::Tables, feedback: &Feedback) -> Self::Feedback;
    /// Without spare slots.
    fn correction(&self, tables: &E::Tables, feedback: &Self::Feedback) -> Correction;
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
> Steers<Estimator<G, B, C, F, N, S, K, T, U, W>> for Steer<B, C, CX, CY, TX, TY>
{
    fn wanted(tables: &G, feedback: &Feedback) -> Self::Feedback {
        let layout = tables.layout();
        estimator::Feedback {
            orbit: in_slots(&feedback.orbit, |b| layout.monitor(b)),
            walk: feedback.walk,
            step_kick: feedback.step_kick,
            total_kick: feedback.total_kick,
            limit: in_slots(&feedback.limit, |c| layout.corrector(c)),
            rate: feedback.rate,
            probe: feedback.probe,
            close: feedback.close,
            patience_us: feedback.patience_us,
        }
    }

    fn correction(&self, tables: &G, feedback: &Self::Feedback) -> Correction {
        let layout: Layout = tables.layout();
        let slots = || (0..layout.correctors()).map(|c| layout.corrector(c));
        let role = |slot| match (feedback.uses(slot), self.follows(slot)) {
            (false, _) => Role::Unused,
            (true, true) => Role::Used,
            (true, false) => Role::LeftOut,
        };
        Correction {
            steered: self.steered(),
            setpoint: slots().map(|slot| CurrentCode::value(self.setpoints()[slot])).collect(),
            role: slots().map(role).collect(),
        }
    }
}

/// Each number in its slot, 0 in spare ones.
fn in_slots<const L: usize>(values: &[f32], slot: impl Fn(usize) -> usize) -> Each<L> {
    let mut each = Each::same(0.0);
    each.own.resize(L, 0.0).expect("as many as there is room for");
    values.iter().enumerate().for_each(|(i, value)| each.own[slot(i)] = *value);
    each
}

/// A feedback on a core, and what it is told.
pub struct Loop<E: Core, S: Steering<E>> {
    pub feedback: S::Feedback,
    pub state: S,
    /// A frame has come since its gains were looked at.
    pub is_due: bool,
}

impl<E: Core, S: Steers<E>> Loop<E, S> {
    /// Not a frame so far.
    pub fn new(tables: &E::Tables, feedback: &Feedback) -> Self {
        Self { feedback: S::wanted(tables, feedback), state: S::BLANK, is_due: false }
    }

    /// As if the next frame were the first.
    pub fn restart(&mut self) {
        (self.state, self.is_due) = (S::BLANK, false);
    }
}

impl<E: Core, S: Steers<E>> Clone for Loop<E, S> {
    fn clone(&self) -> Self {
        Self { feedback: self.feedback.clone(), state: self.state.clone(), is_due: self.is_due }
    }
}
