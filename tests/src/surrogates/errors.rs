//! Errors of the difference of the orbits at -22 A and 22 A, over machines within the tune cut of the training set [mm].

use estimator::surrogate::{SETTING_KICK, SPAN};
use inference::draw;
use nalgebra::DMatrix;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use training::check::TUNE_CUT;
use twin::{ParameterPrior, Ring, VariedRing};

use super::{CORRECTORS, FIRST, Surrogate};

/// Kick from -22 A to +22 A [rad].
const SWING: f64 = 2.0 * SETTING_KICK as f64;
/// Bands of a tune.
pub const BANDS: usize = 5;
/// Width of the prior.
const WIDTH: f64 = 0.03;

/// A machine as the twin sees it.
pub struct Machine {
    /// Its vars.
    pub vars: Vec<f64>,
    response: DMatrix<f64>,
    /// Tunes less the design's.
    tunes: [f64; 2],
}

/// Machines whose vars lie evenly over the range of the training set.
pub fn even(ring: &Ring, count: usize) -> Vec<Machine> {
    let mut random = StdRng::seed_from_u64(18);
    machines(ring, count, || 1.0 + f64::from(SPAN) * random.random_range(-1.0..1.0))
}

/// Machines of the prior, of vars within the same range.
pub fn prior(ring: &Ring, count: usize) -> Vec<Machine> {
    let mut random = StdRng::seed_from_u64(19);
    let span = f64::from(SPAN);
    let prior = ParameterPrior { width: WIDTH, range: [1.0 - span, 1.0 + span] };
    machines(ring, count, || draw(&prior, &mut random))
}

fn machines(ring: &Ring, count: usize, mut var: impl FnMut() -> f64) -> Vec<Machine> {
    let varied = VariedRing::of(ring).expect("a stable design");
    let design = varied.at(&vec![1.0; ring.quadrupoles.len()]).expect("a stable design").tunes();
    let mut set = Vec::new();
    while set.len() < count {
        let vars: Vec<f64> = ring.parameters.iter().map(|_| var()).collect();
        let Ok(optics) = varied.at(&vars) else { continue };
        let tunes = optics.tunes();
        if tunes.iter().zip(&design).all(|(tune, design)| (tune - design).abs() <= TUNE_CUT) {
            set.push(Machine {
                response: optics.response(),
                vars,
                tunes: [tunes[0] - design[0], tunes[1] - design[1]],
            });
        }
    }
    set
}

/// Errors at all monitors and correctors of a plane [mm].
fn misses(surrogate: &Surrogate, machine: &Machine, plane: usize) -> Vec<f64> {
    let own = surrogate.predict(&machine.vars);
    let monitors = if plane == 0 { 0..FIRST } else { FIRST..machine.response.nrows() };
    let places = monitors.flat_map(|b| (0..CORRECTORS).map(move |c| (b, plane * CORRECTORS + c)));
    places.map(|place| 1e3 * SWING * (own[place] - machine.response[place])).collect()
}

/// Rms and largest [mm].
pub fn errors(surrogate: &Surrogate, set: &[Machine], plane: usize) -> [f64; 2] {
    let all: Vec<f64> = set.iter().flat_map(|machine| misses(surrogate, machine, plane)).collect();
    [rms(&all), all.iter().fold(0.0, |largest, miss| miss.abs().max(largest))]
}

/// Rms by the plane's own tune [mm].
pub fn bands(surrogate: &Surrogate, set: &[Machine], plane: usize) -> [f64; BANDS] {
    let mut within = [const { Vec::new() }; BANDS];
    for machine in set {
        within[band(machine.tunes[plane])].extend(misses(surrogate, machine, plane));
    }
    within.map(|misses| rms(&misses))
}

/// Rms by both tunes, `Qy` from the top down, `Qx` to the right [mm]; NaN where no machine is.
pub fn map(surrogate: &Surrogate, set: &[Machine], plane: usize) -> DMatrix<f64> {
    let mut within = vec![Vec::new(); BANDS * BANDS];
    for machine in set {
        let [x, y] = machine.tunes.map(band);
        within[x * BANDS + (BANDS - 1 - y)].extend(misses(surrogate, machine, plane));
    }
    let rms = |misses: &Vec<f64>| if misses.is_empty() { f64::NAN } else { rms(misses) };
    DMatrix::from_iterator(BANDS, BANDS, within.iter().map(rms))
}

/// Which band a tune is in.
fn band(tune: f64) -> usize {
    (((tune / TUNE_CUT + 1.0) * 0.5 * BANDS as f64) as usize).min(BANDS - 1)
}

/// Share of machines whose rms error is at least twice what is stated [mm].
pub fn beyond(surrogate: &Surrogate, set: &[Machine], plane: usize, stated: f64) -> f64 {
    let far = set.iter().filter(|machine| rms(&misses(surrogate, machine, plane)) >= 2.0 * stated).count();
    far as f64 / set.len() as f64
}

fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|v| v * v).sum::<f64>() / values.len().max(1) as f64).sqrt()
}
