//! A simulated machine as a control system shows it: set points in, the values of a cycle out, all by the channels of a plan.
//!
//! The readings are those of [`inference::simulate::Live`]: exact closed orbits of the twin, with misalignments, offsets, noise and jumps as
//! in the recordings that come with the project. Main supplies fluctuate as in those, too. A corrector follows its set point as
//! `I += (set - I)(1 - exp(-dt/tau))`, and fluctuates; its read-back is what it does.

mod control;
mod fault;

use std::collections::BTreeMap;

use inference::Recording;
use inference::recording::Row;
use inference::simulate::{Hardware, Live, Truth};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use serde::Serialize;
use twin::{Effect, EffectError, Ring};

pub use control::SimulatedControl;
pub use fault::{Fault, FaultError};

use crate::plan::Plan;

/// What is true of the simulated machine.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Factor of each param.
    pub vars: Vec<f64>,
    /// Effects of the library.
    pub effects: Vec<Effect>,
    /// What fails.
    pub faults: Vec<Fault>,
    /// Time constant of the correctors' supplies [s].
    pub settling: f64,
    /// Fixes all that is random.
    pub seed: u64,
}

/// One channel of the machine.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Record {
    /// Its name.
    pub name: String,
    /// What it is.
    pub kind: Kind,
    /// Unit of its numbers.
    pub unit: &'static str,
    /// Numbers that it holds.
    pub length: usize,
    /// What a set point is at, in the beginning.
    pub value: f64,
    /// What a set point takes.
    pub limits: Option<[f64; 2]>,
}

/// What a channel is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// A number that one may write.
    Set,
    /// A number.
    Value,
    /// The counter of cycles.
    Counter,
    /// One number for each monitor.
    Waveform,
}

/// Values of a cycle by channel; a channel that is not updated is not among them.
pub type Values = BTreeMap<String, Vec<Option<f64>>>;

/// A simulated machine.
pub struct SimulatedMachine {
    plan: Plan,
    live: Live,
    faults: Vec<Fault>,
    settling: f64,
    /// What the correctors do [A].
    current: Vec<f64>,
    cycle: u32,
    random: StdRng,
}

/// Fluctuation of the main supplies from cycle to cycle, relative, and of the correctors [A]: those of the recordings that come with the project.
const MAIN: f64 = 2e-4;
const CORRECTOR: f64 = 0.02;
/// RF frequency of the Booster at 1.56 GeV on its first harmonic [Hz]: `beta c / C`.
const RF: f64 = 1.3768e6;

impl SimulatedMachine {
    /// The machine that a plan measures.
    ///
    /// # Errors
    /// [`EffectError`] if an effect has no place in the ring, or if there is no closed orbit.
    pub fn try_new(plan: &Plan, ring: &Ring, settings: Settings) -> Result<Self, EffectError> {
        let template = template(plan);
        let hardware = Hardware::shipped(ring, &template);
        let truth = Truth { vars: &settings.vars, effects: &settings.effects, beyond: &[] };
        let live = Live::try_new(template, ring, &truth, hardware, settings.seed)?;
        let (faults, settling) = (settings.faults, settings.settling);
        let current = vec![0.0; plan.corrector_names.len()];
        // not the stream of the readings
        let random = StdRng::seed_from_u64(settings.seed.wrapping_add(1));
        Ok(Self { plan: plan.clone(), live, faults, settling, current, cycle: 0, random })
    }

    /// Every channel of the plan.
    pub fn records(&self) -> Vec<Record> {
        let channels = &self.plan.channels;
        let record = |name: &String, kind, unit, length| Record {
            name: name.clone(),
            kind,
            unit,
            length,
            value: 0.0,
            limits: None,
        };
        let set = |name: &String, unit, value, limits| Record {
            value,
            limits: Some(limits),
            ..record(name, Kind::Set, unit, 1)
        };
        let mut all = vec![record(&channels.cycle, Kind::Counter, "", 1)];
        all.extend(channels.monitors.iter().map(|w| record(&w.name, Kind::Waveform, "mm", w.monitors.len())));
        all.extend(channels.corrector_set.iter().map(|name| set(name, "A", 0.0, self.plan.corrector_limits)));
        let currents = channels.corrector_read.iter().chain(&channels.supply_read).chain(&channels.dipole_read);
        all.extend(currents.map(|name| record(name, Kind::Value, "A", 1)));
        if let Some([write, read]) = &channels.rf {
            all.push(set(write, "Hz", RF, [0.99 * RF, 1.01 * RF]));
            all.push(record(read, Kind::Value, "Hz", 1));
        }
        all.extend(channels.tunes.iter().flatten().map(|name| record(name, Kind::Value, "", 1)));
        all
    }

    /// The next cycle, some seconds after the one before, with these set points.
    pub fn cycle(&mut self, set: &BTreeMap<String, f64>, seconds: f64) -> Values {
        self.cycle += 1;
        self.follow(set, seconds);
        let rf = self.plan.channels.rf.as_ref().and_then(|[write, _]| set.get(write)).copied().unwrap_or(RF);
        let row = self.row(rf / RF - 1.0);
        let mut values = self.read_backs(&row, rf);
        // a machine that loses its beam has no readings
        let seen = self.live.read(&row).ok();
        let reading = |b: usize| seen.as_ref().and_then(|row| row.reading[b]).map(|metres| metres * 1e3);
        let dropped: Vec<usize> =
            self.faults.iter().filter_map(|fault| fault.drops(&mut || self.random.random::<f64>())).collect();
        for (plane, waveform) in self.plan.channels.monitors.iter().enumerate() {
            if !self.faults.iter().any(|fault| fault.freezes(plane, self.cycle)) {
                let of = |&b: &usize| if dropped.contains(&b) { None } else { reading(b) };
                values.insert(waveform.name.clone(), waveform.monitors.iter().map(of).collect());
            }
        }
        for (plane, name) in self.plan.channels.tunes.iter().flatten().enumerate() {
            values.insert(name.clone(), vec![seen.as_ref().and_then(|row| row.tune[plane])]);
        }
        values.insert(self.plan.channels.cycle.clone(), vec![Some(f64::from(self.cycle))]);
        values
    }

    /// Number of the last cycle.
    pub fn cycles(&self) -> u32 {
        self.cycle
    }

    /// What the monitors would have read in the last cycle without noise, jumps and faults [mm].
    pub fn exact_mm(&self) -> Vec<f64> {
        self.live.exact().iter().map(|metres| metres * 1e3).collect()
    }

    /// Correctors move towards their set points, but for those that stick.
    fn follow(&mut self, set: &BTreeMap<String, f64>, seconds: f64) {
        let share = 1.0 - (-seconds / self.settling).exp();
        for (c, current) in self.current.iter_mut().enumerate() {
            let wanted = set.get(&self.plan.channels.corrector_set[c]).copied().unwrap_or(0.0);
            if !self.faults.iter().any(|fault| fault.sticks(c, self.cycle)) {
                *current += share * (wanted - *current);
            }
        }
    }

    fn row(&mut self, rf_offset: f64) -> Row {
        let header = self.plan.header.clone();
        let mut near = |value: f64, sigma: f64| -> f64 {
            let normal: f64 = StandardNormal.sample(&mut self.random);
            value + sigma * normal
        };
        Row {
            dipole: header.nominal_dipole.map(|nominal| near(nominal, MAIN * nominal)),
            supply: header.nominal.iter().map(|nominal| near(*nominal, MAIN * nominal)).collect(),
            corrector_current: self.current.iter().map(|current| near(*current, CORRECTOR)).collect(),
            rf_offset,
            ..idle(&self.plan)
        }
    }

    fn read_backs(&self, row: &Row, rf: f64) -> Values {
        let channels = &self.plan.channels;
        let names = channels.corrector_read.iter().chain(&channels.supply_read).chain(&channels.dipole_read);
        let currents = row.corrector_current.iter().chain(&row.supply).chain(&row.dipole);
        let rf = channels.rf.iter().map(|[_, read]| (read.clone(), vec![Some(rf)]));
        names.cloned().zip(currents.map(|current| vec![Some(*current)])).chain(rf).collect()
    }
}

/// A cycle with nothing set.
fn idle(plan: &Plan) -> Row {
    Row {
        sequence: 0,
        time: 0.0,
        cycle_time: plan.cycle_time,
        correctors: Vec::new(),
        rf_offset: 0.0,
        dipole: plan.header.nominal_dipole,
        supply: plan.header.nominal.clone(),
        other: Vec::new(),
        corrector_current: vec![0.0; plan.corrector_names.len()],
        reading: vec![None; plan.header.noise.len()],
        intensity: None,
        tune: [None; 2],
    }
}

/// What a simulation wants to know of a campaign: its header, and the largest setting.
fn template(plan: &Plan) -> Recording {
    let largest = plan.steps.iter().filter_map(|step| match step {
        crate::Step::Corrector { current, .. } => Some(*current),
        crate::Step::Rf { .. } => None,
    });
    let correctors = vec![(0, largest.fold(0.0, f64::max))];
    let row = Row { correctors, ..idle(plan) };
    Recording { name: "simulated".into(), header: plan.header.clone(), other: Vec::new(), rows: vec![row] }
}
