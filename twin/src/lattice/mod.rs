//! A ring as a list of elements, read from a machine file (`docs/machine.md`).

mod currents;
mod element;
mod error;
mod family;
mod file;
mod label;
mod parameter;
mod particle;
mod ramp;
mod ring;

pub use currents::{Currents, DipoleLaw, MagnetLaw, Polynomial, Weights};
pub use element::{Bend, Element, Kind, Misalignment, Plane};
pub use error::{LatticeError, unreadable};
pub use file::BUILT_IN;
pub use parameter::{Parameter, ParameterPrior, Quadrupole, Supply};
pub use particle::Particle;
pub use ramp::RampPoint;
pub use ring::{Corrector, Monitor, Ring};
