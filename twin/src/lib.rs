//! Digital twin of a ring: exact maps, closed orbit, orbit response and everything differentiable about it, in `f64`.
//!
//! A machine file becomes a [`Ring`]; [`Optics::of`] finds its closed orbit and linearises about it; the response of
//! any place to any kick, and its derivative with respect to any gradient, follow from the closed-orbit Green's
//! function. Symbols, signs and sources: `docs/model.md`.
//!
//! ```
//! use twin::{Hold, Optics, Ring};
//! let ring = Ring::booster();
//! let optics = Optics::of(&ring, Hold::Momentum { delta: 0.0 })?;
//! assert!((optics.tunes()?.x - 4.8313).abs() < 1e-4);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
mod calibrated;
mod dispersion;
mod effects;
mod factors;
mod lattice;
pub mod limits;
mod map;
mod matrix;
mod median;
mod modes;
mod orbit;
mod response;
mod ripple;
mod site;
mod sobol;
mod spurious;
#[cfg(test)]
mod testing;
mod tune;
mod twiss;
mod varied;

pub use calibrated::{CalibratedOptics, differentiate};
pub use effects::{
    Class, CorrectorEffect, Cycle, DriftEffect, Drives, Effect, EffectError, EffectKind, EffectText, FieldEffect, Held,
    HoldEffect, Holding, Machine, MachineResponse, Measured, Mechanism, MonitorEffect, Rf, Signature, Signatures, Thin,
    Tracked, Unit, change_at,
};
pub use factors::ResponseFactors;
pub use lattice::{
    BUILT_IN, Bend, Corrector, Currents, DipoleLaw, Element, Kind, LatticeError, MagnetLaw, Misalignment, Monitor,
    Parameter, ParameterPrior, Particle, Plane, Polynomial, Quadrupole, RampPoint, Ring, Supply, Weights, unreadable,
};
pub use map::Phase;
pub use median::median;
pub use orbit::{ClosedOrbit, Hold, OrbitError};
pub use response::{Gradient, Observer, Optics, Place, Source};
pub use ripple::ripple_of_misaligned;
pub use site::Site;
pub use sobol::sobol;
pub use spurious::{SHARED, spurious_dispersion};
pub use tune::Tunes;
pub use twiss::Twiss;
pub use varied::{VariedOptics, VariedRing};
