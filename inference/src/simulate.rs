//! Simulated campaigns: the settings, read-backs and gaps of a recording, with readings made by the twin at known vars.
//!
//! [`like`] is the machine of the estimator's model: linear optics, constant baselines, no other effects.
//! [`campaign()`] is one of exact orbits, with any effects, and [`Live`] the same machine one cycle at a time; [`conceal()`] puts effects into a recording that was measured.

mod campaign;
mod conceal;
mod live;

use nalgebra::DVector;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use twin::{Hold, Optics, OrbitError, Ring, SHARED, Tunes, spurious_dispersion};

use crate::campaign::rf_orbit;
use crate::model::ResponseModel;
use crate::prior::draw;
use crate::recording::{Drive, Recording};

pub use campaign::{Beyond, Hardware, Jumps, Truth, campaign};
pub use conceal::conceal;
pub use live::Live;

/// What the simulated monitors do.
#[derive(Debug, Clone)]
pub struct Instruments {
    /// Noise of one reading of each monitor [m].
    pub noise: Vec<f64>,
    /// Standard deviation of the monitors' baselines [m].
    pub baseline: f64,
    /// Standard deviation of the orbit that misaligned quadrupoles add per unit of RF offset, in x and y, for each monitor by itself as the
    /// fit takes it: [`SHARED`] times what it is [m].
    pub spurious: [f64; 2],
}

impl Instruments {
    /// Every monitor with the noise that the recording's header states, and the closed orbit and offsets of the machine.
    ///
    /// # Errors
    /// [`OrbitError`] if the ring has no closed orbit.
    pub fn healthy(ring: &Ring, recording: &Recording) -> Result<Self, OrbitError> {
        let baseline = 2e-3;
        let spurious = spurious_dispersion(ring)?.map(|rms| SHARED * rms * baseline);
        Ok(Self { noise: recording.header.noise.clone(), baseline, spurious })
    }
}

/// The recording with readings that the twin at `vars` would have given; `seed` fixes noise and baselines.
///
/// Each frame has its own kicks and supply currents (these to first order, see `readings.rs`) and the exact orbit of
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
        let orbit = orbit(&Drive::from_row(&recording.header, given))? + &baselines;
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
/// occasionally by 8e-4, move a tune by 0.005, and the half integer's stop band is as wide again. Half the design's own distance
/// where that is less: a machine that is run there does keep its beam.
const STOP_BAND: f64 = 0.03;

/// Rings that are drawn before it is said that none is as asked for; of the Booster's, every second one is.
const TRIES: usize = 10_000;

/// Why there are no vars.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum VarsError {
    /// The design has no tunes.
    #[error(transparent)]
    Orbit(#[from] OrbitError),
    /// The prior is too wide for the design.
    #[error(
        "{ring}: of {TRIES} rings drawn from the prior of the vars none keeps its beam with tunes near the design's {:.4} {:.4}; \
         a narrower prior_width has some", .tunes[0], .tunes[1]
    )]
    Rare {
        /// The machine.
        ring: String,
        /// Tunes of the design.
        tunes: [f64; 2],
    },
}

/// Which tunes the machines of a ring may have.
pub struct TuneWindow {
    design: Tunes,
    tune_cut: bool,
}

impl TuneWindow {
    /// With the tune cut, tunes within [`TUNE_CUT`] of the design's; without it, those between the same half integers, and not on one.
    ///
    /// # Errors
    /// [`OrbitError`] if the design has no tunes.
    pub fn from_ring(ring: &Ring, tune_cut: bool) -> Result<Self, OrbitError> {
        Ok(Self { design: tunes(ring)?, tune_cut })
    }

    /// True for tunes that a machine may have.
    pub fn holds(&self, tunes: Tunes) -> bool {
        let is_held = |design: f64, tune: f64| {
            let below = (2.0 * design).floor() / 2.0;
            let own = (design - below).min(below + 0.5 - design);
            let band = STOP_BAND.min(0.5 * own);
            (band..=0.5 - band).contains(&(tune - below)) && (!self.tune_cut || (tune - design).abs() < TUNE_CUT)
        };
        is_held(self.design.x, tunes.x) && is_held(self.design.y, tunes.y)
    }
}

/// Vars drawn from the truncated priors of a ring's params; with the tune cut, those whose ring's tunes are within
/// [`TUNE_CUT`] of the design's. Without it, those of rings that keep their beam: both tunes between the same half integers
/// as the design's, and not on one.
///
/// # Errors
/// [`VarsError`].
pub fn vars(ring: &Ring, tune_cut: bool, seed: u64) -> Result<Vec<f64>, VarsError> {
    let mut random = StdRng::seed_from_u64(seed);
    let window = TuneWindow::from_ring(ring, tune_cut)?;
    let drawn = || ring.parameters.iter().map(|parameter| draw(&parameter.prior, &mut random)).collect();
    let keeps = |vars: &Vec<f64>| tunes(&ring.with_vars(vars)).is_ok_and(|at| window.holds(at));
    let kept = core::iter::repeat_with(drawn).take(TRIES).find(keeps);
    kept.ok_or_else(|| VarsError::Rare { ring: ring.name.clone(), tunes: [window.design.x, window.design.y] })
}

fn tunes(ring: &Ring) -> Result<Tunes, OrbitError> {
    Optics::of(ring, Hold::Momentum { delta: 0.0 })?.tunes()
}

/// A seed for each of many things made from one.
pub fn seeds(seed: u64) -> impl Iterator<Item = u64> {
    let mut random = StdRng::seed_from_u64(seed);
    core::iter::repeat_with(move || random.random())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::prior::with_priors;

    /// The Booster with all of its horizontally focusing quadrupoles stronger, to a horizontal tune of 4.984.
    fn next_to_an_integer() -> Ring {
        let ring = Ring::booster();
        let focusing = ring.gradients().into_iter().map(|k1| k1 > 0.0);
        let focusing: Vec<bool> = focusing.collect();
        let at = |factor: f64| {
            ring.with_strengths(&focusing.iter().map(|focuses| if *focuses { factor } else { 1.0 }).collect::<Vec<_>>())
        };
        let (mut low, mut high) = (1.0, 1.1);
        for _ in 0..40 {
            let middle = 0.5 * (low + high);
            let below = tunes(&at(middle)).is_ok_and(|tunes| tunes.x < 4.984);
            (low, high) = if below { (middle, high) } else { (low, middle) };
        }
        at(low)
    }

    /// 0.0005 moves the tune by some 0.0005, a thirtieth of its distance from the integer.
    #[test]
    fn a_design_near_a_half_integer_has_rings_like_it() {
        let ring = with_priors(&next_to_an_integer(), Some(0.0005), None);
        assert!((tunes(&ring).unwrap().x - 4.984).abs() < 1e-6);
        for tune_cut in [false, true] {
            let vars = vars(&ring, tune_cut, 1).unwrap();
            assert!((tunes(&ring.with_vars(&vars)).unwrap().x - 4.984).abs() < 0.008);
        }
    }

    #[test]
    fn a_prior_without_a_stable_ring_is_said() {
        let ring = with_priors(&Ring::booster(), Some(5.0), Some([1e-3, 1e3]));
        let said = vars(&ring, true, 1).unwrap_err().to_string();
        assert!(said.contains("of 10000 rings drawn from the prior of the vars none keeps its beam"), "{said}");
    }
}
