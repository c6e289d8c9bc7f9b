//! Template and hardware of the campaigns that the tests simulate.

use std::path::Path;

use inference::Campaign;
use inference::recording::Recording;
use inference::simulate::{self, Beyond, Hardware, Truth};
use nalgebra::{DMatrix, DVector};
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand_distr::{Distribution, StandardNormal};
use twin::{Cycle, Effect, Hold, Optics, Ring};

use crate::data::Data;

/// A campaign of the repository, on the ring as designed.
pub fn template() -> (Ring, Recording) {
    let ring = Ring::paper_booster();
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings/former/paper-vars");
    let recording = Recording::read(&folder, &ring).unwrap();
    (ring, recording)
}

/// A recording whitened.
pub fn whitened(ring: &Ring, recording: &Recording) -> Data {
    Data::from_campaign(&Campaign::of(ring, recording).unwrap()).unwrap()
}

/// The template's campaign on a machine with some vars, effects and more, with the hardware of the shipped recordings.
pub fn simulated(vars: &[f64], effects: &[Effect], beyond: &[&dyn Beyond], seed: u64) -> Recording {
    let (ring, recording) = template();
    let truth = Truth { vars, effects, beyond };
    simulate::campaign(&recording, &ring, &truth, &Hardware::shipped(&ring, &recording), seed).unwrap()
}

/// A standard normal number.
pub fn normal(random: &mut StdRng) -> f64 {
    StandardNormal.sample(random)
}

/// Neighbours that share a crate.
pub const CRATE: core::ops::Range<usize> = 8..13;

/// Noise that is not white and alone, added to that of the hardware.
pub struct Coloured {
    /// Noise of a reading [m].
    pub noise: f64,
    /// Share of its variance that is slow, and correlation time [frames].
    pub slow: (f64, f64),
    /// Random walk [m per root frame].
    pub walk: f64,
    /// Rms jitter of the momentum [1].
    pub momentum: f64,
    /// Share that five neighbours in the order of reading have in common, see [`CRATE`].
    pub crate_share: f64,
    /// What all monitors read besides, rows frames, columns monitors [m]; empty for nothing.
    pub common: DMatrix<f64>,
    /// The vars of the machine, and its dispersion at the read monitors [m].
    pub vars: Vec<f64>,
    pub dispersion: DVector<f64>,
    /// A monitor that walks by itself, and its walk [m per root frame].
    pub wandering: Option<(usize, f64)>,
    pub seed: u64,
}

impl Coloured {
    /// As the header states it, on a machine of random vars.
    pub(crate) fn white(ring: &Ring, recording: &Recording, seed: u64) -> Self {
        let vars = simulate::vars(ring, true, seed).unwrap();
        let made = recording.powered(ring).with_vars(&vars);
        let optics = Optics::of(&made, Hold::Momentum { delta: 0.0 }).unwrap();
        let dispersion = optics.dispersion_of(&optics.read_monitors());
        let noise = recording.header.noise[0];
        let common = DMatrix::zeros(0, 0);
        let (slow, wandering) = ((0.0, 10.0), None);
        Self { noise, slow, walk: 0.0, momentum: 0.0, crate_share: 0.0, common, vars, dispersion, wandering, seed }
    }

    /// A campaign with this noise, with the faulty monitors of the shipped recordings.
    pub fn campaign(&self, ring: &Ring, recording: &Recording, effects: &[Effect]) -> Recording {
        self.campaign_with(ring, recording, effects, &[])
    }

    /// The same with more physics.
    pub(crate) fn campaign_with(
        &self,
        ring: &Ring,
        recording: &Recording,
        effects: &[Effect],
        more: &[&dyn Beyond],
    ) -> Recording {
        let mut hardware = Hardware::shipped(ring, recording);
        for (b, noise) in hardware.noise.iter_mut().enumerate() {
            let shared = if CRATE.contains(&b) { self.crate_share } else { 0.0 };
            *noise *= (1.0 - self.slow.0 - shared).sqrt() * self.noise / recording.header.noise[b];
        }
        let beyond: Vec<&dyn Beyond> = more.iter().copied().chain([self as &dyn Beyond]).collect();
        let truth = Truth { vars: &self.vars, effects, beyond: &beyond };
        simulate::campaign(recording, ring, &truth, &hardware, self.seed).unwrap()
    }
}

impl Beyond for Coloured {
    fn alter_readings(&self, _: &[Cycle], readings: &mut DMatrix<f64>) {
        let mut random = StdRng::seed_from_u64(self.seed ^ 0x5eed);
        let mut normal = || normal(&mut random);
        if !self.common.is_empty() {
            *readings += &self.common;
        }
        let decay = (-1.0 / self.slow.1).exp();
        for mut column in readings.column_iter_mut() {
            let (mut slow, mut walk) = (normal(), 0.0);
            for reading in &mut column {
                *reading += self.noise * self.slow.0.sqrt() * slow + self.walk * walk;
                slow = decay * slow + (1.0 - decay * decay).sqrt() * normal();
                walk += normal();
            }
        }
        if let Some((b, step)) = self.wandering {
            let mut walk = 0.0;
            for reading in &mut readings.column_mut(b) {
                *reading += step * walk;
                walk += normal();
            }
        }
        for mut row in readings.row_iter_mut() {
            row += self.dispersion.transpose() * (self.momentum * normal());
            let common = self.noise * self.crate_share.sqrt() * normal();
            CRATE.for_each(|b| row[b] += common);
        }
    }
}
