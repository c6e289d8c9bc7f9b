//! A fast stand-in for the twin: the orbit that a drive makes at given gradients, its derivative, and the tunes.

mod green;
mod low_rank;
mod network;
mod parcels;
mod quantised;
mod resnet;

pub use green::{Dispersion, Green, GreenLinearised, GreenPlane, GreenProgress, NONE};
pub use low_rank::{LowRank, TERMS};
pub use network::{HIDDEN, LARGEST, LAYERS, Network, Pass, Plain, Products, SAMPLES, smooth, smooth_slope};
pub use parcels::{List, RING, Table, VERSION, shape};
pub use quantised::{Block, SymmetricBlock, code, step};
pub use resnet::{
    CORRECTOR, CURRENTS, LAST_VAR, ORBIT, ResNet, ResNetLinearised, ResNetProgress, SETTING_KICK, SPAN, TUNE_SPAN,
    Trained,
};

use nalgebra::SMatrix;

use crate::drive::Drive;
use crate::linear::zeros;
use crate::sizes::{Layout, Sizes};
use crate::state::{State, state};
use crate::wire::{Parcel, ParcelError};

/// The orbit at the monitors, and its derivative with respect to every param and `ln` of every supply's factor.
#[derive(Debug, Clone)]
pub struct Prediction<const B: usize, const F: usize, const N: usize> {
    /// Change of the orbit made by the drive [m] [B].
    pub reading: [f32; B],
    /// Derivative with respect to `theta` [m], one column a monitor [N][B].
    pub jacobian: SMatrix<f32, N, B>,
    /// Derivative with respect to `ln` of each supply's factor [m] [B][F].
    pub by_supply: [[f32; F]; B],
}

state!([const B: usize, const F: usize, const N: usize] Prediction<B, F, N> { reading, jacobian, by_supply });

impl<const B: usize, const F: usize, const N: usize> Prediction<B, F, N> {
    /// Memory for one, all zero.
    pub const BLANK: Self = Self { reading: [0.0; B], jacobian: zeros(), by_supply: [[0.0; F]; B] };
}

/// No linearisation there: the ring would cross an integer or a half-integer resonance on the way from its design.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Unstable;

/// Tables that travel in parcels, whatever they are of.
pub trait Tables {
    /// Memory for tables, all zero.
    const BLANK: Self;
    /// What they have room for.
    const ROOM: Sizes;

    /// What the ring has, among what there is room for.
    fn layout(&self) -> Layout;

    /// All parts of the ring's tables but the seal, always in the same order, the head first. Spare slots are left out, so
    /// that one ring has the same parcels whatever the room.
    fn parts<const L: usize>(&self) -> impl Iterator<Item = Parcel<L>> + '_;

    /// Write a parcel where it belongs.
    ///
    /// # Errors
    /// [`ParcelError`].
    fn take<const L: usize>(&mut self, parcel: &Parcel<L>) -> Result<(), ParcelError>;

    /// CRC-32 (ISO-HDLC) of the bodies of all parts, in postcard, one after the other.
    fn digest<const L: usize>(&self) -> u32 {
        Parcel::<L>::digest(self.parts())
    }

    /// The tables in parcels, the seal last.
    fn parcels<const L: usize>(&self) -> impl Iterator<Item = Parcel<L>> + '_ {
        self.parts().chain(core::iter::once_with(|| Parcel::Seal { crc: self.digest::<L>() }))
    }
}

/// A model of the ring, relinearised occasionally, evaluated every frame: `B` monitors, `C` correctors, `F` supplies, `N`
/// params.
pub trait Surrogate<const B: usize, const C: usize, const F: usize, const N: usize>: Tables {
    /// The result of one linearisation.
    type Linearised: State;

    /// Memory for a linearisation, all zero.
    const UNLINEARISED: Self::Linearised;

    /// How far linearising has come, and its work space.
    type Progress;

    /// Before the first step.
    const BEGIN: Self::Progress;

    /// One step of linearising at params [N] and at `ln` of the supplies' factors [F], the same in each step; true after the
    /// last. Frames are answered between two steps: one should take no longer than a frame does.
    ///
    /// # Errors
    /// [`Unstable`]; `into` is then not to be used, and `progress` to be begun anew.
    fn advance(
        &self,
        params: &[f32; N],
        supplies: &[f32; F],
        progress: &mut Self::Progress,
        into: &mut Self::Linearised,
    ) -> Result<bool, Unstable>;

    /// Linearise, all steps at once.
    ///
    /// # Errors
    /// [`Unstable`]; `into` is then not to be used.
    fn linearise(&self, params: &[f32; N], supplies: &[f32; F], into: &mut Self::Linearised) -> Result<(), Unstable> {
        let mut progress = Self::BEGIN;
        while !self.advance(params, supplies, &mut progress, into)? {}
        Ok(())
    }

    /// True if what was linearised is within the range that the surrogate was made for; outside it extrapolates.
    fn is_within(&self, _at: &Self::Linearised) -> bool {
        true
    }

    /// The orbit that a drive makes [m].
    fn orbit(&self, at: &Self::Linearised, drive: &Drive<C, F>, into: &mut [f32; B]);

    /// The orbit that a drive makes, and its derivative.
    fn predict(&self, at: &Self::Linearised, drive: &Drive<C, F>, into: &mut Prediction<B, F, N>);

    /// The tune in a plane (0 for x) up to an integer, and its derivative with respect to every param; `strength` is `ln` of
    /// the supplies' factors about where it was linearised.
    fn tune(&self, at: &Self::Linearised, plane: usize, strength: &[f32; F]) -> (f32, [f32; N]);

    /// Which of the setup's priors a param has.
    fn prior_group(&self, param: usize) -> usize;

    /// Stated mean square error of a prediction at one monitor [m^2]: the same at every repeat of a setting, unlike noise.
    ///
    /// `orbit` is the rms of the baseline orbit in the monitor's plane, times the growth of what [`Surrogate::follow`] says of all
    /// gradients since the design [m]; with an RF offset, the part of the dispersion that the unknown misalignments make grows with
    /// it.
    fn error_variance(&self, monitor: usize, rf_offset: f32, orbit: f32) -> f32;

    /// How the orbits of kicks in a plane (0 for x) follow the gradients: rms change per `ln` of each supply's factor, and of all
    /// gradients, over the rms orbit, of kicks by all correctors [1].
    fn follow(&self, at: &Self::Linearised, plane: usize) -> ([f32; F], f32);
}

/// What orbit feedback asks of a surrogate beyond an estimate.
pub trait Steerable<const B: usize, const C: usize, const F: usize, const N: usize>: Surrogate<B, C, F, N> {
    /// What an orbit asks of each corrector, `R^T orbit` [m^2/rad]: the transpose of [`Surrogate::orbit`] for kicks.
    fn pull(&self, at: &Self::Linearised, orbit: &[f32; B], into: &mut [f32; C]);

    /// How uncertain the responses to the correctors of a plane (0 for x) are, [m^2/rad^2] times the unit of `weight`:
    /// `sum over monitors b of weight_b cov(R_bc, R_bd)`, for the covariance of the params, of which `covariance` gives one row.
    /// It comes as a sum of products: `add` gets the two factors of each, one entry a corrector of the plane.
    fn response_covariance(
        &self,
        at: &Self::Linearised,
        plane: usize,
        weight: &[f32; B],
        covariance: impl Fn(usize) -> [f32; N],
        add: impl FnMut(&[f32], &[f32]),
    );
}
