//! The normal equations of a matrix, built column by column: no derivative of the whole matrix by all unknowns is ever held.
//!
//! An element of the matrix depends on all of the machine, and on the two instruments of its row and its column.

use core::ops::AddAssign;

use nalgebra::{DMatrix, DVector};

use crate::linear::{add_square, in_lanes, lower_product};
use crate::model::Prediction;
use crate::unknowns::Unknown;

/// Where the unknowns of each row and column stand.
pub struct Places {
    unknowns: usize,
    machine: usize,
    rows: Vec<[Option<usize>; 2]>,
    columns: Vec<[Option<usize>; 2]>,
}

impl Places {
    /// Of the unknowns, those of the machine first, and the shape of the matrix; the RF scale stands for a corrector of the last column.
    pub fn of(unknowns: &[Unknown], rows: usize, columns: usize) -> Self {
        let none = |lines: usize| vec![[None; 2]; lines];
        let mut places = Self { unknowns: unknowns.len(), machine: 0, rows: none(rows), columns: none(columns) };
        for (at, Unknown { kind, .. }) in unknowns.iter().enumerate() {
            if kind.is_of_machine() {
                places.machine += 1;
            } else if let Some((row, which)) = kind.of_monitor() {
                places.rows[row][which] = Some(at);
            } else if let Some((column, which)) = kind.of_corrector() {
                places.columns[column][which] = Some(at);
            } else {
                places.columns[columns - 1][0] = Some(at); // the RF scale
            }
        }
        places
    }

    /// Unknowns of each monitor or of each corrector, of those that have more: no element depends on two of these sets.
    pub fn apart(&self) -> Vec<Vec<usize>> {
        let sets = |lines: &[[Option<usize>; 2]]| {
            let each = lines.iter().map(|line| line.iter().flatten().copied().collect::<Vec<usize>>());
            each.filter(|set| !set.is_empty()).collect::<Vec<_>>()
        };
        let [rows, columns] = [sets(&self.rows), sets(&self.columns)];
        if rows.iter().flatten().count() > columns.iter().flatten().count() { rows } else { columns }
    }

    /// Unknowns of the instruments that an element depends on, and its derivatives by them.
    pub fn instruments<'p>(
        &'p self,
        at: &'p Prediction,
        row: usize,
        column: usize,
    ) -> impl Iterator<Item = (usize, f64)> + 'p {
        let of_row = self.rows[row].iter().zip(&at.by_monitor);
        let of_column = self.columns[column].iter().zip(&at.by_corrector);
        of_row.chain(of_column).filter_map(move |(place, by)| place.map(|place| (place, by[(row, column)])))
    }

    /// `J^T` of weighted elements.
    pub fn back(&self, at: &Prediction, weighted: &DMatrix<f64>) -> DVector<f64> {
        let mut back = DVector::zeros(self.unknowns);
        back.rows_mut(0, self.machine).copy_from(&at.by_machine.by_column(weighted).row_sum_tr());
        for (row, column) in counted(weighted) {
            for (one, by) in self.instruments(at, row, column) {
                back[one] += by * weighted[(row, column)];
            }
        }
        back
    }

    /// The same of each row, then of each column, one after the other.
    pub fn back_by_lines(&self, at: &Prediction, weighted: &DMatrix<f64>) -> DMatrix<f64> {
        let (rows, columns) = weighted.shape();
        let mut back = DMatrix::zeros(self.unknowns, rows + columns);
        back.view_mut((0, 0), (self.machine, rows)).tr_copy_from(&at.by_machine.by_row(weighted));
        back.view_mut((0, rows), (self.machine, columns)).tr_copy_from(&at.by_machine.by_column(weighted));
        for (row, column) in counted(weighted) {
            for (one, by) in self.instruments(at, row, column) {
                back[(one, row)] += by * weighted[(row, column)];
                back[(one, rows + column)] += by * weighted[(row, column)];
            }
        }
        back
    }

    /// What the elements say of the unknowns, `J^T W J`, each with its weight.
    pub fn information(&self, at: &Prediction, weight: &DMatrix<f64>) -> DMatrix<f64> {
        let (rows, columns) = weight.shape();
        let mut information = DMatrix::zeros(self.unknowns, self.unknowns);
        let told: Vec<usize> =
            (0..columns).filter(|&column| weight.column(column).iter().any(|&one| one > 0.0)).collect();
        let work = weight.nrows() * told.len() * self.machine.pow(2);
        let squares = in_lanes(&told, work, |columns| self.square(at, weight, columns));
        squares.iter().for_each(|square| information.view_mut((0, 0), square.shape()).add_assign(square));
        // gains and couplings meet the machine
        let instruments = in_lanes(&[0, 1], weight.len() * self.machine, |lane| {
            let which = lane[0];
            let by_row = at.by_machine.by_row(&weight.component_mul(&at.by_monitor[which]));
            (which, by_row, at.by_machine.by_column(&weight.component_mul(&at.by_corrector[which])))
        });
        for (which, by_row, by_column) in instruments {
            let of_rows = (0..rows).map(|row| (self.rows[row][which], by_row.row(row)));
            let of_columns = (0..columns).map(|column| (self.columns[column][which], by_column.row(column)));
            for (place, said) in of_rows.chain(of_columns) {
                place.iter().for_each(|&place| information.view_mut((place, 0), (1, self.machine)).copy_from(&said));
            }
        }
        information.fill_upper_triangle_with_lower_triangle();
        let mut each = Vec::new();
        for (row, column) in counted(weight) {
            each.clear();
            each.extend(self.instruments(at, row, column));
            for &(one, by) in &each {
                each.iter()
                    .for_each(|&(other, by_other)| information[(one, other)] += weight[(row, column)] * by * by_other);
            }
        }
        information
    }

    /// Lower triangle of the block of the machine's unknowns, by some columns.
    fn square(&self, at: &Prediction, weight: &DMatrix<f64>, columns: &[usize]) -> DMatrix<f64> {
        let (rows, mut square) = (weight.nrows(), DMatrix::zeros(self.machine, self.machine));
        for columns in columns.chunks(DEEP.div_ceil(rows)) {
            let roots =
                columns.iter().flat_map(|&column| weight.column(column).into_iter().map(|weight| weight.sqrt()));
            let roots = DVector::from_iterator(columns.len() * rows, roots);
            let mut by_machine = at.by_machine.weighted(columns, &roots);
            let kept: Vec<usize> = (0..roots.len()).filter(|&element| roots[element] > 0.0).collect();
            if kept.len() < roots.len() / 2 {
                by_machine = by_machine.select_rows(&kept);
            }
            add_square(&by_machine, &mut square);
        }
        square
    }

    /// `J` times a step of the unknowns.
    pub fn forward(&self, at: &Prediction, step: &DVector<f64>) -> DMatrix<f64> {
        let mut moved = at.by_machine.forward(&step.rows(0, self.machine).into_owned());
        for (column, mut moved) in moved.column_iter_mut().enumerate() {
            for (row, moved) in moved.iter_mut().enumerate() {
                *moved += self.instruments(at, row, column).map(|(one, by)| by * step[one]).sum::<f64>();
            }
        }
        moved
    }

    /// `J C J^T` of each element by itself: the variance that a covariance of the unknowns gives it.
    pub fn variance(&self, at: &Prediction, covariance: &DMatrix<f64>) -> DMatrix<f64> {
        let mut of_machine = covariance.view((0, 0), (self.machine, self.machine)).into_owned();
        // J C J^T is twice that of a triangle with half the diagonal
        (0..self.machine).for_each(|one| of_machine[(one, one)] *= 0.5);
        // of each row's monitor, its covariance with the machine
        let of_monitors = [0, 1].map(|which| {
            DMatrix::from_fn(at.matrix.nrows(), self.machine, |row, unknown| {
                self.rows[row][which].map_or(0.0, |place| covariance[(place, unknown)])
            })
        });
        let every: Vec<usize> = (0..at.matrix.ncols()).collect();
        let lanes = in_lanes(&every, at.matrix.len() * self.machine.pow(2), |columns| {
            let each = columns.iter();
            each.map(|&column| self.variance_of_column(at, column, covariance, (&of_machine, &of_monitors)))
                .collect::<Vec<_>>()
        });
        DMatrix::from_columns(&lanes.concat())
    }

    fn variance_of_column(
        &self,
        at: &Prediction,
        column: usize,
        covariance: &DMatrix<f64>,
        (of_machine, of_monitors): (&DMatrix<f64>, &[DMatrix<f64>; 2]),
    ) -> DVector<f64> {
        let by_machine = at.by_machine.columns(&[column]);
        let mut variance = row_products(&lower_product(&by_machine, of_machine), &by_machine);
        for (of_monitors, by) in of_monitors.iter().zip(&at.by_monitor) {
            variance.cmpy(1.0, &row_products(&by_machine, of_monitors), &by.column(column), 1.0);
        }
        for (place, by) in self.columns[column].iter().zip(&at.by_corrector) {
            let Some(place) = *place else { continue };
            let with_machine = &by_machine * covariance.view((0, place), (self.machine, 1)).column(0);
            variance.cmpy(1.0, &with_machine, &by.column(column), 1.0);
        }
        variance *= 2.0;
        for (row, variance) in variance.iter_mut().enumerate() {
            let instruments: Vec<(usize, f64)> = self.instruments(at, row, column).collect();
            for &(one, by_one) in &instruments {
                *variance += by_one * instruments.iter().map(|&(other, by)| by * covariance[(one, other)]).sum::<f64>();
            }
        }
        variance
    }
}

/// Product of each row with that of another matrix.
fn row_products(one: &DMatrix<f64>, other: &DMatrix<f64>) -> DVector<f64> {
    let mut products = DVector::zeros(one.nrows());
    one.column_iter().zip(other.column_iter()).for_each(|(one, other)| products.cmpy(1.0, &one, &other, 1.0));
    products
}

/// Places of the elements that count.
fn counted(weights: &DMatrix<f64>) -> impl Iterator<Item = (usize, usize)> + '_ {
    let all = (0..weights.ncols()).flat_map(|column| (0..weights.nrows()).map(move |row| (row, column)));
    all.filter(|&place| weights[place] != 0.0)
}

/// Elements whose derivatives are multiplied at once: fewer leave the processor waiting for memory.
const DEEP: usize = 512;

/// An information matrix in units of the priors' widths, with the priors.
pub fn in_widths(information: DMatrix<f64>, width: &DVector<f64>) -> DMatrix<f64> {
    let n = width.len();
    times(information, width) + DMatrix::identity(n, n)
}

/// Each element times the widths of its row and of its column.
pub fn times(mut matrix: DMatrix<f64>, width: &DVector<f64>) -> DMatrix<f64> {
    for (mut column, &of_column) in matrix.column_iter_mut().zip(width) {
        column.component_mul_assign(width);
        column *= of_column;
    }
    matrix
}
