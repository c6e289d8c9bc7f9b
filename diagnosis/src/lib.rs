//! Missing physics: where the model and a recording differ, which effect explains it, and whether a model with that effect predicts
//! better.
//!
//! [`Diagnosis::from_recording`] is the path from top to bottom: columns that are not what the header says are refused (`wiring.rs`), and read-backs that are not
//! the settings are told (`readback.rs`); what passes within a
//! setting is found by the differences of its frames and taken out (`transients/`); the recording is
//! whitened (`data.rs`), fitted by the exact twin without any
//! effect (`fit.rs`), every effect of the library is tried at every place (`scan.rs`), and so is an unmodelled discrepancy
//! (`discrepancy.rs`); the leading candidates are refitted and compete (`search.rs`); what is found has to predict frames that it was
//! not fitted to (`heldout.rs`); `verdict.rs` puts the result into one word and one sentence.

mod alternatives;
mod average;
mod baseline;
mod chance;
mod channel;
mod choice;
mod close_tunes;
mod columns;
mod common_factors;
mod data;
mod diagnosis;
mod discrepancy;
mod element;
mod exact_orbits;
mod experiment;
mod factors;
mod family;
mod feed_down;
mod fit;
mod frame_pattern;
mod half_normal;
mod heldout;
mod hypothesis;
mod jitter;
mod joint;
mod laplace;
mod levels;
mod limits;
mod linearisation;
mod location;
mod lost_frames;
mod memory;
mod modes;
mod noise;
mod odds;
mod out_of_range;
mod period;
mod place_scan;
mod pools;
mod readback;
mod readmission;
mod repeats;
mod scale;
mod scan;
mod scatter;
mod search;
mod slow_noise;
mod stuck_monitor;
mod term;
mod tested;
mod transients;
mod units;
mod unknown;
mod verdict;
mod widths;
mod wiring;

#[cfg(test)]
mod forward;
#[cfg(test)]
mod testing;

pub use alternatives::{Alternative, Cause, Competition, imitating};
pub use average::Vars;
pub use data::{Data, DataError, LEAST};
pub use diagnosis::Diagnosis;
pub use discrepancy::{Discrepancy, scan as scan_discrepancies, steering};
pub use element::Linear;
pub use experiment::{Change, Menu, Proposal};
pub use family::Family;
pub use fit::{FitError, Fitted, of_element, predicted, predicted_by};
pub use heldout::{CHANCE, SUPPORTED, Score, VALIDATED};
pub use hypothesis::{Hypothesis, in_order};
pub use limits::{Limits, SEEN, at_places};
pub use location::Location;
pub use odds::{DECISIVE, ODDS, SUSPICIOUS, UNMODELLED, corrections};
pub use out_of_range::OutOfRange;
pub use place_scan::{Interval, PlaceScan};
pub use scale::QUOTED;
pub use scan::{Candidate, candidates, scan};
pub use search::{Found, correction_of};
pub use term::Term;
pub use tested::Tested;
pub use transients::{Shown, Transient};
pub use unknown::{Member, Quantity, Unknown};
pub use verdict::{Finding, Verdict, capitalised, menu};
pub use wiring::Miswired;
