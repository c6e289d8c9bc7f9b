//! Simulated campaigns: the settings, read-backs and gaps of a recording, with readings made by the twin at known vars.
//!
//! [`like`] is the machine of the estimator's model: linear optics, constant baselines, no other effects.
//! [`campaign()`] is one of exact orbits, with any effects.

mod campaign;

use nalgebra::DVector;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, Normal, StandardNormal};
use twin::{Hold, Optics, OrbitError, ParameterPrior, Ring, Tunes, spurious_dispersion};

use crate::campaign::{Drive, rf_orbit};
use crate::model::ResponseModel;
use crate::prior::Width;
use crate::recording::Recording;

pub use campaign::{Beyond, Hardware, Jumps, Truth, campaign};

/// What the simulated monitors do.
#[derive(Debug, Clone)]
pub struct Instruments {
    /// Noise of one reading of each monitor [m].
    pub noise: Vec<f64>,
    /// Standard deviation of the monitors' baselines [m].
    pub baseline: f64,
    /// Standard deviation of the orbit that misaligned quadrupoles add per unit of RF offset, in x and y [m].
    pub spurious: [f64; 2],
}

impl Instruments {
    /// Every monitor with the noise that the recording's header states, and the closed orbit and offsets of the machine.
    ///
    /// # Errors
    /// [`OrbitError`] if the ring has no closed orbit.
    pub fn healthy(ring: &Ring, recording: &Recording) -> Result<Self, OrbitError> {
        let baseline = 2e-3;
        // what is stated gives each of two opposite offsets twice the variance
        let spurious = spurious_dispersion(ring)?.map(|rms| rms / 2f64.sqrt() * baseline);
        Ok(Self { noise: recording.header.noise.clone(), baseline, spurious })
    }
}

/// The recording with readings that the twin at `vars` would have given; `seed` fixes noise and baselines.
///
/// Each frame has its own kicks and supply currents (these to first order, see [`crate::readings`]) and the exact orbit of
/// its RF offset.
///
/// # Errors
/// [`OrbitError`] if the ring at `vars` is not stable.
pub fn like(
    recording: &Recording,
    ring: &Ring,
    vars: &[f64],
    instruments: &Instruments,
    seed: u64,
) -> Result<Recording, OrbitError> {
    // not the stream from which vars of the same seed are drawn
    let mut random = StdRng::seed_from_u64(seeds(seed).next().unwrap_or(seed));
    let normal = |random: &mut StdRng| -> f64 { StandardNormal.sample(random) };
    let baselines = DVector::from_fn(instruments.noise.len(), |_, _| instruments.baseline * normal(&mut random));
    let ring = &*recording.powered(ring);
    let horizontal = ring.horizontal_monitors();
    let spurious = DVector::from_fn(instruments.noise.len(), |b, _| {
        instruments.spurious[usize::from(b >= horizontal)] * normal(&mut random)
    });
    let model = ResponseModel::twin(ring)?;
    let params: Vec<f64> = vars.iter().map(|var| var.ln()).collect();
    let orbit = |drive: &Drive| -> Result<DVector<f64>, OrbitError> {
        let factors = ring.strengths(&params, drive.strength.as_slice());
        let strength: Vec<f64> = factors.iter().map(|factor| factor.ln()).collect();
        let mut orbit = model.predict(&strength)?.response.columns(0, drive.kick.len()) * &drive.kick;
        if drive.rf_offset != 0.0 {
            orbit += rf_orbit(&ring.with_strengths(&factors), drive.rf_offset)? + &spurious * drive.rf_offset;
        }
        Ok(orbit)
    };
    let mut simulated = recording.clone();
    simulated.name = format!("{} (simulated)", recording.name);
    for (row, given) in simulated.rows.iter_mut().zip(&recording.rows) {
        let orbit = orbit(&Drive::of(&recording.header, given))? + &baselines;
        for (b, reading) in row.reading.iter_mut().enumerate() {
            let noise = instruments.noise[b] * normal(&mut random);
            *reading = reading.map(|_| orbit[b] + noise);
        }
        row.tune = [None; 2];
    }
    Ok(simulated)
}

/// Largest distance of a tune from the design's that the tune cut lets pass.
pub const TUNE_CUT: f64 = 0.05;

/// Distance of a tune from the next half integer that a ring needs to keep its beam: supplies that fluctuate by 2e-4, and
/// occasionally by 8e-4, move a tune by 0.005, and the half integer's stop band is as wide again.
const STOP_BAND: f64 = 0.03;

/// Vars drawn from the truncated priors of a ring's params; with the tune cut, those whose ring's tunes are within
/// [`TUNE_CUT`] of the design's. Without it, those of rings that keep their beam: both tunes between the same half integers
/// as the design's, and not on one.
///
/// # Errors
/// [`OrbitError`] if the design has no tunes.
pub fn vars(ring: &Ring, tune_cut: bool, seed: u64) -> Result<Vec<f64>, OrbitError> {
    let mut random = StdRng::seed_from_u64(seed);
    let design = tunes(ring)?;
    loop {
        let vars: Vec<f64> = ring.parameters.iter().map(|parameter| draw(&parameter.prior, &mut random)).collect();
        let near = |at: f64, design: f64| {
            let from_below = at - (2.0 * design).floor() / 2.0;
            (STOP_BAND..=0.5 - STOP_BAND).contains(&from_below) && (!tune_cut || (at - design).abs() < TUNE_CUT)
        };
        if let Ok(at) = tunes(&ring.with_vars(&vars))
            && near(at.x, design.x)
            && near(at.y, design.y)
        {
            return Ok(vars);
        }
    }
}

/// A factor from its truncated lognormal prior.
fn draw(prior: &ParameterPrior, random: &mut StdRng) -> f64 {
    let (mean, precision) = Width::Lognormal(prior.width).normal();
    let normal = Normal::new(mean, precision.sqrt().recip()).expect("a width is positive");
    loop {
        let var = normal.sample(random).exp();
        if (prior.range[0]..=prior.range[1]).contains(&var) {
            return var;
        }
    }
}

fn tunes(ring: &Ring) -> Result<Tunes, OrbitError> {
    Optics::of(ring, Hold::Momentum { delta: 0.0 })?.tunes()
}

/// A seed for each of many things made from one.
pub fn seeds(seed: u64) -> impl Iterator<Item = u64> {
    let mut random = StdRng::seed_from_u64(seed);
    core::iter::repeat_with(move || random.random())
}
