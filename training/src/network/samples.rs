//! Samples: one corrector at -22 A or 22 A in a machine with other vars, as in the published training set.

use estimator::surrogate::{CORRECTOR, CURRENTS, LAST_VAR, ORBIT, SETTING_KICK, SPAN};
use nalgebra::DMatrix;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use twin::{Currents, Hold, Optics, Ring, VariedRing, sobol};

use super::settings::of_var;

/// Largest distance of a tune from the design that the paper's data allow.
pub const TUNE_CUT: f64 = 0.05;
/// Setting of a corrector [A].
pub const SETTING: f64 = 22.0;
/// Kick of a corrector [rad/A].
const KICK: f64 = SETTING_KICK as f64 / SETTING;
/// Standard deviation of every corrector's read-back about its setting [A], as recorded.
const RIPPLE: f64 = 0.02;
/// Standard deviation of the magnets' currents over nominal, as published of the dipoles, with which quadrupoles are in series; sextupoles act on no response.
pub const WIDTHS: [f64; CURRENTS] = [6e-4, 6e-4, 6e-4, 0.2, 0.2];

/// What makes samples.
#[derive(Debug)]
pub struct Source {
    ring: Ring,
    varied: VariedRing,
    /// Response of the design [m/rad], rows monitors, columns correctors.
    pub design: DMatrix<f64>,
    tunes: [f64; 2],
    /// Supply of each quadrupole: 1 QH, 2 QV among the currents.
    currents: Vec<usize>,
    /// Integrated gradient by supply, a polynomial in its current over nominal.
    gradients: Vec<Vec<f64>>,
    /// Monitors and correctors of x.
    first: (usize, usize),
}

/// By the supply law; without one in proportion to the current.
fn gradient(ring: &Ring, supply: &str) -> Vec<f64> {
    let by_law = |law: &Currents| Some(law.quadrupoles.get(supply)?.integrated.over(law.supply(supply)?));
    ring.currents.as_ref().and_then(by_law).unwrap_or_else(|| vec![0.0, 1.0])
}

/// Samples of one plane, a column each.
#[derive(Debug, Clone)]
pub struct Samples {
    /// Inputs: correctors, currents, vars.
    pub inputs: DMatrix<f32>,
    /// Orbit less that of the design, over [`Source::scale`].
    pub targets: DMatrix<f32>,
}

/// A machine.
struct Drawn {
    inputs: Vec<f32>,
    /// [m/A], for both planes.
    response: DMatrix<f64>,
}

impl Source {
    /// Of a ring.
    pub fn of(ring: &Ring) -> Self {
        let optics = Optics::of(ring, Hold::Momentum { delta: 0.0 }).expect("a stable design");
        let tunes = optics.tunes().expect("a stable design");
        let varied = VariedRing::of(ring).expect("a stable design");
        Self {
            design: optics.response(&optics.read_monitors(), &optics.correctors()),
            tunes: [tunes.x.fract(), tunes.y.fract()],
            currents: ring.quadrupoles.iter().map(|q| 1 + q.supply.expect("a supply each")).collect(),
            gradients: ring.supplies.iter().map(|supply| gradient(ring, &supply.name)).collect(),
            first: (ring.horizontal_monitors(), ring.horizontal_correctors()),
            ring: ring.clone(),
            varied,
        }
    }

    /// Orbits of the design for the setting of each corrector of a plane [m], rows monitors.
    pub fn design_orbits(&self, plane: usize) -> DMatrix<f64> {
        let (monitors, correctors) = (self.monitors(plane), self.correctors(plane));
        let design = self.design.view((monitors.start, correctors.start), (monitors.len(), correctors.len()));
        design * f64::from(SETTING_KICK)
    }

    /// Inputs of the network.
    pub fn inputs(&self, plane: usize) -> usize {
        self.correctors(plane).len() + CURRENTS + self.ring.parameters.len()
    }

    /// Monitors of a plane.
    pub fn monitors(&self, plane: usize) -> core::ops::Range<usize> {
        if plane == 0 { 0..self.first.0 } else { self.first.0..self.design.nrows() }
    }

    /// Correctors of a plane.
    pub fn correctors(&self, plane: usize) -> core::ops::Range<usize> {
        if plane == 0 { 0..self.first.1 } else { self.first.1..self.design.ncols() }
    }

    /// Samples of both planes of so many machines within the tune cut, each with every corrector once; those of one seed are points
    /// of one Sobol sequence.
    pub fn samples(&self, machines: usize, seed: u64) -> [Samples; 2] {
        let mut random = StdRng::seed_from_u64(seed);
        let scramble = random.random::<u32>();
        let drawn: Vec<_> = (0..).filter_map(|i| self.draw(i, scramble)).take(machines).collect();
        [0, 1].map(|plane| self.of_plane(&drawn, plane, &mut random))
    }

    fn draw(&self, i: u32, seed: u32) -> Option<Drawn> {
        let point = |d| sobol(i, d, seed);
        let params = self.ring.parameters.len();
        let vars: Vec<f64> = (0..params).map(|d| 1.0 + f64::from(SPAN) * (2.0 * point(d) - 1.0)).collect();
        // evenly over as wide a range as three of the normal's widths
        let currents: [f64; CURRENTS] = core::array::from_fn(|i| 3.0 * WIDTHS[i] * (2.0 * point(params + i) - 1.0));
        let momentum = 1.0 + currents[0];
        let factor = |supply: usize| {
            let gradient = |current: f64| self.gradients[supply - 1].iter().rev().fold(0.0, |sum, c| sum * current + c);
            gradient(1.0 + currents[supply]) / gradient(1.0) / momentum
        };
        let each = self.ring.quadrupoles.iter().zip(&self.currents);
        let factors: Vec<f64> =
            each.map(|(q, supply)| q.parameter.map_or(1.0, |p| vars[p]) * factor(*supply)).collect();
        let optics = self.varied.at(&factors).ok()?;
        let is_near = |(tune, design): (f64, &f64)| (tune - design).abs() <= TUNE_CUT;
        if !optics.tunes().into_iter().zip(&self.tunes).all(is_near) {
            return None;
        }
        let inputs = currents.iter().zip(WIDTHS).map(|(c, width)| (c / width) as f32 / LAST_VAR);
        let inputs = inputs.chain(vars.iter().map(|var| of_var(*var))).collect();
        let response = optics.response().columns(0, self.design.ncols()) * (KICK / momentum);
        Some(Drawn { inputs, response })
    }

    fn of_plane(&self, drawn: &[Drawn], plane: usize, random: &mut StdRng) -> Samples {
        let (monitors, correctors) = (self.monitors(plane), self.correctors(plane));
        let (b, c) = (monitors.len(), correctors.len());
        let design = self.design.view((monitors.start, correctors.start), (b, c)) * KICK;
        let count = drawn.len() * c;
        let mut order: Vec<usize> = (0..count).collect();
        for i in (1..count).rev() {
            order.swap(i, random.random_range(0..=i));
        }
        let mut samples =
            Samples { inputs: DMatrix::zeros(self.inputs(plane), count), targets: DMatrix::zeros(b, count) };
        for (at, sample) in order.into_iter().enumerate() {
            let (machine, corrector) = (&drawn[sample / c], sample % c);
            let current = |j: usize| {
                let ripple: f64 = StandardNormal.sample(random);
                RIPPLE * ripple + if j == corrector { SETTING } else { 0.0 }
            };
            let currents = nalgebra::DVector::from_iterator(c, (0..c).map(current));
            let response = machine.response.view((monitors.start, correctors.start), (b, c)) - &design;
            let orbit = response * &currents / f64::from(ORBIT);
            samples.targets.column_mut(at).iter_mut().zip(&orbit).for_each(|(to, orbit)| *to = *orbit as f32);
            let inputs =
                currents.iter().map(|i| (i / SETTING) as f32 * CORRECTOR).chain(machine.inputs.iter().copied());
            samples.inputs.column_mut(at).iter_mut().zip(inputs).for_each(|(to, input)| *to = input);
        }
        samples
    }
}
