//! What a machine holds while its correctors kick, if it is not the design momentum: another one, the RF frequency, or the mean
//! orbit of two monitors.
//!
//! With `R` the response at constant momentum, `R_f` that at constant frequency and `D` the dispersion, a share `a` of the
//! frequency held gives `R + a (R_f - R)`, and a share `a` of the mean of monitors i and j held gives
//!
//! `R - D m`, `m = a (R_i + R_j)/(D_i + D_j)` the momentum that brings the mean back.
//!
//! A step of the RF frequency moves the orbit by `-D/eta`; one that is larger than recorded by a share `a` by `1 + a` of that. A loop also takes back its share of it: `1 - a` is left. A loop that the
//! operators have on they open for such a step, since they could not measure the dispersion otherwise.
//!
//! Exact orbits close at the share of the way to the momentum that exactly holds the frequency, or the mean of the pair; the derivative is a difference of two machines.

use nalgebra::{DMatrix, DVector};

use super::mechanism::{Measured, Mechanism, Unit};
use super::{EffectError, EffectKind, Machine};
use crate::lattice::{Plane, Ring};
use crate::map::{DELTA, X};
use crate::orbit::{ClosedOrbit, Hold, OrbitError};
use crate::response::{Gradient, Observer, Optics, Source};
use crate::site::Site;

/// What is held instead of the design momentum.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum HoldEffect {
    /// The beam is off momentum.
    Momentum,
    /// The RF frequency is held instead of the momentum, as a fraction.
    Frequency,
    /// The mean of two horizontal monitors is held instead of the momentum, as a fraction.
    RadialLoop,
    /// Steps of the RF frequency are larger than recorded by a fraction: -1 if none is made, -2 if their sign is wrong.
    Steps,
}

/// What the RF system holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rf {
    /// The momentum.
    FixedMomentum,
    /// The frequency; the momentum follows the path length.
    FixedFrequency,
}

/// What a machine holds.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Holding {
    /// Momentum of the beam on average.
    pub(super) delta: f64,
    /// Share of the response at fixed RF frequency.
    frequency_share: f64,
    radial_loop: Option<RadialLoop>,
    /// Fraction by which steps of the RF frequency are larger than recorded.
    more_of_steps: f64,
}

/// A loop that holds the mean of two monitors.
#[derive(Debug, Clone, Copy, PartialEq)]
struct RadialLoop {
    pair: [usize; 2],
    /// Share of what kicks do to the mean that it takes back.
    of_kicks: f64,
    /// The same of what a step of the RF frequency does.
    of_rf_steps: f64,
}

impl From<Rf> for Holding {
    fn from(rf: Rf) -> Self {
        Self { frequency_share: if rf == Rf::FixedFrequency { 1.0 } else { 0.0 }, ..Self::default() }
    }
}

impl Holding {
    /// The mean of two horizontal monitors, by a loop that is open while the RF frequency is stepped.
    ///
    /// # Errors
    /// [`EffectError::Place`] if the site is no such pair.
    pub fn radial_loop(ring: &Ring, site: Site) -> Result<Self, EffectError> {
        let pair = pair_of(ring, site)?;
        Ok(Self { radial_loop: Some(RadialLoop { pair, of_kicks: 1.0, of_rf_steps: 0.0 }), ..Self::default() })
    }

    /// Kind of the effect that it would be if nobody knew of it; none where the momentum is held.
    pub fn kind(&self) -> Option<EffectKind> {
        let frequency = (self.frequency_share != 0.0).then_some(EffectKind::FixedRfFrequency);
        frequency.or(self.radial_loop.map(|_| EffectKind::RadialLoop))
    }

    /// Share of a step of the RF frequency that reaches the beam.
    fn share_of_rf_steps(&self) -> f64 {
        (1.0 + self.more_of_steps) * (1.0 - self.radial_loop.map_or(0.0, |one| one.of_rf_steps))
    }
}

impl Mechanism for HoldEffect {
    fn word(&self) -> &'static str {
        match self {
            Self::Momentum => "momentum_offset",
            Self::Frequency => "fixed_rf_frequency",
            Self::RadialLoop => "radial_loop",
            Self::Steps => "rf_step",
        }
    }

    /// A radial position is known to some mm at a dispersion of 2 m. A loop holds all of its error, or with a gain of 1 to 10 a share of
    /// 0.5 to 0.9: as a normal of width 0.5 these are one to two standard deviations. Steps are typed in, or read off a meter, to some per cent.
    fn prior_scale(&self) -> Option<f64> {
        match self {
            Self::Momentum => Some(3e-3),
            Self::Frequency | Self::RadialLoop => Some(0.5),
            Self::Steps => Some(0.1),
        }
    }

    fn unit(&self) -> Unit {
        match self {
            Self::Momentum => Unit::PER_MILLE,
            Self::Frequency | Self::RadialLoop | Self::Steps => Unit::PERCENT,
        }
    }

    /// A radial loop holds monitors that only the recording's header knows.
    fn sites(&self, _ring: &Ring) -> Vec<Site> {
        match self {
            Self::Momentum | Self::Frequency | Self::Steps => vec![Site::Ring],
            Self::RadialLoop => Vec::new(),
        }
    }

    fn expected(&self) -> &'static str {
        match self {
            Self::Momentum | Self::Frequency | Self::Steps => "no place",
            Self::RadialLoop => "two horizontal monitors",
        }
    }

    fn site(&self, ring: &Ring, name: &str) -> Option<Site> {
        match self {
            Self::Momentum | Self::Frequency | Self::Steps => name.is_empty().then_some(Site::Ring),
            Self::RadialLoop => {
                let [one, other] = Site::monitors(ring, name)?;
                is_horizontal(ring, [one, other]).then(|| Site::pair(one, other))
            }
        }
    }

    fn apply(&self, machine: &mut Machine, site: Site, amplitude: f64) -> Result<(), EffectError> {
        let (ring, hold) = (&machine.ring, &mut machine.hold);
        match (self, site) {
            (Self::Momentum, Site::Ring) => hold.delta += amplitude,
            (Self::Frequency, Site::Ring) => hold.frequency_share += amplitude,
            (Self::Steps, Site::Ring) => hold.more_of_steps += amplitude,
            (Self::RadialLoop, _) => {
                let pair = pair_of(ring, site)?;
                let known = hold.radial_loop.filter(|one| one.pair == pair);
                let mut one = known.unwrap_or(RadialLoop { pair, of_kicks: 0.0, of_rf_steps: 0.0 });
                (one.of_kicks, one.of_rf_steps) = (one.of_kicks + amplitude, one.of_rf_steps + amplitude);
                hold.radial_loop = Some(one);
            }
            _ => return Err(self.misplaced(ring, site.name(ring))),
        }
        Ok(())
    }

    fn phrase(&self, ring: &Ring, site: Site, amplitude: Measured) -> String {
        match self {
            Self::Momentum => format!("the beam is off momentum by {} per mille", amplitude.signed(1e3)),
            Self::Frequency => {
                format!("the RF frequency was held instead of the momentum, by {} %", amplitude.signed(100.0))
            }
            Self::RadialLoop => {
                let pair = site.names(ring).join(" and ");
                format!(
                    "a radial loop held the mean of {pair} instead of the momentum, by {} %",
                    amplitude.signed(100.0)
                )
            }
            Self::Steps => {
                let whole = Measured { value: 1.0 + amplitude.value, ..amplitude };
                format!("the RF frequency was stepped by {} times what is recorded", whole.signed(1.0))
            }
        }
    }
}

/// The two monitors of a radial loop.
fn pair_of(ring: &Ring, site: Site) -> Result<[usize; 2], EffectError> {
    match site {
        Site::MonitorPair(one, other) if is_horizontal(ring, [one, other]) => Ok([one, other]),
        _ => Err(HoldEffect::RadialLoop.misplaced(ring, site.name(ring))),
    }
}

fn is_horizontal(ring: &Ring, pair: [usize; 2]) -> bool {
    pair.iter().all(|&at| ring.monitors[at].plane == Plane::X)
}

/// Linear responses of a ring that holds something.
#[derive(Debug)]
pub struct Held<'r> {
    /// Optics at constant frequency, and the share of it.
    frequency: Option<(Optics<'r>, f64)>,
    /// The two monitors, and the share of the loop.
    radial: Option<([Observer; 2], f64)>,
    /// Share of a step of the RF frequency that reaches the beam.
    of_rf_steps: f64,
}

impl<'r> Held<'r> {
    /// On a ring of these optics at constant momentum.
    pub(super) fn of(ring: &'r Ring, optics: &Optics, holding: Holding) -> Result<Self, OrbitError> {
        let share = holding.frequency_share;
        let offset = optics.frequency_offset();
        let held = || Ok((Optics::of(ring, Hold::Frequency { offset })?, share));
        let frequency = (share != 0.0).then(held).transpose()?;
        let observer = |at: usize| optics.observe(ring.monitors[at].element, Plane::X);
        let radial = holding.radial_loop.map(|one| (one.pair.map(observer), one.of_kicks));
        Ok(Self { frequency, radial, of_rf_steps: holding.share_of_rf_steps() })
    }

    /// What observers see of a relative step of the RF frequency [m].
    pub fn rf_response(&self, optics: &Optics, observers: &[Observer]) -> DVector<f64> {
        optics.dispersion_of(observers) * (-self.of_rf_steps / optics.slip_factor())
    }

    /// Its derivative with respect to a gradient.
    pub fn rf_jacobian(&self, optics: &Optics, observers: &[Observer], gradient: &Gradient) -> DVector<f64> {
        let whole = optics.rf_jacobian(observers, core::slice::from_ref(gradient)).column(0).into_owned();
        whole * self.of_rf_steps
    }

    /// Orbit response, rows observers, columns sources [m/rad].
    pub fn response(&self, optics: &Optics, observers: &[Observer], sources: &[Source]) -> DMatrix<f64> {
        let mut response = self.by_frequency(optics, |optics| optics.response(observers, sources));
        if let Some((pair, share)) = &self.radial {
            let of_pair = self.by_frequency(optics, |optics| optics.response(pair, sources)).row_sum();
            let momentum = of_pair * (share / optics.dispersion_of(pair).sum());
            response -= optics.dispersion_of(observers) * momentum;
        }
        response
    }

    /// Its derivative with respect to a gradient [m/rad per 1/m^2, or per 1/m of a thin one].
    pub fn jacobian(
        &self,
        optics: &Optics,
        observers: &[Observer],
        sources: &[Source],
        gradient: &Gradient,
    ) -> DMatrix<f64> {
        let gradients = core::slice::from_ref(gradient);
        let slope = |observers: &[Observer]| {
            self.by_frequency(optics, |optics| optics.response_jacobian(observers, sources, gradients).remove(0))
        };
        let mut change = slope(observers);
        if let Some((pair, share)) = &self.radial {
            let dispersion = optics.dispersion_of(pair).sum();
            let dispersion_slope = optics.dispersion_jacobian(pair, gradients).sum();
            let momentum = self.by_frequency(optics, |optics| optics.response(pair, sources)).row_sum() / dispersion;
            let momentum_slope = (slope(pair).row_sum() - &momentum * dispersion_slope) / dispersion;
            change -= optics.dispersion_jacobian(observers, gradients) * momentum * *share;
            change -= optics.dispersion_of(observers) * momentum_slope * *share;
        }
        change
    }

    fn by_frequency(&self, optics: &Optics, of: impl Fn(&Optics) -> DMatrix<f64>) -> DMatrix<f64> {
        let at_momentum = of(optics);
        match &self.frequency {
            Some((held, share)) => at_momentum * (1.0 - share) + of(held) * *share,
            None => at_momentum,
        }
    }
}

/// Exact closed orbits of a ring that holds something.
#[derive(Debug, Clone)]
pub(super) struct Closing {
    holding: Holding,
    /// The orbit without kicks, from which that of a cycle is sought.
    plain: ClosedOrbit,
    /// Relative frequency at which the ring closes without kicks.
    frequency: f64,
    /// Mean of the pair of a radial loop without kicks [m], and its dispersion [m].
    radial: [f64; 2],
}

impl Closing {
    /// About the orbit without kicks.
    pub fn of(ring: &Ring, holding: Holding) -> Result<Self, OrbitError> {
        let optics = Optics::of(ring, Hold::Momentum { delta: holding.delta })?;
        let radial = holding.radial_loop.map_or([0.0, 1.0], |RadialLoop { pair, .. }| {
            let dispersion = pair.map(|at| optics.dispersion(&optics.observe(ring.monitors[at].element, Plane::X)));
            [mean(ring, pair, optics.closed_orbit()), 0.5 * (dispersion[0] + dispersion[1])]
        });
        Ok(Self { holding, plain: optics.closed_orbit().clone(), frequency: optics.frequency_offset(), radial })
    }

    /// The orbit on which the beam runs in a ring that kicks have changed; a step of the RF frequency sets the momentum, of which a loop takes
    /// back its share.
    pub fn orbit(&self, ring: &Ring, rf_offset: f64) -> Result<ClosedOrbit, OrbitError> {
        let Holding { delta, frequency_share, radial_loop, more_of_steps } = self.holding;
        let at = |hold: Hold| ClosedOrbit::near(ring, hold, &self.plain);
        let at_frequency = |offset: f64| at(Hold::Frequency { offset: self.frequency + offset });
        let at_momentum = |delta: f64| at(Hold::Momentum { delta });
        let orbit = if rf_offset != 0.0 {
            at_frequency((1.0 + more_of_steps) * rf_offset)?
        } else if frequency_share != 0.0 {
            let full = at_frequency(0.0)?.at[0][DELTA];
            at_momentum(delta + frequency_share * (full - delta))?
        } else {
            at_momentum(delta)?
        };
        let Some(one) = radial_loop else { return Ok(orbit) };
        let share = if rf_offset == 0.0 { one.of_kicks } else { one.of_rf_steps };
        if share == 0.0 {
            return Ok(orbit);
        }
        let free = orbit.at[0][DELTA];
        at_momentum(free + share * (self.by_loop(ring, one.pair, orbit)? - free))
    }

    /// Momentum at which the mean of a pair is that without kicks, from the orbit at another momentum: secant steps, the first along the dispersion.
    fn by_loop(&self, ring: &Ring, pair: [usize; 2], mut orbit: ClosedOrbit) -> Result<f64, OrbitError> {
        let [held, mut slope] = self.radial;
        let mut miss = mean(ring, pair, &orbit) - held;
        let settled = ROUNDING + HELD * miss.abs();
        for _ in 0..STEPS {
            if miss.abs() <= settled {
                return Ok(orbit.at[0][DELTA]);
            }
            let delta = orbit.at[0][DELTA] - miss / slope;
            let next = ClosedOrbit::near(ring, Hold::Momentum { delta }, &orbit)?;
            let next_miss = mean(ring, pair, &next) - held;
            slope = (next_miss - miss) / (delta - orbit.at[0][DELTA]);
            (orbit, miss) = (next, next_miss);
        }
        Err(OrbitError::NotConverged { residual: miss, steps: STEPS })
    }
}

/// Share of what kicks do to the mean at which a loop has settled: a micrometre of a centimetre. Steps until then at most: three where kicks move the
/// orbit by millimetres.
const HELD: f64 = 1e-4;
/// The same where kicks do nothing to it [m].
const ROUNDING: f64 = 1e-9;
const STEPS: usize = 8;

/// Mean horizontal orbit of two monitors.
fn mean(ring: &Ring, pair: [usize; 2], orbit: &ClosedOrbit) -> f64 {
    0.5 * pair.map(|at| orbit.at[ring.monitors[at].element][X]).iter().sum::<f64>()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::effects::{Cycle, Effect, Tracked};

    const PAIR: &str = "radial_loop@x_D8,x_E6";

    fn effect(text: &str) -> Effect {
        Effect::parse(text, &Ring::booster()).unwrap()
    }

    /// Mean of the pair in exact orbits, for a strong kick or a step of the RF frequency [m].
    fn mean_of_pair(holding: impl Into<Holding>, effects: &[Effect], kick: f64, rf_offset: f64) -> f64 {
        let ring = Ring::booster();
        let pair = pair_of(&ring, effect(PAIR).site).unwrap();
        let reads = pair.map(|at| ring.read_monitors.iter().position(|&read| read == at).unwrap());
        let (mut kicks, strength) = (vec![0.0; ring.correctors.len()], vec![0.0; ring.quadrupoles.len()]);
        kicks[16] = kick;
        let machine = Machine::new(ring, holding, effects).unwrap();
        let cycle = Cycle { kick: kicks, strength, rf_offset, time: 0.0 };
        let readings = Tracked::of(machine, 2e-4).unwrap().readings(&cycle).unwrap();
        0.5 * reads.map(|b| readings[b]).iter().sum::<f64>()
    }

    #[test]
    fn a_full_loop_holds_the_mean_of_exact_orbits() {
        let free = mean_of_pair(Rf::FixedMomentum, &[], 1e-3, 0.0);
        let held = mean_of_pair(Rf::FixedMomentum, &[effect(PAIR)], 1e-3, 0.0);
        // one step along the dispersion alone leaves its second order
        assert!(free.abs() > 5e-3 && held.abs() < HELD * free.abs(), "{free:e} {held:e}");
    }

    #[test]
    fn a_step_that_is_not_made_moves_nothing_and_one_of_the_wrong_sign_moves_back() {
        let at = |more: f64| {
            let effect = Effect { amplitude: more, ..effect("rf_step") };
            mean_of_pair(Rf::FixedMomentum, &[effect], 0.0, 2e-4)
        };
        assert!(at(-1.0).abs() < ROUNDING && (at(1.0) / at(0.0) - 2.0).abs() < 0.02, "second order of the momentum");
        assert!((at(-2.0) / at(0.0) + 1.0).abs() < 0.02, "second order of the momentum");
    }

    #[test]
    fn an_unknown_loop_takes_back_its_share_of_a_frequency_step() {
        let (ring, step) = (Ring::booster(), 2e-4);
        let free = mean_of_pair(Rf::FixedMomentum, &[], 0.0, step);
        let most = mean_of_pair(Rf::FixedMomentum, &[Effect { amplitude: 0.8, ..effect(PAIR) }], 0.0, step);
        // second order of a momentum of 2e-3
        assert!((most / free - 0.2).abs() < 0.02, "{most:e} of {free:e}");
        let known = Holding::radial_loop(&ring, effect(PAIR).site).unwrap();
        assert_eq!(mean_of_pair(known, &[], 0.0, step), free, "it is opened for the step");
        assert!(mean_of_pair(known, &[], 1e-3, 0.0).abs() < 1e-6);
        // without a kick there is nothing to hold
        assert_eq!(mean_of_pair(known, &[], 0.0, 0.0), mean_of_pair(Rf::FixedMomentum, &[], 0.0, 0.0));
        assert!(Holding::radial_loop(&ring, Site::Ring).is_err());
    }
}
