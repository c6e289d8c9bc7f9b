//! Hostile bytes for everything that orbitcal reads. A [`Target`] reads bytes as one kind of file or packet and uses what it read as the
//! program does; [`attack()`] runs it once and says what is wrong: a panic, more time or more memory than the limits of docs/limits.md allow.
//!
//! `make fuzz` mutates good files, the seeds of each target; inputs that once were too much for a reader stand in `corpus/TARGET`, and a
//! test reads them all again. The same targets run under libFuzzer: fuzz/fuzz_targets/any.rs.

mod attack;
mod mutation;
mod targets;

pub use attack::{Fault, MEMORY, attack};
pub use mutation::Mutator;
pub use targets::{Target, repository, target, targets};

/// Counts what is in use, for the peak of each input.
#[global_allocator]
static ALLOCATOR: peak_alloc::PeakAlloc = peak_alloc::PeakAlloc;
