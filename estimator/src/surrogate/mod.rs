//! A fast stand-in for the twin: the orbit that a drive makes at given gradients, and its derivative.

mod green;
mod low_rank;
mod parcel;
mod quantised;

pub use green::{Dispersion, Green, GreenLinearised, GreenPlane};
pub use low_rank::{LowRank, TERMS};
pub use parcel::{Head, List, Parcel, ParcelError, Table};
pub use quantised::{Block, SymmetricBlock};

use nalgebra::SMatrix;

use crate::drive::Drive;
use crate::linear::zeros;

/// The orbit at the monitors, and its derivative with respect to `ln` of every gradient.
#[derive(Debug, Clone)]
pub struct Prediction<const B: usize, const N: usize> {
    /// Change of the orbit made by the drive [m] [B].
    pub reading: [f32; B],
    /// Derivative with respect to `theta` [m], one column a monitor [N][B].
    pub jacobian: SMatrix<f32, N, B>,
}

impl<const B: usize, const N: usize> Prediction<B, N> {
    /// Memory for one, all zero.
    pub const BLANK: Self = Self { reading: [0.0; B], jacobian: zeros() };

    /// Derivative with respect to `ln` of the QH and of the QV current at each monitor [m]; the first `first_family` of the
    /// gradients hang on QH.
    pub fn by_family(&self, first_family: usize) -> [[f32; 2]; B] {
        let mut by_family = [[0.0; 2]; B];
        for (to, slope) in by_family.iter_mut().zip(self.jacobian.as_slice().chunks_exact(N)) {
            let (first, second) = slope.split_at(first_family.min(N));
            *to = [first.iter().sum(), second.iter().sum()];
        }
        by_family
    }
}

/// No linearisation there: the ring would cross an integer resonance on the way from its design.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Unstable;

/// A model of the ring that is linearised now and then, and asked every frame.
pub trait Surrogate<const B: usize, const C: usize, const N: usize> {
    /// What one linearisation leaves behind.
    type Linearised;

    /// Memory for a linearisation, all zero.
    const BLANK: Self::Linearised;

    /// Linearise at `strength`, the gradient of each quadrupole over its design value [N].
    ///
    /// # Errors
    /// [`Unstable`]; `into` is then not to be used.
    fn linearise(&self, strength: &[f32; N], into: &mut Self::Linearised) -> Result<(), Unstable>;

    /// The orbit that a drive makes [m].
    fn orbit(&self, at: &Self::Linearised, drive: &Drive<C>, into: &mut [f32; B]);

    /// The orbit that a drive makes, and its derivative.
    fn predict(&self, at: &Self::Linearised, drive: &Drive<C>, into: &mut Prediction<B, N>);

    /// Number of horizontal monitors; they come first.
    fn horizontal_monitors(&self) -> usize;

    /// Number of quadrupoles on the first (QH) supply; they come first.
    fn first_family(&self) -> usize;

    /// Stated mean square error of a prediction at one monitor [m^2]: the same at every repeat of a setting, unlike noise.
    ///
    /// `orbit` is the rms of the baseline orbit in the monitor's plane [m]; with an RF offset, the part of the
    /// dispersion that the unknown misalignments make grows with it.
    fn error_variance(&self, monitor: usize, rf_offset: f32, orbit: f32) -> f32;
}
