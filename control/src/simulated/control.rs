//! A simulated machine as a control system within the process, in a time of its own: a measurement of an hour takes seconds.

use std::collections::BTreeMap;

use super::{Kind, Record, SimulatedMachine};
use crate::channel::{Channel, Control, ControlError, Sample};

/// The channels of a simulated machine.
pub struct SimulatedControl {
    machine: SimulatedMachine,
    records: BTreeMap<String, Record>,
    set: BTreeMap<String, f64>,
    samples: BTreeMap<String, Sample>,
    now: f64,
    period: f64,
    next: f64,
}

/// What the time stamps begin at [s since 1970].
const BEGAN: f64 = 1.8e9;
/// What is said of a channel that there is none of.
const NONE: &str = "no such channel";

impl SimulatedControl {
    /// A machine with a cycle every `period` seconds; the first one is over.
    pub fn new(machine: SimulatedMachine, period: f64) -> Self {
        let records: BTreeMap<String, Record> = machine.records().into_iter().map(|r| (r.name.clone(), r)).collect();
        let set = records.values().filter(|r| r.kind == Kind::Set).map(|r| (r.name.clone(), r.value)).collect();
        let mut control = Self { machine, records, set, samples: BTreeMap::new(), now: 0.0, period, next: 0.0 };
        control.pause(0.0);
        control
    }

    /// What every set point is at.
    pub fn set_points(&self) -> &BTreeMap<String, f64> {
        &self.set
    }
}

impl Control for SimulatedControl {
    fn describe(&mut self, names: &[&str]) -> Result<Vec<Channel>, ControlError> {
        let of = |name: &&str| {
            let record = self.records.get(*name);
            Channel {
                connected: record.is_some(),
                readable: true,
                writable: record.is_some_and(|record| record.kind == Kind::Set),
                count: record.map_or(0, |record| record.length),
                limits: record.and_then(|record| record.limits),
            }
        };
        Ok(names.iter().map(of).collect())
    }

    fn sample(&mut self, names: &[&str]) -> Result<Vec<Result<Sample, String>>, ControlError> {
        let of = |name: &&str| match self.set.get(*name) {
            Some(&value) => Ok(Sample { value: vec![Some(value)], time_s: BEGAN + self.now, invalid: false }),
            None => self.samples.get(*name).cloned().ok_or_else(|| NONE.into()),
        };
        Ok(names.iter().map(of).collect())
    }

    fn write(&mut self, name: &str, value: f64) -> Result<(), ControlError> {
        let (set, record) = (self.set.get_mut(name), self.records.get(name));
        let [low, high] = record.and_then(|record| record.limits).unwrap_or([f64::NEG_INFINITY, f64::INFINITY]);
        match set {
            Some(set) if (low..=high).contains(&value) => *set = value,
            Some(_) => {
                let why = format!("its limits are {low} to {high}");
                return Err(ControlError::Refused { channel: name.into(), value, why });
            }
            None => return Err(ControlError::Refused { channel: name.into(), value, why: NONE.into() }),
        }
        Ok(())
    }

    fn now(&self) -> f64 {
        self.now
    }

    fn pause(&mut self, seconds: f64) {
        self.now += seconds;
        while self.next <= self.now {
            let time_s = BEGAN + self.next;
            for (name, value) in self.machine.cycle(&self.set, self.period) {
                self.samples.insert(name, Sample { value, time_s, invalid: false });
            }
            self.next += self.period;
        }
    }
}
