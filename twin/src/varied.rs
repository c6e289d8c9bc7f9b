//! The ring with nothing but its quadrupoles free: response, dispersion and their gradient in a fraction of the time of
//! [`Optics`], for a sampler that needs a hundred thousand of them.
//!
//! What lies between two quadrupoles never changes and is multiplied out once. The rest is the formula of
//! [`crate::response`]: with `a` the row of an observer and `c` the column of a source, both brought to the ring's start,
//!
//! `R = a (W + step) c`, `dR/dk = -a (W + step) Q (W + step) c`.
//!
//! A scalar function of all responses needs its gradient only, not the Jacobian: with `w = df/dR`,
//!
//! `df/dk = -tr(Q P)`, `P = sum of w (W + step) c a (W + step)`,
//!
//! and `P` changes from one quadrupole to the next only by the observers and sources in between. The RF frequency is one
//! more source, whose column is the dispersion: an orbit `-D/eta` for a unit of relative frequency offset.
//!
//! Exact on the reference orbit; off it the gradients would also move the orbit (see [`crate::response`]).
//!
//! Source: the adjoint (reverse) form of the response's derivative; S. Y. Lee, Accelerator Physics, ch. 2.

use nalgebra::{DMatrix, Matrix2, Matrix6, RowVector6, Vector6};

use crate::lattice::{Kind, Ring};
use crate::map::{PATH, X, Y, inverse};
use crate::modes::Modes;
use crate::orbit::{Hold, OrbitError};
use crate::response::{Optics, close_at_momentum};

/// A ring as a chain of quadrupoles and of what lies between them.
#[derive(Debug, Clone)]
pub struct VariedRing {
    design: Ring,
    /// What comes before each quadrupole, and after the last.
    stretches: Vec<Stretch>,
    quadrupoles: Vec<Quadrupole>,
    monitors: usize,
    correctors: usize,
    /// `1/gamma^2`.
    inverse_gamma_squared: f64,
}

/// The part of the ring between two quadrupoles, in the frame of its start.
#[derive(Debug, Clone)]
struct Stretch {
    map: Matrix6<f64>,
    back: Matrix6<f64>,
    /// Monitors and correctors in it, along the beam.
    instruments: Vec<Instrument>,
}

#[derive(Debug, Clone)]
enum Instrument {
    /// A monitor's index, and the row that it sees.
    Monitor(usize, RowVector6<f64>),
    /// A corrector's index, and the column of its unit kick.
    Corrector(usize, Vector6<f64>),
}

#[derive(Debug, Clone)]
struct Quadrupole {
    /// Index into [`Ring::quadrupoles`].
    index: usize,
    k1: f64,
    length: f64,
    /// From the ring's axes to its own.
    roll: Matrix6<f64>,
}

/// The optics at given strengths.
#[derive(Debug, Clone)]
pub struct VariedOptics<'r> {
    ring: &'r VariedRing,
    /// Row of each monitor, brought to the start.
    observers: Vec<RowVector6<f64>>,
    /// Column of each corrector, brought to the start.
    sources: Vec<Vector6<f64>>,
    /// `Q` of each quadrupole, order of [`Ring::quadrupoles`]: `k1 strength` times that of a unit of gradient.
    kernels: Vec<Matrix6<f64>>,
    closed: Matrix6<f64>,
    dispersive: Vector6<f64>,
    /// What a source at the start adds to the path of a turn.
    path: RowVector6<f64>,
    slip: f64,
    turn: Matrix6<f64>,
    modes: Modes,
}

impl VariedRing {
    /// Split a ring at its quadrupoles.
    ///
    /// # Errors
    /// [`OrbitError`] if it has no closed orbit.
    ///
    /// # Panics
    /// If a place that is said to hold a quadrupole does not.
    pub fn of(ring: &Ring) -> Result<Self, OrbitError> {
        let optics = Optics::of(ring, Hold::Momentum { delta: 0.0 })?;
        let mut along: Vec<(usize, usize)> = ring.quadrupoles.iter().map(|q| q.element).zip(0..).collect();
        along.sort_unstable();
        let quadrupoles = along.iter().map(|&(element, index)| Quadrupole::of(ring, element, index)).collect();
        // each stretch from the end of one quadrupole (or the ring's start) to the entrance of the next (or the end)
        let starts = core::iter::once(0).chain(along.iter().map(|&(element, _)| element + 1));
        let ends = along.iter().map(|&(element, _)| element).chain([ring.elements.len()]);
        let (observers, sources) = (optics.read_monitors(), optics.correctors());
        let stretches = starts.zip(ends).map(|(from, to)| {
            let transfer = &optics.closed_orbit().transfer;
            let (at_start, back) = (transfer[from], inverse(&transfer[from]));
            let map = transfer[to] * back;
            let seen = observers.iter().enumerate().map(|(b, o)| (o.place, 0, Instrument::Monitor(b, o.row * back)));
            // where both stand at one place, a monitor does not yet see the corrector's kick
            let sent =
                sources.iter().enumerate().map(|(c, s)| (s.place, 1, Instrument::Corrector(c, at_start * s.column)));
            let mut within: Vec<_> =
                seen.chain(sent).filter(|(place, ..)| (from..to).contains(&place.element)).collect();
            within.sort_by(|one, other| (one.0, one.1).partial_cmp(&(other.0, other.1)).expect("places are numbers"));
            Stretch {
                map,
                back: inverse(&map),
                instruments: within.into_iter().map(|(.., instrument)| instrument).collect(),
            }
        });
        Ok(Self {
            stretches: stretches.collect(),
            quadrupoles,
            monitors: observers.len(),
            correctors: sources.len(),
            inverse_gamma_squared: ring.particle.gamma(0.0).powi(-2),
            design: ring.clone(),
        })
    }

    /// The optics with each quadrupole's gradient multiplied by its factor `[M]`; at params and supplies, that of
    /// [`Ring::strengths`].
    ///
    /// # Errors
    /// [`OrbitError`] without a closed orbit or stable motion.
    pub fn at(&self, factors: &[f64]) -> Result<VariedOptics<'_>, OrbitError> {
        let (mut map, mut back) = (Matrix6::identity(), Matrix6::identity());
        let mut observers = vec![RowVector6::zeros(); self.monitors];
        let mut sources = vec![Vector6::zeros(); self.correctors];
        let mut kernels = vec![Matrix6::zeros(); self.quadrupoles.len()];
        for (i, stretch) in self.stretches.iter().enumerate() {
            for instrument in &stretch.instruments {
                match instrument {
                    Instrument::Monitor(b, row) => observers[*b] = row * map,
                    Instrument::Corrector(c, column) => sources[*c] = back * column,
                }
            }
            (map, back) = (stretch.map * map, back * stretch.back);
            if let Some(quadrupole) = self.quadrupoles.get(i) {
                let k1 = quadrupole.k1 * factors[quadrupole.index];
                kernels[quadrupole.index] = back * quadrupole.kernel(k1) * map;
                (map, back) =
                    (quadrupole.map(k1, quadrupole.length) * map, back * quadrupole.map(k1, -quadrupole.length));
            }
        }
        let modes = Modes::of(&map)?;
        let (closed, dispersive) = close_at_momentum(&self.design, 0.0, &map)?;
        let path = map.row(PATH) * (closed + Matrix6::identity());
        let compaction = (map.row(PATH) * dispersive)[0] / self.design.circumference;
        let slip = compaction - self.inverse_gamma_squared;
        Ok(VariedOptics { ring: self, observers, sources, kernels, closed, dispersive, path, slip, turn: map, modes })
    }
}

impl Quadrupole {
    fn of(ring: &Ring, element: usize, index: usize) -> Self {
        let element = &ring.elements[element];
        let Kind::Quadrupole { k1 } = element.kind else { panic!("{} is no quadrupole", element.name) };
        Self { index, k1, length: element.length, roll: element.misalignment.rotation() }
    }

    fn rolled(&self, own: Matrix6<f64>) -> Matrix6<f64> {
        self.roll.transpose() * own * self.roll
    }

    /// Linear map over `length` [m], which may be negative: the way back.
    fn map(&self, k1: f64, length: f64) -> Matrix6<f64> {
        let mut own = Matrix6::identity();
        for (at, k) in [(X, k1), (Y, -k1)] {
            let (c, s) = focusing(k, length);
            own.fixed_view_mut::<2, 2>(at, at).copy_from(&Matrix2::new(c, s, -k * s, c));
        }
        self.rolled(own)
    }

    /// `integral of M^-1 E M ds` from the entrance, `E` the kick of a unit of `ln` gradient: `(x', y') = k1 (x, -y)`.
    ///
    /// With `C` and `S` of one plane, `M^-1 E M = k (-S C, -S^2; C^2, C S)`.
    fn kernel(&self, k1: f64) -> Matrix6<f64> {
        let mut own = Matrix6::zeros();
        for (at, k) in [(X, k1), (Y, -k1)] {
            let (c, s) = focusing(k, self.length);
            // integrals of C^2 and C S over the length, and k times that of S^2 = (1 - C^2)/k
            let (cc, cs) = (0.5 * (self.length + c * s), 0.5 * s * s);
            let kss = self.length - cc;
            own.fixed_view_mut::<2, 2>(at, at).copy_from(&Matrix2::new(-k * cs, -kss, k * cc, k * cs));
        }
        self.rolled(own)
    }
}

/// `C = cos(sqrt(k) L)` and `S = sin(sqrt(k) L)/sqrt(k)`, hyperbolic for k < 0.
fn focusing(k: f64, length: f64) -> (f64, f64) {
    let root = k.abs().sqrt();
    match k {
        _ if root * length.abs() < 1e-6 => (1.0 - 0.5 * k * length * length, length),
        _ if k > 0.0 => ((root * length).cos(), (root * length).sin() / root),
        _ => ((root * length).cosh(), (root * length).sinh() / root),
    }
}

impl VariedOptics<'_> {
    /// Orbit at the read monitors for a unit kick of each corrector [m/rad], and, last, for a unit of relative RF frequency
    /// offset [m]: rows monitors, columns correctors and one more.
    pub fn response(&self) -> DMatrix<f64> {
        let rf = self.sources.len();
        let mut response = DMatrix::zeros(self.observers.len(), rf + 1);
        let mut sent: Vec<Vector6<f64>> = self.sources.iter().map(|source| self.closed * source).collect();
        for instrument in self.ring.stretches.iter().flat_map(|stretch| &stretch.instruments) {
            match *instrument {
                Instrument::Monitor(b, _) => {
                    sent.iter().enumerate().for_each(|(c, sent)| response[(b, c)] = (self.observers[b] * sent)[0]);
                    response[(b, rf)] = -self.dispersion(b) / self.slip;
                }
                // a source that is passed sends directly as well
                Instrument::Corrector(c, _) => sent[c] += self.sources[c],
            }
        }
        response
    }

    /// Dispersion at a read monitor [m].
    fn dispersion(&self, b: usize) -> f64 {
        (self.observers[b] * self.dispersive)[0]
    }

    /// Slip factor `alpha_c - 1/gamma^2` [1].
    pub fn slip_factor(&self) -> f64 {
        self.slip
    }

    /// Tunes without their integer part, in 0..1; that takes [`Optics::tunes`].
    pub fn tunes(&self) -> [f64; 2] {
        self.modes.fractions
    }

    /// Derivative of both tunes with respect to `ln` of each quadrupole's gradient `[M]`; by param, see [`Ring::by_parameter`].
    pub fn tune_slopes(&self) -> Vec<[f64; 2]> {
        let slopes = self.modes.slopes();
        self.kernels.iter().map(|kernel| Modes::tune_slope(&slopes, &self.turn, kernel)).collect()
    }

    /// Gradient with respect to `ln` of each quadrupole's gradient `[M]` (by param, see [`Ring::by_parameter`]) of a function of
    /// the response, from its derivative `weights` with respect to each entry of [`VariedOptics::response`].
    pub fn pull_back(&self, weights: &DMatrix<f64>) -> Vec<f64> {
        let rf = self.sources.len();
        let mut sent: Vec<Vector6<f64>> = self.sources.iter().map(|source| self.closed * source).collect();
        sent.push(self.dispersive * (-1.0 / self.slip));
        let mut seen: Vec<RowVector6<f64>> = self.observers.iter().map(|row| row * self.closed + row).collect();
        let seen_of = |c: usize, seen: &[RowVector6<f64>]| -> RowVector6<f64> {
            seen.iter().zip(weights.column(c).iter()).map(|(row, w)| row * *w).sum()
        };
        let mut pairs: Matrix6<f64> = sent.iter().enumerate().map(|(c, sent)| sent * seen_of(c, &seen)).sum();
        // the slip factor moves all readings of an RF offset alike
        let by_slip: f64 = (0..seen.len()).map(|b| weights[(b, rf)] * self.dispersion(b)).sum();
        pairs += self.dispersive * self.path * (by_slip / (self.slip * self.slip * self.ring.design.circumference));
        let mut gradient = vec![0.0; self.kernels.len()];
        for (i, stretch) in self.ring.stretches.iter().enumerate() {
            for instrument in &stretch.instruments {
                match *instrument {
                    Instrument::Monitor(b, _) => {
                        let row = weights.row(b);
                        let sent: Vector6<f64> = sent.iter().zip(row.iter()).map(|(sent, w)| sent * *w).sum();
                        pairs -= sent * self.observers[b];
                        seen[b] -= self.observers[b];
                    }
                    Instrument::Corrector(c, _) => {
                        pairs += self.sources[c] * seen_of(c, &seen);
                        sent[c] += self.sources[c];
                    }
                }
            }
            if let Some(Quadrupole { index, .. }) = self.ring.quadrupoles.get(i) {
                gradient[*index] = -self.kernels[*index].transpose().dot(&pairs);
            }
        }
        gradient
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::mixed;

    /// Params a few per cent off, and supplies.
    fn wrong(ring: &Ring) -> (Vec<f64>, Vec<f64>) {
        let params = (0..ring.parameters.len()).map(|i| 0.015 * f64::sin(3.0 * i as f64));
        (params.collect(), vec![0.002; ring.supplies.len()])
    }

    fn rings() -> [Ring; 2] {
        let mut rolled = Ring::booster();
        let at = rolled.quadrupoles[rolled.quadrupole("C3").unwrap()].element;
        rolled.elements[at].misalignment.roll = 0.02;
        [rolled, mixed()]
    }

    #[test]
    fn responses_and_tunes_are_those_of_the_whole_ring() {
        for ring in rings() {
            let (params, supplies) = wrong(&ring);
            let varied = VariedRing::of(&ring).unwrap();
            let whole = ring.with_strengths(&ring.strengths(&params, &supplies));
            let fast = varied.at(&ring.strengths(&params, &supplies)).unwrap();
            let optics = Optics::of(&whole, Hold::Momentum { delta: 0.0 }).unwrap();
            let expected = optics.response(&optics.read_monitors(), &optics.correctors());
            let response = fast.response();
            assert!((response.columns(0, 48) - &expected).amax() < 1e-10 * expected.amax());
            for (b, observer) in optics.read_monitors().iter().enumerate() {
                let rf = -optics.dispersion(observer) / optics.slip_factor();
                assert!((response[(b, 48)] - rf).abs() < 1e-9 * rf.abs().max(1.0), "{b}: {} {rf}", response[(b, 48)]);
            }
            let tunes = optics.tunes().unwrap();
            for (ours, known) in fast.tunes().into_iter().zip([tunes.x, tunes.y]) {
                assert!((ours - known.fract()).abs() < 1e-10, "{ours} {known}");
            }
        }
    }

    /// A random function of response and tunes, by central differences.
    #[test]
    fn gradients_are_those_of_response_and_tunes() {
        let weights = DMatrix::from_fn(33, 49, |b, c| f64::sin(7.1 * b as f64 + 2.3 * c as f64));
        for ring in rings() {
            let (params, supplies) = wrong(&ring);
            let varied = VariedRing::of(&ring).unwrap();
            let optics = varied.at(&ring.strengths(&params, &supplies)).unwrap();
            let gradient = ring.by_parameter(&optics.pull_back(&weights));
            let slopes = optics.tune_slopes();
            let tunes =
                [0, 1].map(|mode| ring.by_parameter(&slopes.iter().map(|slope| slope[mode]).collect::<Vec<_>>()));
            assert_eq!(gradient.len(), ring.parameters.len());
            for (q, slope) in gradient.iter().enumerate() {
                let value = |step: f64| {
                    let mut params = params.clone();
                    params[q] += step;
                    let optics = varied.at(&ring.strengths(&params, &supplies)).unwrap();
                    let [x, y] = optics.tunes();
                    [optics.response().dot(&weights), x, y]
                };
                let h = 3e-4;
                let (up, down, far_up, far_down) = (value(h), value(-h), value(2.0 * h), value(-2.0 * h));
                for (i, slope) in [*slope, tunes[0][q], tunes[1][q]].into_iter().enumerate() {
                    let known = (8.0 * (up[i] - down[i]) - far_up[i] + far_down[i]) / (12.0 * h);
                    // fourth order in a step that moves all 24 magnets of a family at once
                    assert!((slope / known - 1.0).abs() < 1e-6, "{q}, {i}: {slope} {known}");
                }
            }
        }
    }

    #[test]
    fn on_the_way_to_the_next_integer_motion_becomes_unstable() {
        let varied = VariedRing::of(&Ring::booster()).unwrap();
        let scattered = |i: i32| -> Vec<f64> {
            (0..48).map(|q| 1.0 + 2.5e-3 * f64::from(i) + 0.05 * f64::sin(3.0 * f64::from(q))).collect()
        };
        let mut scan = (0..40).map(|i| varied.at(&scattered(i)).map(|_| ()));
        assert!(scan.any(|optics| matches!(optics, Err(OrbitError::Unstable { half_trace, .. }) if half_trace > 1.0)));
    }
}
