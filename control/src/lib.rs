//! Measurements through a control system.
//!
//! ```text
//! Plan -> preflight -> Journal -> Session: set, settle, Frame, ... -> restore -> Recording
//! ```
//!
//! A [`Plan`] says what is set and which channels do it; [`measure()`] carries it out over any [`Control`]: [`Epics`] speaks to a real
//! control system, [`simulated::SimulatedControl`] to a simulated machine within the process. The [`Journal`] holds what the
//! machine was set to before the first write, so that [`restore()`] can put it back after anything.

mod channel;
mod epics;
mod frame;
mod gathering;
mod journal;
mod measure;
mod plan;
mod preflight;
mod restore;
mod session;
pub mod simulated;
mod step;

pub use channel::{Channel, Control, ControlError, Sample};
pub use epics::Epics;
pub use frame::Frame;
pub use gathering::Gathering;
pub use journal::{Journal, JournalError, Setting};
pub use measure::{MeasureError, measure, recording};
pub use plan::{Channels, Plan, PlanError, Waveform};
pub use preflight::{PreflightError, preflight};
pub use restore::{RestoreError, restore};
pub use session::{NotFollowing, Progress, SessionError};
pub use step::Step;
