//! An unknown linear element: something that focuses or couples the beam as no effect of the library does, such as a solenoid or a wiggler.
//!
//! Whatever happens between two instruments is, to first order in its strengths c, a thin element of Hamiltonian
//!
//! `h = sum of c_ij z_i z_j`, z = (x, x', y, y'),
//!
//! at any place there. Of the ten forms four couple the planes.
//!
//! Source: A. J. Dragt, Lie Methods for Nonlinear Dynamics with Applications to Accelerator Physics, quadratic polynomials as generators of linear maps.

use twin::{Ring, Signature, Signatures};

use super::hypothesis::Term;

/// Share of the largest change of the readings by a form below which another one is not seen.
const SHOWN: f64 = 1e-3;

/// What an unknown linear element does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Linear {
    /// It focuses or defocuses, in one plane or both.
    Focuses,
    /// It couples the planes, by a field or by a rotation.
    Couples,
    /// Both.
    FocusesAndCouples,
}

impl Linear {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Focuses, Self::Couples, Self::FocusesAndCouples];

    /// The terms `z_i z_j` of its Hamiltonian, z = (x, x', y, y').
    pub fn forms(self) -> impl Iterator<Item = [usize; 2]> {
        let all = (0..4).flat_map(|i| (i..4).map(move |j| [i, j]));
        all.filter(move |form| self.has(*form))
    }

    /// True if one of them is this.
    pub fn has(self, [i, j]: [usize; 2]) -> bool {
        let couples = (i < 2) != (j < 2);
        match self {
            Self::Focuses => !couples,
            Self::Couples => couples,
            Self::FocusesAndCouples => true,
        }
    }

    /// In a few words.
    pub(super) fn short(self) -> &'static str {
        match self {
            Self::Focuses => "focusing",
            Self::Couples => "coupling",
            Self::FocusesAndCouples => "focusing and coupling",
        }
    }

    /// As a predicate.
    pub(super) fn phrase(self) -> &'static str {
        match self {
            Self::Focuses => "focuses the beam",
            Self::Couples => "couples the planes",
            Self::FocusesAndCouples => "focuses the beam and couples the planes",
        }
    }
}

/// A thin linear element that the library does not hold, at the entrance of a quadrupole; to first order. In recordings at several energies it is a field
/// that does not grow with the magnets.
#[derive(Debug, Clone, PartialEq)]
pub struct Element {
    /// Index of the quadrupole.
    pub quadrupole: usize,
    /// What it does.
    pub does: Linear,
    /// Its forms `z_i z_j`, z = (x, x', y, y'), with the prior standard deviation of the strength of each.
    pub forms: Vec<([usize; 2], f64)>,
}

impl Element {
    /// One whose forms each change the readings by `size` (rms); those that change them by much less than others do, such as those of a plane in which
    /// nothing was kicked, are left out.
    pub fn of(signatures: &Signatures, ring: &Ring, quadrupole: usize, does: Linear, size: f64) -> Self {
        let all = Self::signatures(signatures, ring, quadrupole);
        let some = all.into_iter().filter(|(form, _)| does.has(*form));
        Self { quadrupole, does, forms: some.map(|(form, signature)| (form, size / signature.rms())).collect() }
    }

    /// The forms at a quadrupole that a recording shows, with their signatures.
    pub fn signatures(signatures: &Signatures, ring: &Ring, quadrupole: usize) -> Vec<([usize; 2], Signature)> {
        let at = ring.quadrupoles[quadrupole].element.into();
        let all = Linear::FocusesAndCouples.forms().map(|form| (form, signatures.of_thin_linear(at, form)));
        let mut all: Vec<_> = all.collect();
        let largest = all.iter().map(|(_, signature)| signature.rms()).fold(0.0, f64::max);
        all.retain(|(_, signature)| signature.rms() > SHOWN * largest);
        all
    }

    /// True for the same thing at the same place, whatever its size.
    pub fn is_like(&self, other: &Self) -> bool {
        self.quadrupole == other.quadrupole && self.does == other.does
    }

    /// True for a thin linear field of the library that is nearer to it than two quadrupoles are to each other, on average.
    pub fn holds(&self, term: &Term, ring: &Ring) -> bool {
        let at = ring.elements[ring.quadrupoles[self.quadrupole].element].s;
        let spacing = ring.circumference / ring.quadrupoles.len() as f64;
        term.kind.thin().is_some() && term.position(ring).is_some_and(|s| ring.distance(s, at) < spacing)
    }
}
