//! The sizes of the first machine, the AGS Booster: 15 + 18 monitors, 24 + 24 correctors, 48 quadrupoles of two nodes each.

use crate::surrogate;

/// Its Green's function: 96 nodes, 4656 pairs of them.
pub type Green = surrogate::Green<15, 18, 24, 24, 96, 4656>;
/// Its core: 48 params (1176 pairs of them), and room for 99 settings: each corrector up and down, none, two of the RF.
pub type Estimator = crate::Estimator<Green, 33, 48, 48, 99, 1176>;
/// One of its cycles.
pub type Frame = crate::Frame<33, 48>;
/// What is known of it after a frame.
pub type Estimate = crate::Estimate<33, 48>;
