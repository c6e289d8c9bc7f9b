//! Measured error of a surrogate against the exact twin; the tables state it.

use estimator::Tables as _;
use estimator::surrogate::Network as Core;
use nalgebra::DMatrix;
use twin::{Hold, Optics, Parameter, ParameterPrior, Ring, median, sobol};

use crate::instruments::Instruments;
use crate::network::layers::Network;
pub use crate::network::samples::TUNE_CUT;
use crate::network::{OtherRing, PLANES};
use crate::response::{CoreResponse, network_responses, network_responses_f32, responses};
use crate::tables::{LINE, Tables};

/// Error of one surrogate in one plane, of the orbit of a kick of 0.4 mrad, over many vars.
#[derive(Debug, Clone, PartialEq)]
pub struct SurrogateError {
    /// Name of the surrogate.
    pub name: &'static str,
    /// `x` or `y`.
    pub plane: char,
    /// Numbers in the tables of both planes.
    pub parameters: usize,
    /// Bytes of the tables of both planes.
    pub bytes: usize,
    /// Vars within the tune cut that were tried.
    pub samples: usize,
    /// Rms over samples, monitors and correctors [m].
    pub rms: f64,
    /// Median over samples of the rms over monitors and correctors [m]: few samples tell it, as it does not hang on those near a
    /// resonance.
    pub median: f64,
    /// Largest [m].
    pub max: f64,
    /// What the surrogate states of itself [m].
    pub stated_rms: f64,
    /// Largest error of the tune [1].
    pub tune_max: f64,
}

/// Each var is drawn evenly within so many widths of its prior from 1, and within its range: 0.94 to 1.06 by default.
const WIDTHS: f64 = 2.0;
/// Kick at which the error is measured [rad]: the Booster's from -22 A to +22 A. Tables know of no campaign; its kicks are smaller
/// as a rule, and the error is proportional to them.
const FULL_SWING: f64 = 0.4e-3;

/// Vars at point `i` of a scrambled Sobol sequence [N].
fn sobol_vars(i: u32, ring: &Ring, seed: u32) -> Vec<f64> {
    let of = |(n, parameter): (usize, &Parameter)| {
        let ParameterPrior { width, range: [lowest, highest] } = parameter.prior;
        let (from, to) = (lowest.max(1.0 - WIDTHS * width), highest.min(1.0 + WIDTHS * width));
        from + (to - from) * sobol(i, n, seed)
    };
    ring.parameters.iter().enumerate().map(of).collect()
}

/// A ring of the sample, as the twin sees it.
struct Exact {
    response: DMatrix<f64>,
    tunes: [f64; 2],
}

/// Measure the Green's function surrogate on the design and on `samples` vars in all within the tune cut; `progress` hears of each.
pub fn check(ring: &Ring, tables: &Tables, samples: usize, seed: u32, progress: impl FnMut()) -> [SurrogateError; 2] {
    check_with(ring, &Instruments::sound(ring), tables, samples, seed, progress)
}

/// The same of tables of the ring as its instruments show it.
pub(crate) fn check_with(
    ring: &Ring,
    instruments: &Instruments,
    tables: &Tables,
    samples: usize,
    seed: u32,
    mut progress: impl FnMut(),
) -> [SurrogateError; 2] {
    let (vars, rings) = sample(ring, instruments, samples, seed, &mut progress);
    let predicted = responses(tables, &vars);
    let about = |plane: usize| About {
        name: "green",
        parameters: parameters(tables),
        bytes: bytes(tables),
        stated_rms: f64::from(tables.stated_error()[plane]),
    };
    compare(ring, &rings, &predicted, about)
}

/// What is known of a surrogate.
struct About {
    name: &'static str,
    parameters: usize,
    bytes: usize,
    stated_rms: f64,
}

/// Vars within the tune cut, the design first, and what the twin makes of them.
fn sample(
    ring: &Ring,
    instruments: &Instruments,
    samples: usize,
    seed: u32,
    progress: &mut impl FnMut(),
) -> (Vec<Vec<f64>>, Vec<Exact>) {
    let ones = vec![1.0; ring.parameters.len()];
    let exact = |vars: &[f64]| exact(ring, instruments, vars);
    let design = exact(&ones).expect("the surrogate has a stable design").tunes;
    let near = |e: &Exact| e.tunes.iter().zip(design).all(|(tune, design)| (tune - design).abs() <= TUNE_CUT);
    let tried = (0..).map(|i| sobol_vars(i, ring, seed)).take(TRIES * samples);
    let within =
        core::iter::once(ones).chain(tried).filter_map(|vars| exact(&vars).filter(near).map(|exact| (vars, exact)));
    within.inspect(|_| progress()).take(samples).unzip()
}

/// The errors of predictions of these rings.
fn compare(
    ring: &Ring,
    rings: &[Exact],
    predicted: &[Option<CoreResponse>],
    about: impl Fn(usize) -> About,
) -> [SurrogateError; 2] {
    let (mut errors, mut each) = ([Errors::default(); 2], [Vec::new(), Vec::new()]);
    for (exact, core) in rings.iter().zip(predicted) {
        // a core refuses a ring beyond a resonance
        let Some(core) = core else { continue };
        let (monitors, correctors) = (ring.horizontal_monitors(), ring.horizontal_correctors());
        let mut here = [Errors::default(); 2];
        for c in 0..exact.response.ncols() {
            for b in 0..exact.response.nrows() {
                if (b < monitors) == (c < correctors) {
                    let error = FULL_SWING * (core.response[(b, c)] - exact.response[(b, c)]);
                    here[usize::from(b >= monitors)].add(error.abs());
                }
            }
        }
        each.iter_mut().zip(&here).for_each(|(each, here)| each.push(here.rms()));
        errors.iter_mut().zip(here).for_each(|(errors, here)| errors.join(here));
        for (errors, (ours, exact)) in errors.iter_mut().zip(core.tunes.iter().zip(exact.tunes)) {
            let miss = ours - exact;
            errors.tune = errors.tune.max((miss - miss.round()).abs());
        }
    }
    [0, 1].map(|plane| SurrogateError {
        name: about(plane).name,
        plane: ['x', 'y'][plane],
        parameters: about(plane).parameters,
        bytes: about(plane).bytes,
        samples: each[plane].len(),
        rms: errors[plane].rms(),
        median: median(each[plane].iter().copied()).unwrap_or(0.0),
        max: errors[plane].largest,
        stated_rms: about(plane).stated_rms,
        tune_max: errors[plane].tune,
    })
}

/// The same of the trained network; `free` is the network in f32 before its weights were rounded, if there is one at hand.
///
/// # Errors
/// [`OtherRing`] for a ring that it was not trained on.
pub fn check_networks(
    ring: &Ring,
    free: Option<&[Network; 2]>,
    samples: usize,
    seed: u32,
    mut progress: impl FnMut(),
) -> Result<Vec<SurrogateError>, OtherRing> {
    crate::network::expect_known(ring)?;
    let (vars, rings) = sample(ring, &Instruments::sound(ring), samples, seed, &mut progress);
    let parameters = |plane: usize| PLANES[plane].parameters();
    let own = |plane: usize| About {
        name: "resnet",
        parameters: parameters(plane),
        bytes: Core::bytes(PLANES[plane].shape().0, PLANES[plane].shape().1, ring.horizontal_correctors()),
        stated_rms: 2.0 * f64::from(PLANES[plane].stated_error()),
    };
    let mut errors = compare(ring, &rings, &network_responses(&vars), own).to_vec();
    if let Some(free) = free {
        let of_free = |plane: usize| About { name: "resnet f32", bytes: 4 * parameters(plane), ..own(plane) };
        errors.extend(compare(ring, &rings, &network_responses_f32(free, &vars), of_free));
    }
    Ok(errors)
}

/// Points that are tried for each that is wanted: a ring next to a resonance loses most of them.
const TRIES: usize = 50;

/// Errors of one plane.
#[derive(Debug, Clone, Copy, Default)]
struct Errors {
    squares: f64,
    count: usize,
    largest: f64,
    tune: f64,
}

impl Errors {
    fn add(&mut self, error: f64) {
        self.squares += error * error;
        self.count += 1;
        self.largest = self.largest.max(error);
    }

    fn join(&mut self, other: Self) {
        self.squares += other.squares;
        self.count += other.count;
        self.largest = self.largest.max(other.largest);
    }

    fn rms(&self) -> f64 {
        (self.squares / self.count.max(1) as f64).sqrt()
    }
}

/// The twin at given vars; none where it is not stable.
fn exact(ring: &Ring, instruments: &Instruments, vars: &[f64]) -> Option<Exact> {
    let changed = ring.with_vars(vars);
    let optics = Optics::of(&changed, Hold::Momentum { delta: instruments.delta }).ok()?;
    let tunes = optics.tunes().ok()?;
    let response = optics.response(&instruments.monitors(&optics), &instruments.correctors(&optics));
    Some(Exact { response, tunes: [tunes.x, tunes.y] })
}

/// Numbers in tables.
fn parameters(tables: &Tables) -> usize {
    entries(tables).0 + entries(tables).1
}

/// Bytes of tables in a core.
fn bytes(tables: &Tables) -> usize {
    2 * entries(tables).0 + 4 * entries(tables).1
}

/// Codes of 16 bits and numbers of 32 in tables.
fn entries(tables: &Tables) -> (usize, usize) {
    tables.parts::<LINE>().fold((0, 0), |(codes, values), parcel| match parcel {
        estimator::Parcel::Codes { codes: line, .. } => (codes + line.len(), values),
        estimator::Parcel::Values { values: list, .. } => (codes, values + list.len()),
        _ => (codes, values),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::rings;

    /// Measured: 0.26 to 0.93 of what is stated.
    #[test]
    fn tables_are_as_good_as_they_state() {
        for ring in rings() {
            let green = crate::green::tables(&ring).unwrap();
            for plane in check(&ring, &green, 100, 1, || ()) {
                assert!(plane.rms < plane.stated_rms, "{}: {plane:?}", ring.name);
                assert!(plane.rms > 0.2 * plane.stated_rms, "{}: stated too generously: {plane:?}", ring.name);
                // beside the calibration error of a tune meter, 3e-4; quantisation of the tables
                assert!(plane.tune_max < 1e-4, "{plane:?}"); // measured 7e-5
                assert!(plane.bytes <= 64 * 1024, "{plane:?}");
            }
        }
    }
}
