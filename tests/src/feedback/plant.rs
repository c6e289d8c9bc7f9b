//! The machine of a closed loop: exact closed orbits of a misaligned Booster whose vars, magnets and momentum move.

use estimator::booster::{CORRECTORS, MONITORS, PARAMS, SUPPLIES};
use nalgebra::SVector;
use twin::{ClosedOrbit, Hold, OrbitError, Ring};

use crate::machine::Random;

/// Standard deviation of the quadrupoles' positions [m]; with it the orbit is 1 to 4 mm.
const MISALIGNED: f64 = 1.5e-4;
/// Standard deviation of the monitors' offsets [m].
const OFFSET: f64 = 0.7e-3;

/// The orbit at the monitors [m].
pub type Orbit = SVector<f64, MONITORS>;

/// A Booster.
#[derive(Debug, Clone)]
pub struct Plant {
    /// Without gradient errors and kicks, as misaligned as it is.
    ring: Ring,
    /// The closed orbit of the last cycle, near which the next one is.
    last: ClosedOrbit,
    /// `ln` of each var.
    pub params: [f64; PARAMS],
    /// What each monitor reads of a centred beam [m].
    pub offset: Orbit,
}

impl Plant {
    /// A misaligned machine of these vars.
    ///
    /// # Errors
    /// [`OrbitError`] without a closed orbit.
    pub fn new(vars: &[f64], random: &mut Random) -> Result<Self, OrbitError> {
        let mut ring = Ring::booster();
        let last = ClosedOrbit::find(&ring, Hold::Momentum { delta: 0.0 })?;
        for quadrupole in ring.quadrupoles.clone() {
            let misalignment = &mut ring.elements[quadrupole.element].misalignment;
            (misalignment.dx, misalignment.dy) = (MISALIGNED * random.normal(), MISALIGNED * random.normal());
        }
        let params = core::array::from_fn(|i| vars[i].ln());
        Ok(Self { ring, last, params, offset: Orbit::from_fn(|_, _| OFFSET * random.normal()) })
    }

    /// Move a quadrupole in x and y [m].
    pub fn move_quadrupole(&mut self, quadrupole: usize, by: [f64; 2]) {
        let misalignment = &mut self.ring.elements[self.ring.quadrupoles[quadrupole].element].misalignment;
        misalignment.dx += by[0];
        misalignment.dy += by[1];
    }

    /// The orbit of a cycle [m], for kicks [rad], `ln` of the supplies' factors, and a momentum.
    ///
    /// # Errors
    /// [`OrbitError`] without a closed orbit.
    pub fn orbit(
        &mut self,
        kick: &[f64; CORRECTORS],
        strength: &[f64; SUPPLIES],
        delta: f64,
    ) -> Result<Orbit, OrbitError> {
        let mut ring = self.ring.with_strengths(&self.ring.strengths(&self.params, strength));
        kick.iter().enumerate().for_each(|(c, kick)| ring.set_kick(c, *kick));
        self.last = ClosedOrbit::near(&ring, Hold::Momentum { delta }, &self.last)?;
        let position = |monitor: twin::Monitor| self.last.at[monitor.element][2 * monitor.plane.index()];
        Ok(Orbit::from_iterator(ring.monitors_read().map(position)))
    }
}
