//! Closed orbit of a ring, at fixed momentum or at fixed RF frequency.

use nalgebra::{Matrix5, Matrix6, Vector5};

use crate::lattice::Ring;
use crate::map::{DELTA, PATH, Phase};

/// What the machine holds constant while the orbit changes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Hold {
    /// The momentum, at `1 + delta` times the reference.
    Momentum {
        /// Relative momentum deviation [1].
        delta: f64,
    },
    /// The revolution frequency, at `1 + offset` times that of the reference particle on the reference orbit; the
    /// momentum follows the path length.
    Frequency {
        /// Relative frequency deviation [1].
        offset: f64,
    },
}

/// Why there is no closed orbit, or no stable motion about it.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum OrbitError {
    /// The linear motion is unstable.
    #[error("unstable motion: half trace {half_trace:.6} of normal mode {mode}, stable within -1..1")]
    Unstable {
        /// `x` or `y`, the plane that the mode belongs to without coupling.
        mode: char,
        /// Half the trace of the mode's one-turn matrix, the cosine of its phase advance.
        half_trace: f64,
    },
    /// The coupled motion lies on a sum resonance: its eigenvalues leave the unit circle in pairs.
    #[error("unstable motion: coupling opens a sum resonance, discriminant {discriminant:.3e} below 0")]
    SumResonance {
        /// Square of half the difference of the modes' traces [1].
        discriminant: f64,
    },
    /// The closure equations are singular: at an integer tune every kick drives an infinite orbit, and with a fixed
    /// frequency at transition every path drives an infinite momentum.
    #[error(
        "integer resonance or transition: determinant {determinant:.3e} of (1 - one-turn matrix), half traces {half_traces:.6?}"
    )]
    Integer {
        /// Determinant of the closure equations.
        determinant: f64,
        /// Half traces of the horizontal and vertical blocks.
        half_traces: [f64; 2],
    },
    /// Newton's steps did not settle.
    #[error("closed orbit not found: residual {residual:.3e} m after {steps} steps")]
    NotConverged {
        /// Largest component of the residual.
        residual: f64,
        /// Steps taken.
        steps: usize,
    },
}

/// The closed orbit at the start of the ring, and the linear map from there to the entrance of every element.
#[derive(Debug, Clone)]
pub struct ClosedOrbit {
    /// Orbit at the entrance of every element, and once more at the end of the ring.
    pub at: Vec<Phase<f64>>,
    /// Linear map from the start to the entrance of every element, and to the end of the ring (the one-turn matrix).
    pub transfer: Vec<Matrix6<f64>>,
}

/// Newton converges quadratically; from a reference orbit a few millimetres off it takes three or four steps.
const STEPS: usize = 20;

/// Steps of a chord before Newton's are tried.
const CHORDS: usize = 14;

/// Largest residual of a closed orbit [m, rad]; the maps round at about 1e-15.
const TOLERANCE: f64 = 1e-12;

impl ClosedOrbit {
    /// Find it from the axis.
    ///
    /// # Errors
    /// [`OrbitError::Integer`] or [`OrbitError::NotConverged`].
    pub fn find(ring: &Ring, hold: Hold) -> Result<Self, OrbitError> {
        let axis = Self::trace(ring, Phase::zeros());
        if hold == (Hold::Momentum { delta: 0.0 }) && axis.end() == &axis.at[0] {
            return Ok(axis);
        }
        Self::near(ring, hold, &axis)
    }

    /// Find it by Newton's method.
    fn newton(ring: &Ring, hold: Hold) -> Result<Self, OrbitError> {
        let mut start = Phase::<f64>::zeros();
        if let Hold::Momentum { delta } = hold {
            start[DELTA] = delta;
        }
        let (mut residual, mut steps) = (f64::INFINITY, 0);
        while steps < STEPS {
            let turn = Self::trace(ring, start);
            let miss = hold.miss(ring, &start, turn.end());
            residual = miss.abs().max();
            if residual < TOLERANCE {
                return Ok(turn);
            }
            steps += 1;
            if !residual.is_finite() {
                break;
            }
            let step = invert(&hold.closure(ring, start[DELTA], turn.one_turn()), turn.one_turn())? * miss;
            advance(&mut start, &step);
        }
        Err(OrbitError::NotConverged { residual, steps })
    }

    /// Find it from the orbit of a ring that differs little: the steps of a chord, whose slope is the known one-turn matrix,
    /// need no derivatives, and with kicks of 0.2 mrad five suffice. Where they do not, Newton starts from nothing.
    ///
    /// # Errors
    /// As [`ClosedOrbit::find`].
    pub fn near(ring: &Ring, hold: Hold, known: &Self) -> Result<Self, OrbitError> {
        let mut start = known.at[0];
        if let Hold::Momentum { delta } = hold {
            start[DELTA] = delta;
        }
        let slope = invert(&hold.closure(ring, start[DELTA], known.one_turn()), known.one_turn())?;
        for _ in 0..CHORDS {
            let mut end = start;
            ring.elements.iter().for_each(|element| element.track(&mut end));
            let miss = hold.miss(ring, &start, &end);
            // which leaves a tenth or less of the residual
            advance(&mut start, &(slope * miss));
            if miss.abs().max() < TOLERANCE {
                return Ok(Self::trace(ring, start));
            }
        }
        Self::newton(ring, hold)
    }

    /// Carry one ray around the ring.
    fn trace(ring: &Ring, start: Phase<f64>) -> Self {
        let (mut z, mut map) = (start, Matrix6::identity());
        let places = ring.elements.len() + 1;
        let (mut at, mut transfer) = (Vec::with_capacity(places), Vec::with_capacity(places));
        for element in &ring.elements {
            at.push(z);
            transfer.push(map);
            map = element.linearise(&mut z) * map;
        }
        at.push(z);
        transfer.push(map);
        Self { at, transfer }
    }

    /// Linear map of the whole turn.
    pub fn one_turn(&self) -> &Matrix6<f64> {
        &self.transfer[self.transfer.len() - 1]
    }

    /// Orbit after the whole turn; differs from the start in its path only.
    pub fn end(&self) -> &Phase<f64> {
        &self.at[self.at.len() - 1]
    }
}

/// One step of the start: orbit and momentum; the path starts at zero.
fn advance(start: &mut Phase<f64>, step: &Vector5<f64>) {
    start.iter_mut().zip(step).for_each(|(z, step)| *z += step);
}

impl Hold {
    /// How far a ray misses closing on itself, and on the time of a turn: `(dx, dpx, dy, dpy, dpath)`.
    fn miss(&self, ring: &Ring, start: &Phase<f64>, end: &Phase<f64>) -> Vector5<f64> {
        let fifth = match self {
            Hold::Momentum { .. } => 0.0,
            Hold::Frequency { offset } => {
                let p = &ring.particle;
                let speed = p.beta(start[DELTA]) / p.beta(0.0);
                end[PATH] + ring.circumference * (1.0 - speed / (1.0 + offset))
            }
        };
        Vector5::new(end[0] - start[0], end[1] - start[1], end[2] - start[2], end[3] - start[3], fifth)
    }

    /// Matrix `A` of the closure equations `A (z, delta) = M c` for a kick `c`, rows as in [`Hold::miss`].
    ///
    /// A turn takes the time path/speed, and `d(speed)/speed = d(delta)/(gamma^2 (1 + delta))`.
    pub(crate) fn closure(&self, ring: &Ring, delta: f64, one_turn: &Matrix6<f64>) -> Matrix5<f64> {
        let mut a = -one_turn.fixed_view::<5, 5>(0, 0).into_owned();
        for i in 0..4 {
            a[(i, i)] += 1.0;
        }
        match self {
            Hold::Momentum { .. } => a.set_row(4, &nalgebra::RowVector5::new(0.0, 0.0, 0.0, 0.0, 1.0)),
            Hold::Frequency { offset } => {
                let p = &ring.particle;
                let gamma = p.gamma(delta);
                let length = ring.circumference * p.beta(delta) / p.beta(0.0) / (1.0 + offset);
                a.set_row(4, &-one_turn.fixed_view::<1, 5>(PATH, 0));
                a[(4, 4)] += length / (gamma * gamma * (1.0 + delta));
            }
        }
        a
    }
}

/// Inverse of the closure equations, or the resonance that forbids it.
pub(crate) fn invert(closure: &Matrix5<f64>, one_turn: &Matrix6<f64>) -> Result<Matrix5<f64>, OrbitError> {
    let half_traces = [0, 2].map(|i| 0.5 * (one_turn[(i, i)] + one_turn[(i + 1, i + 1)]));
    let determinant = closure.determinant();
    // Rounding of a product of a few hundred maps; at a determinant of 1e-10 a 0.2 mrad kick drives metres.
    if determinant.is_nan() || determinant.abs() < 1e-10 {
        return Err(OrbitError::Integer { determinant, half_traces });
    }
    closure.try_inverse().ok_or(OrbitError::Integer { determinant, half_traces })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frequency_step_moves_the_momentum_by_the_slip_factor() {
        let ring = Ring::booster();
        let optics = crate::Optics::of(&ring, Hold::Momentum { delta: 0.0 }).unwrap();
        let eta = optics.momentum_compaction() - ring.particle.gamma(0.0).powi(-2);
        assert!((eta + 0.0997).abs() < 1e-3, "slip factor {eta}");
        let orbit = ClosedOrbit::find(&ring, Hold::Frequency { offset: 1e-6 }).unwrap();
        // second order in the offset: 1e-6 relative
        assert!((orbit.at[0][DELTA] * eta / -1e-6 - 1.0).abs() < 1e-4);
    }

    #[test]
    fn a_nearby_orbit_leads_to_the_same_one() {
        let design = Ring::booster();
        let mut ring = design.with_vars(&[1.002; 48]);
        let quadrupole = ring.quadrupoles[7].element;
        ring.elements[quadrupole].misalignment.dx = 1e-3;
        ring.set_kick(3, 2e-4);
        for hold in [Hold::Momentum { delta: 1e-3 }, Hold::Frequency { offset: 2e-4 }] {
            let known = ClosedOrbit::find(&design, hold).unwrap();
            let (found, near) = (ClosedOrbit::newton(&ring, hold), ClosedOrbit::near(&ring, hold, &known));
            let from_axis = ClosedOrbit::find(&ring, hold).unwrap().at[0];
            let found = found.unwrap().at[0];
            let apart = [near.unwrap().at[0], from_axis].map(|other| (found - other).abs().max());
            assert!(apart.iter().all(|apart| *apart < 1e-11), "{apart:?}"); // the residual of both over the distance from the integer
        }
    }

    #[test]
    fn a_ring_without_focusing_is_refused() {
        let ring = Ring::paper_booster(); // dipoles of the other one focus a little in both planes
        let error = crate::Optics::of(&ring.with_vars(&[0.0; 48]), Hold::Momentum { delta: 0.0 }).unwrap_err();
        assert!(error.to_string().contains("half traces"), "{error}");
    }
}
