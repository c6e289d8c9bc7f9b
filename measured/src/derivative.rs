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
    /// Unknowns that change groups, and for each number the unknowns that change it with their shares.
    groups: usize,
    shares: Vec<Vec<(usize, f64)>>,
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
        let mut shares = vec![Vec::new(); changes.len()];
        for (unknown, group) in unknowns.iter().enumerate() {
            group
                .iter()
                .for_each(|&(element, change, share)| shares[changes[&(element, change)]].push((unknown, share)));
        }
        let mut next = 0;
        let pieces = pieces.map(|count| {
            next += count;
            (next - count..next).collect()
        });
        let dispersion = rf.map(|rf| optics.rf_jacobian(observers, &gradients) * rf);
        Self {
            rows: observers.len(),
            pieces: pieces.collect(),
            groups: unknowns.len(),
            shares,
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
        self.groups + usize::from(self.by_share.is_some())
    }

    /// Derivatives of the elements of some columns in turn, rows elements.
    pub fn columns(&self, columns: &[usize]) -> DMatrix<f64> {
        self.weighted(columns, &DVector::from_element(columns.len() * self.rows, 1.0))
    }

    /// The same, each element times its weight.
    pub fn weighted(&self, columns: &[usize], weights: &DVector<f64>) -> DMatrix<f64> {
        let orbits: Vec<&[usize]> =
            columns.iter().filter_map(|&column| self.pieces.get(column).map(Vec::as_slice)).collect();
        let mut made = DMatrix::zeros(weights.len(), self.count());
        let mut all = vec![0.0; weights.len()];
        for (number, shares) in self.shares.iter().enumerate() {
            all.fill(0.0);
            self.holds.iter().for_each(|(counts, hold)| hold.add_columns(&orbits, number, *counts, &mut all));
            for &(unknown, share) in shares {
                let made = made.column_mut(unknown).data.into_slice_mut();
                let each = made.iter_mut().zip(&all).zip(weights.as_slice());
                each.for_each(|((made, one), weight)| *made += share * one * weight);
            }
        }
        if let Some(by_share) = &self.by_share {
            let by_share = columns.iter().flat_map(|&column| by_share.column(column).into_iter().copied());
            made.set_column(self.groups, &DVector::from_iterator(weights.len(), by_share).component_mul(weights));
        }
        made
    }

    /// `sum_i w_ij dG_ij/dx` of each column, rows, by each unknown, columns.
    pub fn by_column(&self, weights: &DMatrix<f64>) -> DMatrix<f64> {
        let changes = self.over_holds(|hold| hold.by_column(&self.pieces, weights));
        let by_share = self.by_share.as_ref().map(|by_share| by_share.component_mul(weights).row_sum_tr());
        self.by_unknown(&changes, by_share)
    }

    /// `sum_j w_ij dG_ij/dx` of each row, rows, by each unknown, columns.
    pub fn by_row(&self, weights: &DMatrix<f64>) -> DMatrix<f64> {
        let changes = self.over_holds(|hold| hold.by_row(&self.pieces, weights));
        let by_share = self.by_share.as_ref().map(|by_share| by_share.component_mul(weights).column_sum());
        self.by_unknown(&changes, by_share)
    }

    /// What lines say of the numbers that change, and of the share, as what they say of the unknowns.
    fn by_unknown(&self, changes: &DMatrix<f64>, by_share: Option<DVector<f64>>) -> DMatrix<f64> {
        let mut said = DMatrix::zeros(changes.nrows(), self.count());
        for (change, shares) in changes.column_iter().zip(&self.shares) {
            shares.iter().for_each(|&(unknown, share)| said.column_mut(unknown).axpy(share, &change, 1.0));
        }
        by_share.iter().for_each(|by_share| said.set_column(self.groups, by_share));
        said
    }

    /// How far a step of the unknowns moves all elements.
    pub fn forward(&self, step: &DVector<f64>) -> DMatrix<f64> {
        let change = |shares: &Vec<(usize, f64)>| shares.iter().map(|&(unknown, share)| share * step[unknown]).sum();
        let changes = DVector::from_iterator(self.shares.len(), self.shares.iter().map(change));
        let moved = self.over_holds(|hold| hold.forward(&self.pieces, &changes));
        self.by_share.iter().fold(moved, |moved, by_share| moved + by_share * step[self.groups])
    }

    /// The sum of what each kind of hold makes, as it counts.
    fn over_holds<T: Add<Output = T> + Mul<f64, Output = T>>(&self, make: impl Fn(&OfHold) -> T) -> T {
        let each = self.holds.iter().map(|(counts, hold)| make(hold) * *counts);
        each.reduce(|sum, one| sum + one).expect("a ring holds something")
    }
}

impl OfHold {
    /// Add so many times the derivatives of some columns in turn by a number that changes: those of correctors' orbits, and the last one where there is room.
    fn add_columns(&self, orbits: &[&[usize]], number: usize, times: f64, into: &mut [f64]) {
        self.factors.add_orbits(orbits, number, times, into);
        if let Some(dispersion) = &self.dispersion {
            let last = into.chunks_exact_mut(dispersion.nrows()).skip(orbits.len());
            let by = dispersion.column(number);
            last.for_each(|last| last.iter_mut().zip(&by).for_each(|(last, by)| *last += times * by));
        }
    }

    fn by_column(&self, pieces: &[Vec<usize>], weights: &DMatrix<f64>) -> DMatrix<f64> {
        let said = self.factors.by_orbit(&slices(pieces), &weights.columns_range(..pieces.len()));
        let Some(dispersion) = &self.dispersion else { return said };
        let mut said = said.insert_row(pieces.len(), 0.0);
        said.set_row(pieces.len(), &weights.column(pieces.len()).tr_mul(dispersion).row(0));
        said
    }

    fn by_row(&self, pieces: &[Vec<usize>], weights: &DMatrix<f64>) -> DMatrix<f64> {
        let mut said = self.factors.by_observer(&slices(pieces), &weights.columns_range(..pieces.len()));
        if let Some(dispersion) = &self.dispersion {
            let last = weights.column(pieces.len());
            said.column_iter_mut()
                .zip(dispersion.column_iter())
                .for_each(|(mut said, by)| said.cmpy(1.0, &by, &last, 1.0));
        }
        said
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
