//! What a frame's currents do to the beam: kicks, common changes of the quadrupoles, and the RF offset.

use crate::frame::{CurrentCode, Frame};

/// How read-backs become kicks and gradients: the constants of a recording's header.
#[derive(Debug, Clone, Copy, PartialEq)]
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

impl Calibration {
    /// What a frame's currents do.
    ///
    /// The dipoles set the momentum, so kicks and gradients are divided by `I_dipole / nominal`:
    /// `k1 = var * k1_design * p(I / I_nominal) / p(1) / (I_dipole / I_dipole_nominal)`.
    pub fn drive<const B: usize, const C: usize>(&self, frame: &Frame<B, C>) -> Drive<C> {
        let rigidity = frame.magnets.dipole.value() / self.nominal[0];
        // A supply that is off or reversed has no logarithm; its frame then predicts nothing sensible and is gated.
        let rigidity = if rigidity > 0.1 { rigidity } else { 0.1 };
        let strength = |current: CurrentCode, nominal: f32| {
            let factor = self.transfer_at(current.value() / nominal) / self.transfer_at(1.0);
            libm::logf((factor / rigidity).clamp(0.1, 10.0))
        };
        Drive {
            kick: frame.corrector.map(|c| c.value() * self.kick_per_ampere / rigidity),
            strength: [strength(frame.magnets.qh, self.nominal[1]), strength(frame.magnets.qv, self.nominal[2])],
            rf_offset: frame.rf_offset.value(),
        }
    }

    fn transfer_at(&self, ratio: f32) -> f32 {
        self.transfer.iter().rev().fold(0.0, |sum, c| sum * ratio + c)
    }
}
