//! Beta functions and phase advances, of each plane's 2x2 block: exact without coupling.

use core::f64::consts::{FRAC_PI_2, TAU};

use nalgebra::Matrix6;

use crate::lattice::{Element, Kind, Plane};
use crate::map::{DELTA, Phase, X, Y};
use crate::modes::Modes;
use crate::orbit::OrbitError;
use crate::response::{Optics, Place};

/// Linear optics at one place, horizontal and vertical.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Twiss {
    /// Beta functions [m].
    pub beta: [f64; 2],
    /// Phase advance from the start of the ring [rad].
    pub phase_advance: [f64; 2],
    /// Dispersion [m].
    pub dispersion: [f64; 2],
}

/// Most pieces of one element; what turns the phase by more is no magnet.
const MOST_PIECES: f64 = 1000.0;

impl Optics<'_> {
    /// Optics at the entrance of every element, and once more at the end of the ring.
    ///
    /// # Errors
    /// [`OrbitError`] of unstable motion.
    pub fn twiss(&self) -> Result<Vec<Twiss>, OrbitError> {
        Modes::of(self.orbit.one_turn())?;
        let [x, y] = [Plane::X, Plane::Y].map(|plane| self.phase_advances(plane));
        let at = |(element, transfer): (usize, &Matrix6<f64>)| Twiss {
            beta: [X, Y].map(|i| beta(self.start_twiss(i), transfer, i)),
            phase_advance: [x[element], y[element]],
            dispersion: [X, Y].map(|i| (transfer.row(i) * self.dispersive)[0]),
        };
        Ok(self.orbit.transfer.iter().enumerate().map(at).collect())
    }

    /// Beta function at a place [m].
    pub fn beta(&self, place: impl Into<Place>, plane: Plane) -> f64 {
        let i = index(plane);
        beta(self.start_twiss(i), &self.transfer(place.into()), i)
    }

    /// Phase advance from the start to the entrance of every element, and to the end of the ring [rad].
    pub(crate) fn phase_advances(&self, plane: Plane) -> Vec<f64> {
        let i = index(plane);
        let (start, mut total, mut last) = (self.start_twiss(i), 0.0, 0.0);
        let mut advances = vec![0.0];
        for element in 0..self.ring.elements.len() {
            for transfer in self.pieces(element) {
                let phase = phase(start, &transfer, i);
                let step: f64 = phase - last;
                total += step - TAU * (step / TAU).round(); // no piece advances by half a turn
                last = phase;
            }
            advances.push(total);
        }
        advances
    }

    /// Transfer maps from the start into an element, in the ring's axes, so close that between them no plane advances by half
    /// a turn; the last one to its exit.
    fn pieces(&self, element: usize) -> impl Iterator<Item = Matrix6<f64>> {
        let of = &self.ring.elements[element];
        let pieces = pieces(of, self.orbit(element));
        let upright = of.misalignment.rotation().transpose();
        let inside = move |piece: usize| Place { element, depth: of.length * piece as f64 / pieces as f64 };
        let within = (1..pieces).map(move |piece| upright * self.transfer_into(inside(piece)));
        within.chain([self.orbit.transfer[element + 1]])
    }

    /// Beta [m] and alpha of the 2x2 block at the start.
    fn start_twiss(&self, i: usize) -> (f64, f64) {
        let m = self.orbit.one_turn();
        let cos = 0.5 * (m[(i, i)] + m[(i + 1, i + 1)]);
        let sin = (1.0 - cos * cos).max(f64::MIN_POSITIVE).sqrt().copysign(m[(i, i + 1)]);
        (m[(i, i + 1)] / sin, 0.5 * (m[(i, i)] - m[(i + 1, i + 1)]) / sin)
    }
}

fn index(plane: Plane) -> usize {
    if plane == Plane::X { X } else { Y }
}

fn beta((beta, alpha): (f64, f64), transfer: &Matrix6<f64>, i: usize) -> f64 {
    let (m11, m12) = (transfer[(i, i)], transfer[(i, i + 1)]);
    ((beta * m11 - alpha * m12).powi(2) + m12 * m12) / beta
}

fn phase((beta, alpha): (f64, f64), transfer: &Matrix6<f64>, i: usize) -> f64 {
    let (m11, m12) = (transfer[(i, i)], transfer[(i, i + 1)]);
    m12.atan2(beta * m11 - alpha * m12)
}

/// Pieces of an element that each turn the phase of any ray by less than half a turn: `x'' = -k x` turns it by exactly `pi`
/// every `pi/sqrt(k)`, whatever enters, and what does not focus by less however long it is (Sturm's comparison).
fn pieces(element: &Element, orbit: &Phase<f64>) -> usize {
    let focusing = match &element.kind {
        Kind::Quadrupole { k1 } => k1.abs(),
        Kind::Bend(bend) => (bend.curvature.powi(2) + bend.k1).abs().max(bend.k1.abs()),
        Kind::Sextupole { k2 } => k2.abs() * orbit[X].hypot(orbit[Y]),
        Kind::Solenoid { ks } => 0.25 * ks * ks,
        _ => 0.0,
    };
    let rotation = element.length * (focusing / (1.0 + orbit[DELTA])).sqrt();
    (rotation / FRAC_PI_2).ceil().clamp(1.0, MOST_PIECES) as usize
}
