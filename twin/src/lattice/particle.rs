//! The particle that a ring keeps.

/// The particle at the reference momentum.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Particle {
    /// Rest energy [GeV].
    pub rest_energy: f64,
    /// Kinetic energy [GeV].
    pub kinetic_energy: f64,
}

/// Rest energies of the particles that a machine file may name [GeV] (CODATA 2018).
const REST_ENERGY: [(&str, f64); 2] = [("proton", 0.938_272_088_16), ("electron", 0.510_998_95e-3)];

impl Particle {
    /// Rest energy of a particle that a machine file may name [GeV].
    pub fn rest_energy_of(name: &str) -> Option<f64> {
        REST_ENERGY.iter().find(|(known, _)| *known == name).map(|particle| particle.1)
    }

    /// The word for it in machine files and recordings.
    pub fn name(&self) -> &'static str {
        let known = REST_ENERGY.iter().find(|(_, energy)| *energy == self.rest_energy);
        known.expect("made from a name of this list").0
    }

    /// Momentum at the kinetic energy [GeV/c].
    pub fn momentum(&self) -> f64 {
        (self.kinetic_energy * (self.kinetic_energy + 2.0 * self.rest_energy)).sqrt()
    }

    /// Lorentz factor at momentum `1 + delta` times the reference.
    pub fn gamma(&self, delta: f64) -> f64 {
        let gamma0 = 1.0 + self.kinetic_energy / self.rest_energy;
        (1.0 + (gamma0 * gamma0 - 1.0) * (1.0 + delta) * (1.0 + delta)).sqrt()
    }

    /// Speed over that of light at momentum `1 + delta` times the reference.
    pub fn beta(&self, delta: f64) -> f64 {
        let gamma = self.gamma(delta);
        (1.0 - 1.0 / (gamma * gamma)).sqrt()
    }
}
