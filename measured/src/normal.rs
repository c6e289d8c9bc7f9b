//! The normal equations of a matrix, built column by column: no derivative of the whole matrix by all unknowns is ever held.
//!
//! An element of the matrix depends on all of the machine, and on the two instruments of its row and its column.

use core::ops::AddAssign;

use nalgebra::{Const, DMatrix, DMatrixView, DVector, Dyn};

use crate::error::MeasuredError;
use crate::linear::{add_square, in_lanes, inverse, product};
use crate::model::Prediction;
use crate::unknowns::{Kind, Unknown};

/// `J^T W J`, `J^T W r` and `r^T W r` of the elements of a matrix.
pub struct Normal {
    /// `J^T W J`.
    pub matrix: DMatrix<f64>,
    /// `J^T W r`.
    pub slope: DVector<f64>,
}

/// Where the unknowns of each row and column stand.
pub struct Places {
    machine: usize,
    rows: Vec<[Option<usize>; 2]>,
    columns: Vec<[Option<usize>; 2]>,
}

impl Places {
    /// Of the unknowns, those of the machine first, and the shape of the matrix; the RF scale stands for a corrector of the last column.
    pub fn of(unknowns: &[Unknown], rows: usize, columns: usize) -> Self {
        let mut places = Self { machine: 0, rows: vec![[None; 2]; rows], columns: vec![[None; 2]; columns] };
        for (at, unknown) in unknowns.iter().enumerate() {
            match unknown.kind {
                Kind::Strength(_)
                | Kind::Added(_)
                | Kind::Skew(_)
                | Kind::Gradient(_)
                | Kind::Wiggler(_)
                | Kind::HeldFrequency => places.machine += 1,
                Kind::MonitorGain(row) => places.rows[row][0] = Some(at),
                Kind::MonitorCoupling(row) => places.rows[row][1] = Some(at),
                Kind::CorrectorGain(column) => places.columns[column][0] = Some(at),
                Kind::CorrectorCoupling(column) => places.columns[column][1] = Some(at),
                Kind::RfScale => places.columns[columns - 1][0] = Some(at),
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
    pub fn back(&self, at: &Prediction, weighted: &DMatrix<f64>, unknowns: usize) -> DVector<f64> {
        let mut back = DVector::zeros(unknowns);
        back.rows_mut(0, self.machine).copy_from(&at.by_machine.back(weighted));
        for column in 0..weighted.ncols() {
            for row in (0..weighted.nrows()).filter(|&row| weighted[(row, column)] != 0.0) {
                for (one, by) in self.instruments(at, row, column) {
                    back[one] += by * weighted[(row, column)];
                }
            }
        }
        back
    }

    /// `J` times a step of the unknowns.
    pub fn forward(&self, at: &Prediction, step: &DVector<f64>) -> DMatrix<f64> {
        let mut moved = at.by_machine.forward(&step.rows(0, self.machine).into_owned());
        for (row, column) in (0..moved.ncols()).flat_map(|column| (0..at.matrix.nrows()).map(move |row| (row, column)))
        {
            moved[(row, column)] += self.instruments(at, row, column).map(|(one, by)| by * step[one]).sum::<f64>();
        }
        moved
    }

    /// `J C J^T` of each element by itself: the variance that a covariance of the unknowns gives it.
    pub fn variance(&self, at: &Prediction, covariance: &DMatrix<f64>) -> DMatrix<f64> {
        let of_machine = covariance.view((0, 0), (self.machine, self.machine)).into_owned();
        let lanes = in_lanes(&every(at.matrix.ncols()), at.matrix.len() * self.machine.pow(2), |columns| {
            columns
                .iter()
                .map(|&column| self.variance_of_column(at, column, (covariance, &of_machine)))
                .collect::<Vec<_>>()
        });
        DMatrix::from_columns(&lanes.concat())
    }

    fn variance_of_column(
        &self,
        at: &Prediction,
        column: usize,
        (covariance, of_machine): (&DMatrix<f64>, &DMatrix<f64>),
    ) -> DVector<f64> {
        let by_machine = at.by_machine.columns(&[column]);
        let mut spread = product(&by_machine, of_machine);
        let mut variance = DVector::zeros(by_machine.nrows());
        let each: Vec<Vec<_>> =
            (0..by_machine.nrows()).map(|row| self.instruments(at, row, column).collect()).collect();
        for (row, instruments) in each.iter().enumerate() {
            for &(one, by_one) in instruments {
                variance[row] +=
                    by_one * instruments.iter().map(|&(other, by)| by * covariance[(one, other)]).sum::<f64>();
            }
        }
        for (unknown, mut spread) in spread.column_iter_mut().enumerate() {
            let across = covariance.column(unknown);
            for (spread, instruments) in spread.iter_mut().zip(&each) {
                *spread += 2.0 * instruments.iter().map(|&(one, by)| by * across[one]).sum::<f64>();
            }
        }
        variance + spread.component_mul(&by_machine).column_sum()
    }
}

fn every(count: usize) -> Vec<usize> {
    (0..count).collect()
}

/// Derivatives of the elements of one column, among those of others.
type Said<'d> = DMatrixView<'d, f64, Const<1>, Dyn>;

/// What some columns say of the machine.
struct OfMachine {
    /// Columns of `J^T W J` of the machine's unknowns, of their own block the lower triangle.
    left: DMatrix<f64>,
    /// `J^T W r` of these.
    slope: DVector<f64>,
}

impl Normal {
    /// With `residual` measured less predicted and `weight` one over its variance, 0 where an element does not count.
    pub fn of(
        places: &Places,
        at: &Prediction,
        residual: &DMatrix<f64>,
        weight: &DMatrix<f64>,
        unknowns: usize,
    ) -> Self {
        let (rows, columns) = residual.shape();
        Self::of_part(places, at, (residual, weight), &[every(rows), every(columns)], unknowns)
    }

    /// The same of some rows and columns alone.
    pub fn of_part(
        places: &Places,
        at: &Prediction,
        data: (&DMatrix<f64>, &DMatrix<f64>),
        [rows, columns]: &[Vec<usize>; 2],
        unknowns: usize,
    ) -> Self {
        let work = rows.len() * columns.len() * places.machine.pow(2);
        let lanes =
            in_lanes(columns, work, |columns| OfMachine::of_columns(places, at, data, (rows, columns), unknowns));
        let mut normal = Self { matrix: DMatrix::zeros(unknowns, unknowns), slope: DVector::zeros(unknowns) };
        for lane in lanes {
            normal.matrix.columns_mut(0, places.machine).add_assign(&lane.left);
            normal.slope.rows_mut(0, places.machine).add_assign(&lane.slope);
        }
        normal.matrix.fill_upper_triangle_with_lower_triangle();
        normal.add_instruments(places, at, data, (rows, columns));
        normal
    }

    /// Add what the elements say of the instruments alone.
    fn add_instruments(
        &mut self,
        places: &Places,
        at: &Prediction,
        (residual, weight): (&DMatrix<f64>, &DMatrix<f64>),
        (rows, columns): (&[usize], &[usize]),
    ) {
        let mut each = Vec::new();
        for (row, column) in columns.iter().flat_map(|&column| rows.iter().map(move |&row| (row, column))) {
            let (w, r) = (weight[(row, column)], residual[(row, column)]);
            if w <= 0.0 {
                continue;
            }
            each.clear();
            each.extend(places.instruments(at, row, column));
            for &(one, by) in &each {
                self.slope[one] += w * by * r;
                each.iter().for_each(|&(other, by_other)| self.matrix[(one, other)] += w * by * by_other);
            }
        }
    }
}

/// Elements whose derivatives are multiplied at once: fewer leave the processor waiting for memory.
const DEEP: usize = 512;

impl OfMachine {
    fn of_columns(
        places: &Places,
        at: &Prediction,
        data: (&DMatrix<f64>, &DMatrix<f64>),
        (rows, columns): (&[usize], &[usize]),
        unknowns: usize,
    ) -> Self {
        let machine = places.machine;
        let mut sum = Self { left: DMatrix::zeros(unknowns, machine), slope: DVector::zeros(machine) };
        let every = at.matrix.nrows();
        let mut of_monitors = [0, 1].map(|_| DMatrix::zeros(every, machine));
        for columns in columns.chunks(DEEP.div_ceil(every)) {
            let by_machine = at.by_machine.columns(columns);
            let depth = rows.len() * columns.len();
            let mut deep = DMatrix::zeros(depth, machine);
            for (number, &column) in columns.iter().enumerate() {
                let by_machine = by_machine.rows(number * every, every);
                let mut weights = DVector::zeros(every);
                rows.iter().for_each(|&row| weights[row] = data.1[(row, column)]);
                sum.add_column(places, at, (data.0, &weights), column, &by_machine);
                for (sum, by_monitor) in of_monitors.iter_mut().zip(&at.by_monitor) {
                    add_times(&by_machine, &weights.component_mul(&by_monitor.column(column)), sum);
                }
                let roots: Vec<(usize, f64)> = rows.iter().map(|&row| (row, weights[row].sqrt())).collect();
                for (line, by) in deep.as_mut_slice().chunks_exact_mut(depth).zip(by_machine.column_iter()) {
                    let line = &mut line[number * rows.len()..];
                    line.iter_mut().zip(&roots).for_each(|(into, &(row, root))| *into = by[row] * root);
                }
            }
            add_square(&deep, &mut sum.left);
        }
        for (which, of_monitors) in of_monitors.iter().enumerate() {
            for (row, said) in of_monitors.row_iter().enumerate() {
                if let Some(place) = places.rows[row][which] {
                    sum.left.set_row(place, &said);
                }
            }
        }
        sum
    }

    /// Slopes, and what stands between machine and correctors.
    fn add_column(
        &mut self,
        places: &Places,
        at: &Prediction,
        (residual, weights): (&DMatrix<f64>, &DVector<f64>),
        column: usize,
        by_machine: &Said,
    ) {
        self.slope.gemv_tr(1.0, by_machine, &weights.component_mul(&residual.column(column)), 1.0);
        for (place, by) in places.columns[column].iter().zip(&at.by_corrector) {
            let Some(place) = *place else { continue };
            let said = by_machine.tr_mul(&weights.component_mul(&by.column(column)));
            self.left.row_mut(place).add_assign(&said.transpose());
        }
    }
}

/// Add the columns of a matrix, each row times its weight.
fn add_times(matrix: &Said, weights: &DVector<f64>, sum: &mut DMatrix<f64>) {
    for (sum, column) in sum.as_mut_slice().chunks_exact_mut(weights.len()).zip(matrix.column_iter()) {
        sum.iter_mut().zip(&column).zip(weights.as_slice()).for_each(|((sum, one), weight)| *sum += one * weight);
    }
}

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

/// Covariance of the unknowns, with what the elements say of them, `J^T W J`.
pub fn covariance(unknowns: &[Unknown], information: DMatrix<f64>) -> Result<DMatrix<f64>, MeasuredError> {
    let width = DVector::from_iterator(unknowns.len(), unknowns.iter().map(|one| one.width));
    let inverse = inverse(&in_widths(information, &width)).ok_or(MeasuredError::Singular(0))?;
    Ok(times(inverse, &width))
}
