//! A simulated machine that is asked for one cycle after another, while somebody turns its correctors.

use nalgebra::DMatrix;
use rand::SeedableRng;
use rand::rngs::StdRng;
use twin::{Cycle, EffectError, Machine, OrbitError, Rf, Ring, Tracked};

use super::campaign::{Hardware, Truth, cycle, misalign};
use super::seeds;
use crate::recording::{Recording, Row};

/// A machine with random errors, as one of a [`super::campaign()`], whose next settings are not known beforehand.
pub struct Live {
    template: Recording,
    ring: Ring,
    tracked: Tracked,
    hardware: Hardware,
    /// Offset of each monitor [m].
    offset: DMatrix<f64>,
    noise: StdRng,
    jumps: StdRng,
    meter: StdRng,
    before: Option<Cycle>,
    exact: Vec<f64>,
}

impl Live {
    /// A machine whose header, and whose correctors' nominal kick, are those of a template. The time within a campaign that has no end
    /// is always 0, so a drift from its start to its end is none.
    ///
    /// # Errors
    /// [`EffectError`] if an effect has no place in the ring, or if there is no closed orbit.
    pub fn try_new(
        template: Recording,
        ring: &Ring,
        truth: &Truth,
        hardware: Hardware,
        seed: u64,
    ) -> Result<Self, EffectError> {
        let mut streams = seeds(seed).map(StdRng::seed_from_u64);
        let mut stream = || streams.next().expect("seeds do not end");
        let mut ring = template.powered(ring).with_vars(truth.vars);
        misalign(&mut ring, hardware.misalignment, &mut stream());
        truth.beyond.iter().for_each(|beyond| beyond.alter_ring(&mut ring));
        let machine = Machine::new(ring.clone(), Rf::FixedMomentum, truth.effects)?;
        let tracked = Tracked::of(machine, template.nominal_kick())?;
        let mut offset = DMatrix::zeros(1, hardware.noise.len());
        hardware.offset(&mut offset, &mut stream());
        let (noise, jumps, meter) = (stream(), stream(), stream());
        Ok(Self { template, ring, tracked, hardware, offset, noise, jumps, meter, before: None, exact: Vec::new() })
    }

    /// What the monitors would have read in the last cycle without noise and jumps [m].
    pub fn exact(&self) -> &[f64] {
        &self.exact
    }

    /// The row with what monitors and tune meter read; an effect that remembers does so for one cycle.
    ///
    /// # Errors
    /// [`OrbitError`] if the machine keeps no beam in this cycle.
    pub fn read(&mut self, row: &Row) -> Result<Row, OrbitError> {
        let now = cycle(&self.template, &self.ring, row, 0.0);
        let cycles: Vec<Cycle> = self.before.take().into_iter().chain([now.clone()]).collect();
        self.before = Some(now);
        let (orbits, tunes) = self.tracked.cycles(&cycles)?;
        let last = cycles.len() - 1;
        let mut reading = orbits.rows(last, 1) + &self.offset;
        self.exact = reading.iter().copied().collect();
        self.hardware.add_noise(&mut reading, &mut self.noise);
        self.hardware.jump(&mut reading, &mut self.jumps);
        let tune = self.hardware.meter(&tunes[last..], &mut self.meter)[0];
        Ok(Row { reading: reading.iter().copied().map(Some).collect(), tune: tune.map(Some), ..row.clone() })
    }
}
