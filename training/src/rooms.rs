//! Cores of a few sizes, so that any ring up to the largest has one that fits: the machine's own, if it has one, else the
//! smallest with room for it. What is spare stays silent, see [`estimator::Layout`].
//!
//! | room | monitors | correctors | quadrupoles | supplies |
//! |---|---|---|---|---|
//! | the Booster | 15 + 18 | 24 + 24 | 48 | 2 |
//! | small | 24 + 24 | 24 + 24 | 48 | 4 |
//! | medium | 64 + 64 | 64 + 64 | 96 | 8 |
//! | wide | 128 + 128 | 128 + 128 | 128 | 8 |
//! | large | 128 + 128 | 128 + 128 | 256 | 16 |
//! | largest | 384 + 384 | 384 + 384 | 512 | 16 |
//! | along a ramp | 24 + 24, at four times in the cycle | 24 + 24 | 48 | 4 |

pub use estimator::booster;

/// Rings of a dozen cells.
#[allow(missing_docs)] // those of `estimator::machine!`
pub mod small {
    estimator::machine!(monitors: [24, 24], correctors: [24, 24], quadrupoles: 48, params: 48, supplies: 4);
}

/// Synchrotrons of a hundred quadrupoles.
#[allow(missing_docs)] // those of `estimator::machine!`
pub mod medium {
    estimator::machine!(monitors: [64, 64], correctors: [64, 64], quadrupoles: 96, params: 96, supplies: 8);
}

/// Light sources, whose monitors read both planes.
#[allow(missing_docs)] // those of `estimator::machine!`
pub mod wide {
    estimator::machine!(monitors: [128, 128], correctors: [128, 128], quadrupoles: 128, params: 128, supplies: 8);
}

/// Synchrotrons of up to 256 quadrupoles.
#[allow(missing_docs)] // those of `estimator::machine!`
pub mod large {
    estimator::machine!(monitors: [128, 128], correctors: [128, 128], quadrupoles: 256, params: 256, supplies: 16);
}

/// Rings of kilometres.
#[allow(missing_docs)] // those of `estimator::machine!`
pub mod largest {
    estimator::machine!(monitors: [384, 384], correctors: [384, 384], quadrupoles: 512, params: 512, supplies: 16);
}

/// Rings of a dozen cells whose machine file has a ramp: baselines for four times in the cycle.
#[allow(missing_docs)] // those of `estimator::machine!`
pub mod ramped {
    estimator::machine!(
        monitors: [24, 24],
        correctors: [24, 24],
        quadrupoles: 48,
        params: 48,
        supplies: 4,
        times: 4
    );
}

/// Evaluate an expression in the module of the room that a ring of these sizes takes, `None` if none is large enough:
/// `in_room!(sizes, |room| room::SIZES)`.
#[macro_export]
macro_rules! in_room {
    ($sizes:expr, |$room:ident| $body:expr) => {{
        let sizes = $sizes;
        if $crate::rooms::booster::SIZES == sizes {
            use $crate::rooms::booster as $room;
            Some($body)
        } else {
            $crate::in_spare_room!(sizes, |$room| $body)
        }
    }};
}

/// The same without the machines' own, for a ring that is to have room to spare.
#[macro_export]
macro_rules! in_spare_room {
    ($sizes:expr, |$room:ident| $body:expr) => {{
        let sizes = $sizes;
        if $crate::rooms::small::SIZES.hold(&sizes) {
            use $crate::rooms::small as $room;
            Some($body)
        } else if $crate::rooms::medium::SIZES.hold(&sizes) {
            use $crate::rooms::medium as $room;
            Some($body)
        } else if $crate::rooms::wide::SIZES.hold(&sizes) {
            use $crate::rooms::wide as $room;
            Some($body)
        } else if $crate::rooms::large::SIZES.hold(&sizes) {
            use $crate::rooms::large as $room;
            Some($body)
        } else if $crate::rooms::largest::SIZES.hold(&sizes) {
            use $crate::rooms::largest as $room;
            Some($body)
        } else {
            None
        }
    }};
}

/// Stack for the work in a room [B]: the largest core is put together on it, copied and linearised. It is reserved, and taken as far as it is used.
const STACK: usize = 4 * size_of::<largest::Estimator>();

/// Do something on a thread whose stack is large enough for any room.
///
/// # Panics
/// If the work does, or if there is no thread to be had.
pub fn with_stack<R: Send>(work: impl FnOnce() -> R + Send) -> R {
    std::thread::scope(|scope| {
        let thread = std::thread::Builder::new().stack_size(STACK).spawn_scoped(scope, work);
        let ended = thread.expect("a thread can be had").join();
        ended.unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    })
}
