//! An unknown linear element: something that focuses or couples the beam as no effect of the library does, such as a solenoid or a wiggler.
//!
//! Whatever happens between two instruments is, to first order in its strengths c, a thin element of Hamiltonian
//!
//! `h = sum of c_ij z_i z_j`, z = (x, x', y, y'),
//!
//! at any place there. Of the ten products four couple the planes. A solenoid is one combination of two of these, `h = c (x y' - y x')`: it turns both planes by
//! c, wherever in a straight it is; its focusing, of the order of c^2, is left out. With four free strengths the evidence pays for three that a solenoid does not
//! need, and two effects of the library beside each other may win.
//!
//! Source: A. J. Dragt, Lie Methods for Nonlinear Dynamics with Applications to Accelerator Physics, quadratic polynomials as generators of linear maps.

use twin::{Ring, Signature, Signatures};

use super::term::Term;

/// Share of the largest change of the readings by a form below which another one is not seen.
const SHOWN: f64 = 1e-3;

/// A form that the Hamiltonian of a thin linear element consists of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Form {
    /// `z_i z_j`, z = (x, x', y, y').
    Product([usize; 2]),
    /// `x y' - y x'`, which turns both planes.
    Rotation,
}

impl Form {
    /// All of them.
    fn all() -> impl Iterator<Item = Self> {
        (0..4).flat_map(|i| (i..4).map(move |j| Self::Product([i, j]))).chain([Self::Rotation])
    }

    /// Derivative with respect to its strength, at the entrance of a quadrupole.
    pub fn signature(self, signatures: &Signatures, ring: &Ring, quadrupole: usize) -> Signature {
        let signature = |product| signatures.of_thin_linear(ring.quadrupoles[quadrupole].element.into(), product);
        match self {
            Self::Product(product) => signature(product),
            Self::Rotation => {
                let mut turned = signature([0, 3]);
                turned += signature([1, 2]) * -1.0;
                turned
            }
        }
    }
}

/// What an unknown linear element does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Linear {
    /// It focuses or defocuses, in one plane or both.
    Focuses,
    /// It couples the planes, by a field or by a rotation.
    Couples,
    /// Both.
    FocusesAndCouples,
    /// It turns the planes, and does nothing else.
    Turns,
}

impl Linear {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Focuses, Self::Couples, Self::FocusesAndCouples, Self::Turns];

    /// True if its Hamiltonian has a form.
    pub fn has(self, form: Form) -> bool {
        match (self, form) {
            (Self::Turns, form) => form == Form::Rotation,
            (_, Form::Rotation) => false,
            (Self::FocusesAndCouples, Form::Product(_)) => true,
            (Self::Focuses | Self::Couples, Form::Product([i, j])) => ((i < 2) != (j < 2)) == (self == Self::Couples),
        }
    }

    /// As a predicate.
    pub(super) fn phrase(self) -> &'static str {
        match self {
            Self::Focuses => "focuses the beam",
            Self::Couples => "couples the planes",
            Self::FocusesAndCouples => "focuses the beam and couples the planes",
            Self::Turns => "couples the planes by turning them, as a solenoid does",
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
    /// Its forms, with the prior standard deviation of the strength of each.
    pub forms: Vec<(Form, f64)>,
}

impl Element {
    /// One whose forms each change the readings by `size` (rms); those that change them by much less than others do, such as those of a plane in which
    /// nothing was kicked, are left out.
    pub fn with_size(signatures: &Signatures, ring: &Ring, quadrupole: usize, does: Linear, size: f64) -> Self {
        let all = Self::signatures(signatures, ring, quadrupole);
        let some = all.into_iter().filter(|(form, _)| does.has(*form));
        Self { quadrupole, does, forms: some.map(|(form, signature)| (form, size / signature.rms())).collect() }
    }

    /// The forms at a quadrupole that a recording shows, with their signatures.
    pub(crate) fn signatures(signatures: &Signatures, ring: &Ring, quadrupole: usize) -> Vec<(Form, Signature)> {
        let mut all: Vec<_> = Form::all().map(|form| (form, form.signature(signatures, ring, quadrupole))).collect();
        let largest = all.iter().map(|(_, signature)| signature.rms()).fold(0.0, f64::max);
        all.retain(|(_, signature)| signature.rms() > SHOWN * largest);
        all
    }

    /// True for the same thing at the same place, whatever its size.
    pub(crate) fn is_like(&self, other: &Self) -> bool {
        self.quadrupole == other.quadrupole && self.does == other.does
    }

    /// True for a thin linear field of the library that is nearer to it than two quadrupoles are to each other, on average.
    pub fn holds(&self, term: &Term, ring: &Ring) -> bool {
        let at = ring.elements[ring.quadrupoles[self.quadrupole].element].s;
        let spacing = ring.circumference / ring.quadrupoles.len() as f64;
        term.kind.thin().is_some() && term.position(ring).is_some_and(|s| ring.distance(s, at) < spacing)
    }
}

#[cfg(test)]
mod tests {
    use twin::{Drives, Kind, Machine, Rf};

    use super::*;

    #[test]
    fn four_of_ten_products_couple_and_a_rotation_is_by_itself() {
        let count = |does: Linear| Form::all().filter(|form| does.has(*form)).count();
        assert_eq!(Linear::ALL.map(count), [6, 4, 10, 1]);
    }

    /// The readings of a solenoid in the drift before a quadrupole, of 0.5 mrad with either sign: its focusing, the same for both, is not in the difference.
    #[test]
    fn a_rotation_is_a_solenoid_anywhere_in_the_straight() {
        let (ring, recording) = crate::testing::template();
        let campaign = inference::Campaign::of(&ring, &recording).unwrap();
        let drives: Drives = crate::data::drives_of(&campaign);
        let machine = |ring: Ring| Machine::new(ring, Rf::FixedMomentum, &[]).unwrap();
        // the drift before a quadrupole, with nothing between that has a length
        let drift_before = |q: usize| {
            let before = (0..ring.quadrupoles[q].element).rev().find(|&at| ring.elements[at].length > 0.0)?;
            (ring.elements[before].kind == Kind::Drift).then_some((q, before))
        };
        let (quadrupole, drift) = (0..ring.quadrupoles.len()).find_map(drift_before).unwrap();
        let readings = |angle: f64| {
            let mut turned = ring.clone();
            let element = &mut turned.elements[drift];
            element.kind = Kind::Solenoid { ks: 2.0 * angle / element.length };
            machine(turned).readings(&drives).unwrap().0
        };
        let angle = 5e-4;
        let exact = (readings(angle) - readings(-angle)) / (2.0 * angle);
        let design = machine(ring.clone());
        let signatures = Signatures::of(&design, &drives).unwrap();
        let turned = Form::Rotation.signature(&signatures, &ring, quadrupole).readings;
        let scale = turned.dot(&exact) / exact.norm_squared();
        assert!((scale.abs() - 1.0).abs() < 1e-3, "{scale}");
        assert!((turned - &exact * scale).norm() < 1e-3 * exact.norm(), "beside the first order");
    }
}
