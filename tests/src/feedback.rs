//! The loop closed in software: a machine, its frames as bytes, the core, the setpoints, the machine again; and beside the core, if it
//! is wanted, the same core on the emulated chip.

mod chip;
mod known;
mod plant;
mod scenario;

use core::error::Error;

use estimator::booster::{CORRECTORS, Estimate, Estimator, Feedback, Frame, MONITORS, PARAMS, Setpoints, Steer};
use estimator::wire::link::{Correction, Short};
use estimator::{
    Core as _, CurrentCode, Each, IngestError, IntensityCode, MagnetCurrents, Mask, Model, PositionCode, Prepared,
    RfCode, Steered,
};
use inference::simulate;
use twin::Ring;

use crate::machine::{ALL, Random, amperes, nees, wire_of};

pub use chip::{Chip, REGIONS, on_wire};
pub use known::Known;
pub use plant::{Orbit, Plant};
pub use scenario::{Event, Scenario};

/// Where the setpoints come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Control {
    /// The response at the estimated vars, and its covariance.
    Estimated,
    /// The response of the design, taken as exact.
    Design,
    /// Correctors stay at 0.
    Off,
}

/// Time between cycles [us].
const CYCLE_US: u64 = 200_000;
/// Scatter of the correctors' currents [A].
const RIPPLE: f64 = 0.02;
/// Relative scatter of the main supplies.
const SUPPLY_RIPPLE: f64 = 2e-4;
/// Scatter of the momentum.
const JITTER: f64 = 2e-5;

/// What is kept of a frame.
#[derive(Debug, Clone, Copy)]
pub struct Sample {
    /// Rms over all monitors of the true orbit less the wanted one and less any momentum's [m].
    pub rms: f64,
    /// What the feedback said; nothing while there is none.
    pub steered: Option<Steered>,
    /// Normalised estimation error squared over the number of params.
    pub nees: f64,
    /// Mean standard deviation of the vars.
    pub sigma: f64,
    /// Largest current of a corrector [A].
    pub largest: f64,
}

/// What becomes of a frame.
struct Answer {
    estimate: Estimate,
    steered: Option<Steered>,
    /// What a device says that steers.
    short: Option<Short<Setpoints>>,
}

/// How far the orbit is expected to walk in the root of a second [m]: what the core expects of the baselines.
pub const WALK: f32 = known::WALK.baselines;

/// What is recommended for the Booster; the wanted orbit is zero.
pub fn recommended() -> Feedback {
    Feedback {
        orbit: Each::same(0.0),
        walk: WALK,
        step_kick: 2e-5,
        total_kick: 1e-3,
        limit: Each::same(20.0),
        rate: 2.0,
        probe: 1.0,
        close: 0.3,
        patience_us: 10 * CYCLE_US,
    }
}

/// A closed loop.
#[derive(Debug)]
pub struct Loop<'k> {
    known: &'k Known,
    feedback: Feedback,
    control: Control,
    /// The machine.
    pub plant: Plant,
    core: Box<Estimator>,
    steer: Box<Steer>,
    scenario: Scenario,
    /// Disturbances, and the noise of the readings: the same whoever controls.
    random: [Random; 2],
    frame: u32,
    sequence: u32,
    /// The last frame as bytes.
    pub wire: Vec<u8>,
    /// What the supplies give [A].
    current: [f64; CORRECTORS],
    /// The chip that hears the same frames: the core does as much between them as that has done.
    pub chip: Option<Chip<'k>>,
}

impl<'k> Loop<'k> {
    /// A loop about to begin.
    ///
    /// # Errors
    /// If the machine has no orbit.
    pub fn new(
        known: &'k Known,
        mut feedback: Feedback,
        control: Control,
        scenario: Scenario,
    ) -> Result<Self, Box<dyn Error>> {
        let vars = simulate::vars(&Ring::booster(), true, scenario.seed)?;
        let mut random = [Random::new(scenario.seed), Random::new(scenario.noise)];
        let plant = Plant::new(&vars, &mut random[0])?;
        feedback.orbit.own = plant.offset.iter().map(|offset| *offset as f32).collect();
        let mut core = Box::new(Estimator::BLANK);
        core.restart(&Model { surrogate: &*known.surrogate, setup: &known.setup })
            .map_err(|_| "the design has no stable ring")?;
        let steer = Box::new(Steer::BLANK);
        Ok(Self {
            known,
            feedback,
            control,
            plant,
            core,
            steer,
            scenario,
            random,
            frame: 0,
            sequence: 0,
            wire: Vec::new(),
            current: [0.0; CORRECTORS],
            chip: None,
        })
    }

    /// What is wanted of the orbit.
    pub fn feedback(&self) -> &Feedback {
        &self.feedback
    }

    /// Currents that the correctors are to have.
    pub fn setpoints(&self) -> &[CurrentCode; CORRECTORS] {
        self.steer.setpoints()
    }

    /// One cycle.
    ///
    /// # Errors
    /// If the machine loses its orbit, the core refuses the frame, or the chip does not answer.
    pub fn cycle(&mut self) -> Result<Sample, Box<dyn Error>> {
        self.scenario.disturb(self.frame, &mut self.plant, &mut self.random[0])?;
        let lost = self.scenario.gap(self.frame);
        self.sequence += 1 + lost;
        self.supply();
        let (frame, rms) = self.read()?;
        self.wire = wire_of(&frame);
        let steers = self.steers().then_some(&self.feedback);
        let said = self.chip.as_mut().map(|chip| chip.hear(steers, self.sequence, &self.wire)).transpose()?;
        let (slices, prepared) = said.as_ref().map_or((u32::MAX, true), |said| (said.slices(), said.prepared()));
        self.prepare(slices, prepared);
        let Answer { estimate, steered, short } = self.ingest(prepared)?;
        if let (Some(chip), Some(said)) = (&mut self.chip, &said) {
            chip.compare(said, &self.core, &estimate, short.as_ref());
        }
        self.frame += 1;
        let error = core::array::from_fn(|i| f64::from(estimate.map_params[i]) - self.plant.params[i]);
        Ok(Sample {
            rms,
            steered,
            nees: nees(&error, |i, j| self.core.covariance(i, j)) / PARAMS as f64,
            sigma: estimate.sigma.iter().map(|s| f64::from(*s)).sum::<f64>() / PARAMS as f64,
            largest: self.current.iter().fold(0.0, |m, c| c.abs().max(m)),
        })
    }

    /// All cycles of the scenario that are left.
    ///
    /// # Errors
    /// As for one.
    pub fn run(&mut self) -> Result<Vec<Sample>, Box<dyn Error>> {
        (self.frame..self.scenario.frames).map(|_| self.cycle()).collect()
    }

    /// The supplies take their setpoints over, but for those that stick.
    fn supply(&mut self) {
        for (c, (current, setpoint)) in self.current.iter_mut().zip(self.steer.setpoints()).enumerate() {
            let ripple = RIPPLE * self.random[1].normal();
            if !self.scenario.sticks(self.frame, c) {
                let campaign = campaign_current(self.frame, c);
                let wanted = match self.control {
                    _ if self.frame < self.scenario.campaign => campaign,
                    Control::Off => 0.0,
                    _ => f64::from(setpoint.value()),
                };
                *current = wanted + ripple;
            }
        }
    }

    fn read(&mut self) -> Result<(Frame, f64), Box<dyn Error>> {
        let calibration = &self.known.setup.calibration;
        let [disturbance, noise] = &mut self.random;
        let mut scatter = |nominal: f32| amperes(f64::from(nominal) * (1.0 + SUPPLY_RIPPLE * disturbance.normal()));
        let supply = core::array::from_fn(|f| scatter(calibration.supplies[f].nominal));
        let dipole = scatter(calibration.dipole.unwrap_or(0.0));
        let mut frame = Frame {
            epoch: 0,
            sequence: self.sequence,
            time_us: CYCLE_US * u64::from(self.sequence),
            cycle_time_us: 92_000,
            corrector: self.current.map(amperes),
            magnets: MagnetCurrents { dipole, supply },
            rf_offset: RfCode::default(),
            reading: [PositionCode::default(); MONITORS],
            tune: [None; 2],
            intensity: None,
            valid: Mask::from_words(&ALL),
        };
        let drive = calibration.drive(&frame).map_err(|beyond| format!("{beyond:?}"))?;
        let (kick, strength) = (drive.kick.map(f64::from), drive.strength.map(f64::from));
        let delta = self.scenario.momentum(self.frame) + JITTER * disturbance.normal();
        let on_momentum = self.plant.orbit(&kick, &strength, 0.0)?;
        let orbit = self.plant.orbit(&kick, &strength, delta)?;
        let is_lost = self.scenario.is_lost(self.frame);
        for b in 0..MONITORS {
            let noise = f64::from(self.known.setup.noise.of(b)) * noise.normal();
            let position = if is_lost { 0.0 } else { orbit[b] + self.plant.offset[b] };
            frame.reading[b] = PositionCode::nearest(position + noise).unwrap_or_default();
            frame.valid.put(b, !self.scenario.is_silent(self.frame, b));
        }
        if self.scenario.counts {
            let particles = if is_lost { 0.0 } else { 1e12 * (1.0 + 0.03 * disturbance.normal()) };
            frame.intensity = IntensityCode::nearest(particles);
        }
        Ok((frame, residual(&on_momentum, &(orbit - on_momentum))))
    }

    fn steers(&self) -> bool {
        self.frame >= self.scenario.campaign && self.control != Control::Off
    }

    /// Bytes to setpoints, and to estimate; `prepared` tells whether the feedback's work was done before.
    fn ingest(&mut self, prepared: bool) -> Result<Answer, IngestError> {
        let model = Model { surrogate: &*self.known.surrogate, setup: &self.known.setup };
        let mut bytes = self.wire.clone();
        if self.steers() && self.control == Control::Estimated {
            let mut judged = self.core.judge_and_steer(&model, &self.feedback, &mut self.steer, &mut bytes)?;
            let (steered, setpoints) = (self.steer.steered(), self.steer.setpoints().iter().copied().collect());
            let short = self.core.corrected(&judged, Correction { steered, prepared, setpoints });
            self.core.learn(&model, &mut judged);
            // of a copy: what this frame has taught is said with the next one
            let estimate = self.core.clone().estimate(&model, &judged);
            return Ok(Answer { estimate, steered: Some(steered), short: Some(short) });
        }
        // a feedback aside: its surprise is what the other one would hold for, too
        let mut judged = self.core.judge_and_steer(&model, &self.feedback, &mut self.steer.clone(), &mut bytes)?;
        let of_design = |steer: &mut Steer| steer.steer(&self.feedback, &self.known.of_design(), &judged);
        let steered = self.steers().then(|| of_design(&mut self.steer));
        self.core.learn(&model, &mut judged);
        Ok(Answer { estimate: self.core.estimate(&model, &judged), steered, short: None })
    }

    /// What is done before a frame: so many slices of the core's work, as far as there are any, and the feedback's.
    fn prepare(&mut self, slices: u32, prepared: bool) {
        let model = Model { surrogate: &*self.known.surrogate, setup: &self.known.setup };
        let _ = (0..slices).take_while(|_| self.core.prepare(&model) != Prepared::Nothing).count();
        if self.steers() && prepared {
            let _ = match self.control {
                Control::Estimated => self.core.prepare_steer(&model, &self.feedback, &mut self.steer),
                _ => self.steer.prepare(&self.feedback, &self.known.of_design(), |_| [0.0; PARAMS]),
            };
        }
    }
}

/// Rms of an orbit less its part of the shape of another, that of the momentum [m]: what correctors are to make up for.
fn residual(orbit: &Orbit, momentum: &Orbit) -> f64 {
    let share = orbit.dot(momentum) / momentum.norm_squared();
    ((orbit - share * momentum).norm_squared() / MONITORS as f64).sqrt()
}

/// Each corrector in turn at 22 A and -22 A, and none [A].
fn campaign_current(frame: u32, corrector: usize) -> f64 {
    match (frame as usize % (2 * CORRECTORS + 1)).checked_sub(1) {
        Some(k) if k / 2 == corrector => 22.0 * if k % 2 == 0 { 1.0 } else { -1.0 },
        _ => 0.0,
    }
}

/// Rms over a stretch of frames [m].
pub fn rms(samples: &[Sample]) -> f64 {
    (samples.iter().map(|sample| sample.rms * sample.rms).sum::<f64>() / samples.len() as f64).sqrt()
}

/// The second half of a stretch: what was to be corrected is corrected.
pub fn settled(samples: &[Sample]) -> &[Sample] {
    &samples[samples.len() / 2..]
}

/// Frames of a stretch in which the setpoints stayed.
pub fn held(samples: &[Sample]) -> usize {
    samples.iter().filter(|sample| sample.steered.is_some_and(|steered| steered.hold.is_some())).count()
}
