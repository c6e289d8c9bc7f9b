//! What a frame's currents do to the beam: kicks, common changes of the quadrupoles, and the RF offset.

use serde::{Deserialize, Serialize};

use crate::frame::{CurrentCode, Frame};

/// How read-backs become kicks and gradients: the constants of a recording's header.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Kick of a corrector at nominal momentum [rad/A].
    pub kick_per_ampere: f32,
    /// Nominal currents of dipoles, QH and QV [A].
    pub nominal: [f32; 3],
    /// Transfer polynomial `p(r) = sum(c_n r^n)` of a quadrupole, r = current over nominal.
    pub transfer: [f32; 6],
    /// Read-back above which a corrector counts as powered [A]; read-backs scatter by 20 mA.
    pub powered: f32,
}

/// What acts on the beam in one frame, or on average over the frames of one setting.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drive<const C: usize> {
    /// Kick of each corrector [rad].
    pub kick: [f32; C],
    /// `ln` of the common factor of all QH, and of all QV gradients.
    pub strength: [f32; 2],
    /// Relative offset of the RF frequency.
    pub rf_offset: f32,
}

/// Largest kick of all correctors together [rad], 25 times that of one: beyond it first-order optics says nothing.
const KICKS: f32 = 5e-3;
/// Largest `ln` of a common gradient factor, and of the dipole current over nominal: a tune moves by half a unit.
const STRENGTH: f32 = 0.05;
/// Largest RF offset: 1 % of momentum.
const RF_OFFSET: f32 = 1e-3;

/// A drive beyond what the model describes: another machine state, or a wrong read-back.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Beyond {
    /// Which part of it.
    pub what: &'static str,
    /// Largest magnitude described.
    pub limit: f32,
    /// What the frame has.
    pub got: f32,
}

impl Calibration {
    /// What a frame's currents do.
    ///
    /// # Errors
    /// [`Beyond`] for currents that no model of this machine describes.
    ///
    /// The dipoles set the momentum, so kicks and gradients are divided by `I_dipole / nominal`:
    /// `k1 = var * k1_design * p(I / I_nominal) / p(1) / (I_dipole / I_dipole_nominal)`.
    pub fn drive<const B: usize, const C: usize>(&self, frame: &Frame<B, C>) -> Result<Drive<C>, Beyond> {
        let rigidity = frame.magnets.dipole.value() / self.nominal[0];
        within("dipole current over nominal, less 1", rigidity - 1.0, STRENGTH)?;
        let strength = |current: CurrentCode, nominal: f32| {
            let factor = self.transfer_at(current.value() / nominal) / self.transfer_at(1.0) / rigidity;
            within("common gradient factor, less 1", factor - 1.0, STRENGTH)?;
            Ok(libm::logf(factor))
        };
        let kick = frame.corrector.map(|c| c.value() * self.kick_per_ampere / rigidity);
        within("sum of kicks in rad", kick.iter().map(|k| k.abs()).sum(), KICKS)?;
        Ok(Drive {
            kick,
            strength: [strength(frame.magnets.qh, self.nominal[1])?, strength(frame.magnets.qv, self.nominal[2])?],
            rf_offset: within("rf offset", frame.rf_offset.value(), RF_OFFSET)?,
        })
    }

    fn transfer_at(&self, ratio: f32) -> f32 {
        self.transfer.iter().rev().fold(0.0, |sum, c| sum * ratio + c)
    }
}

fn within(what: &'static str, got: f32, limit: f32) -> Result<f32, Beyond> {
    if got.abs() <= limit { Ok(got) } else { Err(Beyond { what, limit, got }) }
}
