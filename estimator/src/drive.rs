//! What a frame's currents do to the beam: kicks, common changes of the quadrupoles, and the RF offset.

use heapless::Vec;
use serde::{Deserialize, Serialize};

use crate::beyond::Beyond;
use crate::ramp::Ramp;
use crate::state::state;
use crate::wire::{CurrentCode, Frame};

/// A number that holds for all of `L` things, or one for each.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Each<const L: usize> {
    /// For all that have none of their own.
    pub all: f32,
    /// Their own: none, or one for each.
    pub own: Vec<f32, L>,
}

impl<const L: usize> Each<L> {
    /// The same for all.
    pub const fn same(all: f32) -> Self {
        Self { all, own: Vec::new() }
    }

    /// That of the `i`-th.
    pub fn of(&self, i: usize) -> f32 {
        self.own.get(i).copied().unwrap_or(self.all)
    }

    /// True if there is none, or one for each, and all are numbers above 0.
    pub fn is_positive(&self) -> bool {
        self.is_finite() && self.all > 0.0 && self.own.iter().all(|v| *v > 0.0)
    }

    /// True if there is none, or one for each, and all are numbers.
    pub fn is_finite(&self) -> bool {
        let has_all = self.own.is_empty() || self.own.is_full();
        has_all && self.all.is_finite() && self.own.iter().all(|v| v.is_finite())
    }
}

/// How the current of a quadrupole supply becomes a gradient.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SupplyCalibration {
    /// Current at which its quadrupoles have their design gradients [A].
    pub nominal: f32,
    /// Transfer polynomial `p(r) = sum(c_n r^n)`, r = current over nominal.
    pub transfer: [f32; 6],
}

/// How read-backs become kicks and gradients: the constants of a recording's header.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Calibration<const C: usize, const F: usize> {
    /// Kick of a corrector at nominal momentum [rad/A]; its sign is that of the current.
    pub kick_per_ampere: Each<C>,
    /// Nominal current of the dipoles [A]; without one their read-back does not count.
    pub dipole: Option<f32>,
    /// The supplies of quadrupoles.
    pub supplies: Vec<SupplyCalibration, F>,
    /// What changes along the ramp.
    pub ramp: Ramp<F>,
}

/// What acts on the beam in one frame, or on average over the frames of one setting.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drive<const C: usize, const F: usize> {
    /// Kick of each corrector [rad].
    pub kick: [f32; C],
    /// `ln` of the common factor of each supply's gradients.
    pub strength: [f32; F],
    /// Relative offset of the RF frequency.
    pub rf_offset: f32,
}

state!([const C: usize, const F: usize] Drive<C, F> { kick, strength, rf_offset });

impl<const C: usize, const F: usize> Drive<C, F> {
    /// Nothing drives the beam.
    pub const NONE: Self = Self { kick: [0.0; C], strength: [0.0; F], rf_offset: 0.0 };
}

/// Largest root of the sum of squared kicks [rad], as which an orbit grows: beyond it first-order optics says nothing.
const KICKS: f32 = 5e-3;
/// Largest `ln` of a common gradient factor, and of the dipole current over nominal: a tune moves by half a unit.
const STRENGTH: f32 = 0.05;
/// Largest RF offset: 1 % of momentum.
const RF_OFFSET: f32 = 1e-3;

impl SupplyCalibration {
    /// A supply without quadrupoles.
    pub const IDLE: Self = Self { nominal: 1.0, transfer: [1.0, 0.0, 0.0, 0.0, 0.0, 0.0] };

    /// Gradients over those of the design, at nominal momentum.
    fn factor(&self, current: CurrentCode) -> f32 {
        self.transfer_at(current.value() / self.nominal) / self.transfer_at(1.0)
    }

    fn transfer_at(&self, ratio: f32) -> f32 {
        self.transfer.iter().rev().fold(0.0, |sum, c| sum * ratio + c)
    }

    fn is_sound(&self) -> bool {
        self.transfer.iter().all(|c| c.is_finite()) && self.nominal.is_finite() && self.nominal > 0.0
    }
}

impl<const C: usize, const F: usize> Calibration<C, F> {
    /// True if every number is finite, every size positive, and there is one supply for each.
    pub fn is_sound(&self) -> bool {
        let is_positive = |v: f32| v.is_finite() && v > 0.0;
        self.kick_per_ampere.is_positive()
            && self.dipole.is_none_or(is_positive)
            && self.supplies.is_full()
            && self.supplies.iter().all(SupplyCalibration::is_sound)
            && self.ramp.is_sound()
    }

    /// What a frame's currents do.
    ///
    /// # Errors
    /// [`Beyond`] for currents that no model of this machine describes.
    ///
    /// The dipoles set the momentum, so kicks and gradients are divided by `I_dipole / nominal`:
    /// `k1 = var * k1_design * p(I / I_nominal) / p(1) / (I_dipole / I_dipole_nominal)`. Along a ramp the nominal current of the
    /// dipoles, the momentum that goes with it, and the gradients that make `k1_design` of it are those at the frame's time:
    ///
    /// `k1 = var * k1_design * p(I / I_nominal) / p(I(t) / I_nominal) / (I_dipole / I_dipole(t))`,
    /// `kick = kick_per_ampere * I / (momentum(t) * I_dipole / I_dipole(t))`;
    ///
    /// the RF offset is the one that would move the momentum as much at the reference momentum, `f / slip(t)`.
    pub fn drive<const B: usize, const W: usize>(&self, frame: &Frame<B, C, F, W>) -> Result<Drive<C, F>, Beyond> {
        let at = self.ramp.at(frame.cycle_time_us)?;
        let rigidity = self.dipole.map_or(1.0, |nominal| frame.magnets.dipole.value() / (nominal * at.dipole));
        within("dipole current over nominal, less 1", rigidity - 1.0, STRENGTH)?;
        let mut kick = frame.corrector.map(CurrentCode::value);
        let stiffness = rigidity * at.momentum;
        kick.iter_mut().enumerate().for_each(|(c, kick)| *kick = *kick * self.kick_per_ampere.of(c) / stiffness);
        within("root of summed squares of kicks in rad", libm::sqrtf(kick.iter().map(|k| k * k).sum()), KICKS)?;
        let mut strength = [0.0; F];
        let each = self.supplies.iter().zip(frame.magnets.supply).zip(at.gradient);
        for (to, ((supply, current), gradient)) in strength.iter_mut().zip(each) {
            let factor = supply.factor(current) / (rigidity * gradient);
            within("common gradient factor, less 1", factor - 1.0, STRENGTH)?;
            *to = libm::logf(factor);
        }
        Ok(Drive { kick, strength, rf_offset: within("rf offset", frame.rf_offset.value() / at.slip, RF_OFFSET)? })
    }
}

fn within(what: &'static str, got: f32, limit: f32) -> Result<f32, Beyond> {
    if got.abs() <= limit { Ok(got) } else { Err(Beyond { what, limit, got }) }
}
