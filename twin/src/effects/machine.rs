//! A ring with effects applied, and the response that would then be measured.

use nalgebra::DMatrix;

use super::corrector::Kick;
use super::field::Curved;
use super::hold::{Held, Holding};
use super::mechanism::Mechanism;
use super::monitor::Reading;
use super::{Effect, EffectError};
use crate::lattice::{Plane, Ring};
use crate::map::{X, Y};
use crate::orbit::{ClosedOrbit, Hold, OrbitError};
use crate::response::{Gradient, Optics};
use crate::site::Site;
use crate::tune::Tunes;

/// A ring with effects applied.
#[derive(Debug, Clone)]
pub struct Machine {
    pub(super) ring: Ring,
    /// What it holds constant.
    pub(super) hold: Holding,
    /// Effects of monitors, in the order given.
    pub(super) monitors: Vec<Reading>,
    /// Effects of correctors, in the order given.
    pub(super) correctors: Vec<Kick>,
    /// Fields beyond the ring's that are no gradients.
    pub(super) curved: Vec<Curved>,
    /// Relative change of all quadrupoles from mid-campaign to its end.
    pub(super) drift: f64,
}

/// Response of x and y at every monitor to every corrector, and the linear optics of a machine.
#[derive(Debug, Clone)]
pub struct MachineResponse {
    /// x at the monitors to the correctors [m/rad].
    pub x: DMatrix<f64>,
    /// y at the monitors to the correctors [m/rad].
    pub y: DMatrix<f64>,
    /// Dispersion at the monitors [m].
    pub dispersion: Vec<f64>,
    /// Tunes.
    pub tunes: Tunes,
    /// Transition energy over the rest energy.
    pub gamma_transition: f64,
}

impl Machine {
    /// Apply effects to a ring whose momentum (on average) is the reference's, and what it holds while its correctors kick.
    ///
    /// # Errors
    /// [`EffectError::Place`] if a site is none where its kind can act.
    pub fn new(ring: Ring, hold: impl Into<Holding>, effects: &[Effect]) -> Result<Self, EffectError> {
        let mut machine = Self {
            ring,
            hold: hold.into(),
            monitors: Vec::new(),
            correctors: Vec::new(),
            curved: Vec::new(),
            drift: 0.0,
        };
        effects.iter().try_for_each(|effect| machine.add(effect.kind.mechanism(), effect.site, effect.amplitude))?;
        Ok(machine)
    }

    /// One more effect.
    ///
    /// # Errors
    /// [`EffectError::Place`] if the site is none where it can act.
    pub fn add<M: Mechanism + ?Sized>(&mut self, mechanism: &M, site: Site, amplitude: f64) -> Result<(), EffectError> {
        mechanism.apply(self, site, amplitude)
    }

    /// The ring, with the effects that sit in it.
    pub fn ring(&self) -> &Ring {
        &self.ring
    }

    /// The same, for a [`Mechanism`] that changes elements.
    pub fn ring_mut(&mut self) -> &mut Ring {
        &mut self.ring
    }

    /// The orbit (x, y) without kicks at the entrance of every element [m].
    ///
    /// # Errors
    /// [`OrbitError`] if there is none.
    pub fn orbit(&self) -> Result<Vec<[f64; 2]>, OrbitError> {
        let orbit = ClosedOrbit::find(&self.ring, Hold::Momentum { delta: self.hold.delta })?;
        Ok(orbit.at[..self.ring.elements.len()].iter().map(|at| [at[X], at[Y]]).collect())
    }

    /// Optics at the momentum that the machine has.
    ///
    /// # Errors
    /// [`OrbitError`] if there is no closed orbit.
    pub fn optics(&self) -> Result<Optics<'_>, OrbitError> {
        Optics::of(&self.ring, Hold::Momentum { delta: self.hold.delta })
    }

    /// Relative change of all gradients from mid-campaign to its end.
    pub fn drift(&self) -> f64 {
        self.drift
    }

    /// What it holds.
    pub fn holding(&self) -> Holding {
        self.hold
    }

    /// The same machine with a factor on the gradient of each quadrupole `[M]`.
    ///
    /// # Panics
    /// If there is not one factor for each quadrupole.
    pub fn with_strengths(&self, factors: &[f64]) -> Self {
        Self { ring: self.ring.with_strengths(factors), ..self.clone() }
    }

    /// The same machine without what remembers the frames before: for drives that do not follow each other in time.
    #[must_use]
    pub fn without_memory(&self) -> Self {
        let mut machine = self.clone();
        machine.monitors.retain(|reading| !reading.remembers());
        machine.correctors.retain(|kick| !kick.remembers());
        machine
    }

    /// Orbit response as it would be measured, rows all monitors (H then V), columns correctors (H then V); a rolled monitor that reads
    /// both planes, or a rolled corrector that kicks in both, is so in both.
    ///
    /// # Errors
    /// [`OrbitError`] if the machine is unstable.
    pub fn response(&self) -> Result<MachineResponse, OrbitError> {
        let optics = self.optics()?;
        let (held, sources) = (self.held_of(&self.ring, &optics)?, optics.correctors());
        let of = |plane: Plane| held.response(&optics, &optics.monitor_places(plane), &sources);
        let mut response = [Plane::X, Plane::Y].map(of);
        self.measure(&optics, &mut response);
        let dispersion = optics.monitor_places(Plane::X).iter().map(|o| optics.dispersion(o)).collect();
        let [x, y] = response;
        Ok(MachineResponse { x, y, dispersion, tunes: optics.tunes()?, gamma_transition: optics.gamma_transition() })
    }

    /// Derivative of the response, x and y as [`Machine::response`] has them, with respect to the gradient of each quadrupole `[M]`
    /// [m/rad per 1/m^2]; of a monitor that is not linear, without what the gradient does to the orbit that it reads.
    ///
    /// # Errors
    /// As [`Machine::response`].
    pub fn response_jacobian(&self) -> Result<Vec<[DMatrix<f64>; 2]>, OrbitError> {
        let optics = self.optics()?;
        let held = self.held_of(&self.ring, &optics)?;
        let places = [Plane::X, Plane::Y].map(|plane| optics.monitor_places(plane));
        let sources = optics.correctors();
        let slope = |gradient: &Gradient| {
            let mut slope = places.each_ref().map(|places| held.jacobian(&optics, places, &sources, gradient));
            self.measure(&optics, &mut slope);
            slope
        };
        Ok(optics.quadrupoles().iter().map(slope).collect())
    }

    /// What monitors and correctors make of a response of x and y at all monitors to all correctors.
    fn measure(&self, optics: &Optics, response: &mut [DMatrix<f64>; 2]) {
        // the last effect is next to the beam
        self.correctors.iter().rev().for_each(|kick| kick.of_response(response));
        let orbit = |monitor: &crate::Monitor| [X, Y].map(|at| optics.orbit(monitor.element)[at]);
        let mut base: Vec<[f64; 2]> = self.ring.monitors.iter().map(orbit).collect();
        self.monitors.iter().for_each(|reading| reading.of_response(&self.ring, &mut base, response));
    }

    /// Linear responses of a ring with what this machine holds constant, given the ring's optics at constant momentum.
    ///
    /// # Errors
    /// [`OrbitError`] if the ring does not close at the frequency that is held.
    pub fn held_of<'r>(&self, ring: &'r Ring, optics: &Optics) -> Result<Held<'r>, OrbitError> {
        Held::of(ring, optics, self.hold)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::effects::Rf;

    fn respond(effects: &[&str]) -> MachineResponse {
        respond_on(Ring::booster(), effects)
    }

    fn respond_on(ring: Ring, effects: &[&str]) -> MachineResponse {
        let effects: Vec<Effect> = effects.iter().map(|text| Effect::parse(text, &ring).unwrap()).collect();
        Machine::new(ring, Rf::FixedMomentum, &effects).unwrap().response().unwrap()
    }

    #[test]
    fn instruments_act_on_their_rows_and_columns() {
        let plain = respond(&[]);
        let e4 = Ring::booster().monitor(Plane::X, "E4").unwrap();
        assert!((respond(&["bpm_gain@x_E4=0.1"]).x.row(e4) - plain.x.row(e4) * 1.1).abs().max() < 1e-12);
        assert!((respond(&["corrector_polarity@H_A2"]).x.column(0) + plain.x.column(0)).abs().max() < 1e-12);
        let exchanged = respond(&["corrector_swap@H_A2,H_A6"]);
        let scaled = respond(&["corrector_gain@H_A2=0.1", "corrector_swap@H_A2,H_A6"]);
        assert!((scaled.x.column(0) - plain.x.column(2) * 1.1).abs().max() < 1e-12);
        assert_eq!([0, 1, 2].map(|c| exchanged.x.column(c)), [2, 1, 0].map(|c| plain.x.column(c)));
        // x_read = x cos + y sin: a pure y orbit shows in x by the sine of the roll
        let rolled = respond(&["bpm_roll@x_E4=0.1"]);
        assert!((rolled.x.row(e4)[30] - plain.y.row(e4)[30] * 0.1_f64.sin()).abs() < 1e-12);
        // an H corrector rolled by 90 degrees kicks (0, 1)
        let turned = respond(&["corrector_roll@H_A2=1.5707963267948966"]);
        assert!(turned.x.column(0).abs().max() < 1e-9 && turned.y.column(0).abs().max() > 1.0);
    }

    #[test]
    fn what_leaks_adds_to_its_row_or_column() {
        let (ring, plain) = (Ring::booster(), respond(&[]));
        let [e4, e6] = ["E4", "E6"].map(|label| ring.monitor(Plane::X, label).unwrap());
        let mixed = respond(&["bpm_crosstalk@x_E4=0.1"]);
        assert!((mixed.x.row(e4) - plain.x.row(e4) - plain.x.row(e6) * 0.1).abs().max() < 1e-12);
        let shared = respond(&["corrector_crosstalk@H_A2=0.1"]);
        assert!((shared.x.column(0) - plain.x.column(0) - plain.x.column(1) * 0.1).abs().max() < 1e-12);
    }

    #[test]
    fn the_jacobian_is_that_of_the_response_with_its_effects() {
        let effects =
            ["bpm_gain@x_E4=0.1", "bpm_roll@y_C5=0.05", "corrector_roll@H_A2=0.2", "corrector_swap@H_A2,H_A6"];
        for rf in [Rf::FixedMomentum, Rf::FixedFrequency] {
            let machine = |ring: Ring| {
                let effects: Vec<Effect> = effects.iter().map(|text| Effect::parse(text, &ring).unwrap()).collect();
                Machine::new(ring, rf, &effects).unwrap()
            };
            let ring = Ring::booster();
            let jacobian = machine(ring.clone()).response_jacobian().unwrap();
            for (q, (k1, slope)) in ring.gradients().iter().zip(&jacobian).enumerate().step_by(11) {
                let respond = |change: f64| {
                    let mut factors = vec![1.0; ring.quadrupoles.len()];
                    factors[q] += change;
                    machine(ring.with_strengths(&factors)).response().unwrap()
                };
                let (more, less) = (respond(1e-4), respond(-1e-4));
                let numeric = [(more.x - less.x) / (2e-4 * k1), (more.y - less.y) / (2e-4 * k1)];
                for (exact, numeric) in slope.iter().zip(&numeric) {
                    let error = (exact - numeric).abs().max() / exact.abs().max();
                    assert!(error < 1e-5, "quadrupole {q}: {error:e}"); // truncation: (1e-4)^2 times the resonance denominator
                }
            }
        }
    }

    #[test]
    fn a_held_frequency_stays_with_the_momentum_offset() {
        let both = respond(&["momentum_offset=0.003", "fixed_rf_frequency"]);
        let (offset, held) = (respond(&["momentum_offset=0.003"]), respond(&["fixed_rf_frequency"]));
        assert!((&both.x - &offset.x).abs().max() > 0.01 && (&both.x - &held.x).abs().max() > 0.01);
        assert!(
            (&both.y - &offset.y).abs().max() < 1e-9,
            "no vertical dispersion, so the frequency does not matter in y"
        );
        let ring = Ring::booster();
        let offset = Effect::parse("momentum_offset=0.003", &ring).unwrap();
        let far = Machine::new(ring, Rf::FixedFrequency, &[offset]).unwrap();
        assert_eq!(far.response().unwrap().x, both.x);
    }

    #[test]
    fn a_full_radial_loop_holds_the_mean_of_its_pair() {
        let held = respond(&["radial_loop@x_D8,x_E6"]);
        let of = |label: &str| Ring::booster().monitor(Plane::X, label).unwrap();
        let mean = held.x.row(of("D8")) + held.x.row(of("E6"));
        assert!(mean.abs().max() < 1e-9);
    }
}
