//! Validation of the diagnosis on simulated blind campaigns whose truth is known, some without effects and some with physics that no
//! effect of the library describes.
//!
//! A case is drawn ([`Cases`]), tracked exactly, diagnosed, and scored; [`Tables`] counts. Beside each verdict stands the oracle:
//! the gain in `ln` posterior when kind, place and size are given, over the best fit of vars and baselines without effects, on a machine that is ideal
//! otherwise. For physics that the library does not hold the exact signal is given: the same seed makes the same machine and noise without it.
//!
//! Half of the machines have ordinary imperfections (`imperfect.rs`). The base model allows for such, so that the vars of ideal machines are closer to the
//! truth than their error bars say.
//!
//! ```
//! use inference::{Campaign, Recording};
//! use twin::Ring;
//! use validation::{Cases, Class};
//!
//! let ring = Ring::booster();
//! let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../recordings/paper-vars");
//! let template = Recording::read(folder.as_ref(), &ring)?;
//! let cases = Cases::of(&Campaign::of(&ring, &template)?)?;
//! // a case is its number's and its seed's: `validation::run` would simulate, diagnose and score it
//! let case = cases.draw(Class::Single, Class::Single.number(0), 6);
//! assert_eq!((case.class, case.effects.len()), (Class::Single, 1));
//! # Ok::<(), Box<dyn core::error::Error>>(())
//! ```

mod campaigns;
mod case;
mod challenge;
mod imperfect;
mod mixes;
mod outcome;
mod score;
mod share;
mod stated;
mod tables;
#[cfg(test)]
mod testing;
mod unmodelled;

pub use campaigns::{CampaignError, known, run_all};
pub use case::{Case, Cases, Class};
pub use challenge::{Challenge, FolderError, Scored, folders};
pub use outcome::{Outcome, run};
pub use score::{Grade, Truth};
pub use tables::Tables;
pub use unmodelled::{Unmodelled, UnmodelledKind};
