//! The derivative of a matrix by the machine's unknowns, made column by column: the whole of it is never stored.

use core::ops::{Add, Mul};
use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector};
use twin::{Gradient, Observer, Optics, ResponseFactors, Source};

/// What changes in an element.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Change {
    /// Its gradient.
    Normal,
    /// Its skew gradient.
    Skew,
    /// Its vertical focusing, as of a wiggler.
    Vertical,
}

/// A number of an element that an unknown changes, and by how much a unit of the unknown.
pub type Share = (usize, Change, f64);

/// The derivative by gradients that change together, one group an unknown, then by the share of a held RF frequency if that is one.
#[derive(Debug, Clone)]
pub struct ByMachine {
    rows: usize,
    /// Pieces of the corrector of each column.
    pieces: Vec<Vec<usize>>,
    /// Numbers that the unknowns change, with their shares of each.
    groups: Vec<Vec<(usize, f64)>>,
    /// Of each kind of hold, and what it counts.
    holds: Vec<(f64, OfHold)>,
    by_share: Option<DMatrix<f64>>,
}

/// Derivatives by every number that changes.
#[derive(Debug, Clone)]
struct OfHold {
    factors: ResponseFactors,
    /// Of the last column, if the dispersion was measured.
    dispersion: Option<DMatrix<f64>>,
}

impl ByMachine {
    /// About one closed orbit: what each unknown changes; what is seen and what kicks, the sources being the pieces of the correctors in order, so many of
    /// each; the change of the RF frequency [mm per unit] if the dispersion is the last column.
    pub fn about(
        optics: &Optics,
        unknowns: &[Vec<Share>],
        (observers, sources): (&[Observer], &[Source]),
        pieces: impl Iterator<Item = usize>,
        rf: Option<f64>,
    ) -> Self {
        let mut changes = BTreeMap::new();
        unknowns.iter().flatten().for_each(|&(element, change, _)| _ = changes.insert((element, change), 0));
        changes.values_mut().enumerate().for_each(|(number, at)| *at = number);
        let gradients: Vec<Gradient> =
            changes.keys().map(|&(element, change)| gradient(optics, element, change)).collect();
        let group = |group: &Vec<Share>| {
            group.iter().map(|&(element, change, share)| (changes[&(element, change)], share)).collect()
        };
        let mut next = 0;
        let pieces = pieces.map(|count| {
            next += count;
            (next - count..next).collect()
        });
        let dispersion = rf.map(|rf| optics.rf_jacobian(observers, &gradients) * rf);
        Self {
            rows: observers.len(),
            pieces: pieces.collect(),
            groups: unknowns.iter().map(group).collect(),
            holds: vec![(1.0, OfHold { factors: optics.response_factors(observers, sources, gradients), dispersion })],
            by_share: None,
        }
    }

    /// Between two kinds of hold, with the derivative by the share of the second one.
    pub fn towards(self, to: Self, share: f64, by_share: DMatrix<f64>) -> Self {
        let from = self.holds.into_iter().map(|(counts, hold)| (counts * (1.0 - share), hold));
        let to = to.holds.into_iter().map(|(counts, hold)| (counts * share, hold));
        Self { holds: from.chain(to).collect(), by_share: Some(by_share), ..self }
    }

    /// Unknowns.
    pub fn count(&self) -> usize {
        self.groups.len() + usize::from(self.by_share.is_some())
    }

    /// Derivatives of the elements of some columns in turn, rows elements.
    pub fn columns(&self, columns: &[usize]) -> DMatrix<f64> {
        let changes = self.over_holds(|hold| hold.columns(&self.pieces, columns, self.rows));
        let mut made = DMatrix::zeros(changes.nrows(), self.count());
        for (mut into, group) in made.column_iter_mut().zip(&self.groups) {
            group.iter().for_each(|&(number, share)| into.axpy(share, &changes.column(number), 1.0));
        }
        if let Some(by_share) = &self.by_share {
            let by_share = columns.iter().flat_map(|&column| by_share.column(column).into_iter().copied());
            made.set_column(self.groups.len(), &DVector::from_iterator(changes.nrows(), by_share));
        }
        made
    }

    /// Sum of all derivatives by each unknown, each times a weight.
    pub fn back(&self, weights: &DMatrix<f64>) -> DVector<f64> {
        let changes = self.over_holds(|hold| hold.back(&self.pieces, weights));
        let of_group = |group: &Vec<(usize, f64)>| group.iter().map(|&(number, share)| share * changes[number]).sum();
        let by_share = self.by_share.iter().map(|by_share| by_share.dot(weights));
        DVector::from_iterator(self.count(), self.groups.iter().map(of_group).chain(by_share))
    }

    /// How far a step of the unknowns moves all elements.
    pub fn forward(&self, step: &DVector<f64>) -> DMatrix<f64> {
        let mut changes = DVector::zeros(self.holds[0].1.factors.count());
        for (group, step) in self.groups.iter().zip(step) {
            group.iter().for_each(|&(number, share)| changes[number] += share * step);
        }
        let moved = self.over_holds(|hold| hold.forward(&self.pieces, &changes));
        self.by_share.iter().fold(moved, |moved, by_share| moved + by_share * step[self.groups.len()])
    }

    /// The sum of what each kind of hold makes, as it counts.
    fn over_holds<T: Add<Output = T> + Mul<f64, Output = T>>(&self, make: impl Fn(&OfHold) -> T) -> T {
        let each = self.holds.iter().map(|(counts, hold)| make(hold) * *counts);
        each.reduce(|sum, one| sum + one).expect("a ring holds something")
    }
}

impl OfHold {
    /// The derivatives of some columns in turn: those of correctors' pieces, and the last one.
    fn columns(&self, pieces: &[Vec<usize>], columns: &[usize], rows: usize) -> DMatrix<f64> {
        let orbits: Vec<&[usize]> =
            columns.iter().filter_map(|&column| pieces.get(column).map(Vec::as_slice)).collect();
        let (kicked, all) = (orbits.len() * rows, columns.len() * rows);
        let mut made = DMatrix::zeros(all, self.factors.count());
        for (gradient, column) in made.as_mut_slice().chunks_exact_mut(all).enumerate() {
            self.factors.orbits(&orbits, gradient, &mut column[..kicked]);
        }
        if let Some(dispersion) = self.dispersion.as_ref().filter(|_| kicked < all) {
            made.rows_mut(kicked, rows).copy_from(dispersion);
        }
        made
    }

    fn back(&self, pieces: &[Vec<usize>], weights: &DMatrix<f64>) -> DVector<f64> {
        let back = self.factors.back(&slices(pieces), &weights.columns_range(..pieces.len()));
        let last = weights.columns_range(pieces.len()..);
        self.dispersion.iter().fold(back, |back, dispersion| back + dispersion.tr_mul(&last).column(0))
    }

    fn forward(&self, pieces: &[Vec<usize>], step: &DVector<f64>) -> DMatrix<f64> {
        let moved = self.factors.forward(&slices(pieces), step);
        let Some(dispersion) = &self.dispersion else { return moved };
        let mut moved = moved.insert_column(pieces.len(), 0.0);
        moved.set_column(pieces.len(), &(dispersion * step));
        moved
    }
}

fn slices(pieces: &[Vec<usize>]) -> Vec<&[usize]> {
    pieces.iter().map(Vec::as_slice).collect()
}

fn gradient(optics: &Optics, element: usize, change: Change) -> Gradient {
    match change {
        Change::Normal => optics.gradient(element),
        Change::Skew => optics.skew_gradient(element),
        Change::Vertical => optics.vertical_focusing(element),
    }
}
