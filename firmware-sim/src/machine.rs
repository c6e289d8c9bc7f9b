//! The machine that the program is built for: its sizes, their types, and its tables. The build script writes them.
#![allow(missing_docs)] // those of `estimator::machine!`

use estimator::Sizes;
use estimator::surrogate::{Block, Dispersion, GreenPlane, LowRank, SymmetricBlock};

include!(concat!(env!("OUT_DIR"), "/machine.rs"));

/// RAM that `memory.x` grants, less the queue of received bytes [B]; the linker counts to the byte.
const ROOM: usize = (238 - 4) * 1024;
const _: () = assert!(size_of::<Estimator>() + size_of::<Steer>() + size_of::<Tables>() <= ROOM, "{}", TOO_LARGE);

/// The tables of its core.
pub type Tables = <Estimator as estimator::Core>::Tables;

/// Those of its design.
pub static BUILT_IN: Tables = include!(concat!(env!("OUT_DIR"), "/tables.rs"));
