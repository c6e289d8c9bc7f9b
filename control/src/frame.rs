//! One machine cycle as the channels gave it, by time stamp.

use inference::recording::Row;
use serde::{Deserialize, Serialize};

use crate::channel::Sample;
use crate::plan::{Channels, Plan};
use crate::step::Step;

/// One machine cycle; field names are those of the journal.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Frame {
    /// Counter of the machine.
    pub cycle: u32,
    /// Its time stamp [s since 1970].
    pub time_s: f64,
    /// Readings of the monitors of the machine [mm].
    pub reading_mm: Vec<Option<f64>>,
    /// Read-backs of the correctors [A].
    #[serde(rename = "corrector_A")]
    pub corrector: Vec<f64>,
    /// Read-backs of the quadrupole supplies [A].
    #[serde(rename = "supply_A")]
    pub supply: Vec<f64>,
    /// Read-back of the dipoles [A].
    #[serde(rename = "dipole_A")]
    pub dipole: Option<f64>,
    /// Fractional tunes.
    pub tune: [Option<f64>; 2],
}

/// Largest position that is one [mm].
const LARGEST: f64 = 100.0;

impl Channels {
    /// The channels of a frame, in the order in which [`Frame::of`] takes their samples.
    pub fn of_a_frame(&self) -> Vec<&str> {
        let monitors = self.monitors.iter().map(|waveform| &waveform.name);
        let tunes = self.tunes.iter().flatten();
        let read_backs = self.corrector_read.iter().chain(&self.supply_read).chain(&self.dipole_read);
        [&self.cycle].into_iter().chain(monitors).chain(tunes).chain(read_backs).map(String::as_str).collect()
    }
}

impl Frame {
    /// The frame that samples make, or what is wrong with one of them.
    ///
    /// # Errors
    /// One line with channel and value.
    pub fn of(plan: &Plan, samples: &[Sample]) -> Result<Self, String> {
        let (channels, names) = (&plan.channels, plan.channels.of_a_frame());
        let mut samples = names.into_iter().zip(samples);
        let (name, cycle) = samples.next().ok_or("no samples")?;
        let (number, time) = (counter(name, cycle)?, cycle.time_s);
        let mut reading_mm = vec![None; plan.header.noise.len()];
        for (waveform, (name, sample)) in channels.monitors.iter().zip(samples.by_ref()) {
            let late = sample.time_s - time;
            if late.abs() > plan.match_window {
                return Err(format!("{name} was last updated {late:+.3} s from cycle {number}"));
            }
            let positions = sample.value.iter().map(|mm| mm.filter(|mm| !sample.invalid && mm.abs() <= LARGEST));
            waveform.monitors.iter().zip(positions).for_each(|(&b, mm)| reading_mm[b] = mm);
        }
        if reading_mm.iter().all(Option::is_none) {
            return Err(format!("no monitor reports in cycle {number}"));
        }
        let mut tune = [None; 2];
        if channels.tunes.is_some() {
            let fraction = |sample: &Sample| sample.number().filter(|q| (0.0..1.0).contains(q));
            tune.iter_mut().zip(samples.by_ref()).for_each(|(tune, (_, sample))| *tune = fraction(sample));
        }
        let mut read_back = |count: usize| -> Result<Vec<f64>, String> {
            let number = |(name, sample): (&str, &Sample)| sample.number().ok_or(format!("{name} has no valid number"));
            samples.by_ref().take(count).map(number).collect()
        };
        let corrector = read_back(channels.corrector_read.len())?;
        let supply = read_back(channels.supply_read.len())?;
        let dipole = read_back(usize::from(channels.dipole_read.is_some()))?.first().copied();
        if let Some(current) = supply.iter().chain(&dipole).find(|current| **current <= 0.0) {
            return Err(format!("a main supply is at {current} A in cycle {number}"));
        }
        Ok(Self { cycle: number, time_s: time, reading_mm, corrector, supply, dipole, tune })
    }

    /// The row of a recording that began at some time, counted on from another row.
    pub fn row(&self, step: &Step, plan: &Plan, sequence: u32, began_s: f64) -> Row {
        let (correctors, rf_offset) = match step {
            Step::Corrector { corrector, current } => {
                let index = plan.corrector_names.iter().position(|name| name == corrector);
                (index.map(|c| (c, *current)).into_iter().collect(), 0.0)
            }
            Step::Rf { offset } => (Vec::new(), *offset),
        };
        Row {
            sequence,
            time: self.time_s - began_s,
            cycle_time: plan.cycle_time,
            correctors,
            rf_offset,
            dipole: self.dipole,
            supply: self.supply.clone(),
            other: Vec::new(),
            corrector_current: self.corrector.clone(),
            reading: self.reading_mm.iter().map(|mm| mm.map(|mm| mm / 1000.0)).collect(),
            intensity: None,
            tune: self.tune,
        }
    }
}

/// The number of a cycle.
pub fn counter(name: &str, sample: &Sample) -> Result<u32, String> {
    let whole = |number: f64| (number >= 0.0 && number <= f64::from(u32::MAX)).then_some(number as u32);
    sample.number().and_then(whole).ok_or_else(|| format!("{name} holds no number of a cycle: {:?}", sample.value))
}
