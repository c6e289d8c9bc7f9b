//! The normal equations of a matrix, built column by column: no derivative of the whole matrix by all unknowns is ever held.
//!
//! An element of the matrix depends on all of the machine, and on the two instruments of its row and its column.

use nalgebra::{DMatrix, DVector};

use crate::error::MeasuredError;
use crate::model::Prediction;
use crate::unknowns::{Kind, Unknown};

/// `J^T W J`, `J^T W r` and `r^T W r` of the elements of a matrix.
pub struct Normal {
    /// `J^T W J`.
    pub matrix: DMatrix<f64>,
    /// `J^T W r`.
    pub slope: DVector<f64>,
    /// `r^T W r`.
    pub chi2: f64,
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
        for (into, slope) in back.iter_mut().zip(&at.by_machine) {
            *into = slope.dot(weighted);
        }
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
        let (rows, columns) = at.matrix.shape();
        let mut sum = DMatrix::from_fn(rows, columns, |row, column| {
            self.instruments(at, row, column).map(|(one, by)| by * step[one]).sum()
        });
        for (by, &step) in at.by_machine.iter().zip(step.iter()) {
            sum.zip_apply(by, |sum, by| *sum += by * step);
        }
        sum
    }

    /// `J C J^T` of each element by itself: the variance that a covariance of the unknowns gives it.
    pub fn variance(&self, at: &Prediction, covariance: &DMatrix<f64>) -> DMatrix<f64> {
        let (rows, columns) = at.matrix.shape();
        let of_machine = covariance.view((0, 0), (self.machine, self.machine));
        let mut variance = DMatrix::zeros(rows, columns);
        let every: Vec<usize> = (0..rows).collect();
        for column in 0..columns {
            let by_machine = by_machine(at, &every, column);
            let spread = &by_machine * of_machine;
            for row in 0..rows {
                let by = by_machine.row(row);
                let mut sum = spread.row(row).dot(&by);
                for (one, by_one) in self.instruments(at, row, column) {
                    sum += 2.0 * by_one * by.tr_dot(&covariance.view((0, one), (self.machine, 1)));
                    let others = self.instruments(at, row, column);
                    sum += by_one * others.map(|(other, by)| by * covariance[(one, other)]).sum::<f64>();
                }
                variance[(row, column)] = sum;
            }
        }
        variance
    }
}

/// Derivatives of some of a column's elements by the machine's unknowns, rows elements.
fn by_machine(at: &Prediction, rows: &[usize], column: usize) -> DMatrix<f64> {
    DMatrix::from_fn(rows.len(), at.by_machine.len(), |row, unknown| at.by_machine[unknown][(rows[row], column)])
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
        let every = [(0..rows).collect(), (0..columns).collect()];
        Self::of_part(places, at, (residual, weight), &every, unknowns)
    }

    /// The same of some rows and columns alone.
    pub fn of_part(
        places: &Places,
        at: &Prediction,
        (residual, weight): (&DMatrix<f64>, &DMatrix<f64>),
        [rows, columns]: &[Vec<usize>; 2],
        unknowns: usize,
    ) -> Self {
        let machine = places.machine;
        let mut normal =
            Self { matrix: DMatrix::zeros(unknowns, unknowns), slope: DVector::zeros(unknowns), chi2: 0.0 };
        for &column in columns {
            let by_machine = by_machine(at, rows, column);
            let mut weighted = by_machine.clone();
            weighted.row_iter_mut().zip(rows).for_each(|(mut one, &row)| one *= weight[(row, column)]);
            let weighted = weighted.transpose();
            let mut block = normal.matrix.view_mut((0, 0), (machine, machine));
            block.gemm(1.0, &weighted, &by_machine, 1.0);
            let mut slope = normal.slope.rows_mut(0, machine);
            slope.gemv(1.0, &weighted, &residual.column(column).select_rows(rows), 1.0);
            for (counted, &row) in rows.iter().enumerate().filter(|&(_, &row)| weight[(row, column)] > 0.0) {
                let (w, r) = (weight[(row, column)], residual[(row, column)]);
                normal.chi2 += w * r * r;
                for (one, by) in places.instruments(at, row, column) {
                    normal.slope[one] += w * by * r;
                    let mut across = normal.matrix.column_mut(one);
                    across.rows_mut(0, machine).axpy(by, &weighted.column(counted), 1.0);
                    for (other, by_other) in places.instruments(at, row, column) {
                        normal.matrix[(one, other)] += w * by * by_other;
                    }
                }
            }
        }
        for one in machine..unknowns {
            for of_machine in 0..machine {
                normal.matrix[(one, of_machine)] = normal.matrix[(of_machine, one)];
            }
        }
        normal
    }
}

/// Below this size a matrix is inverted by its Cholesky factor.
const SMALL: usize = 64;

/// Inverse of a symmetric positive matrix, `None` where it is not one: by halves, so that nearly all of it is products of matrices, which are ten times
/// as fast as substitutions.
///
/// With `S = D - B^T A^-1 B`, the Schur complement, and `X = A^-1 B`
///
/// `(A B; B^T D)^-1 = (A^-1 + X S^-1 X^T, -X S^-1; -S^-1 X^T, S^-1)`.
///
/// Halves are cut from a matrix with ones on its diagonal; where rounding leaves one of them no longer positive, the whole matrix is inverted by its factor.
pub fn inverse(matrix: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let scale = matrix.diagonal().map(|one| one.sqrt().recip());
    match by_halves(&times(matrix.clone(), &scale)) {
        Some(inverse) => Some(times(inverse, &scale)),
        None => Some(matrix.clone().cholesky()?.inverse()),
    }
}

fn by_halves(matrix: &DMatrix<f64>) -> Option<DMatrix<f64>> {
    let n = matrix.nrows();
    if n <= SMALL {
        return Some(matrix.clone().cholesky()?.inverse());
    }
    let half = n / 2;
    let rest = n - half;
    let first = by_halves(&matrix.view((0, 0), (half, half)).into_owned())?;
    let across = matrix.view((0, half), (half, rest));
    let follow = &first * across;
    let schur = by_halves(&(matrix.view((half, half), (rest, rest)) - across.tr_mul(&follow)))?;
    let off = &follow * &schur;
    let mut inverse = DMatrix::zeros(n, n);
    inverse.view_mut((0, 0), (half, half)).copy_from(&(first + &off * follow.transpose()));
    inverse.view_mut((0, half), (half, rest)).copy_from(&-&off);
    inverse.view_mut((half, 0), (rest, half)).copy_from(&-off.transpose());
    inverse.view_mut((half, half), (rest, rest)).copy_from(&schur);
    Some(inverse)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::normal;

    #[test]
    fn an_inverse_by_halves_is_the_inverse() {
        let mut random = normal(1);
        for n in [3, SMALL, SMALL + 1, 3 * SMALL + 5] {
            let root = DMatrix::from_fn(n, n, |_, _| random());
            let matrix = &root * root.transpose() + DMatrix::identity(n, n);
            let found = inverse(&matrix).unwrap();
            assert!((found * &matrix - DMatrix::identity(n, n)).amax() < 1e-9, "{n}: rounding, condition 1000");
            assert_eq!(inverse(&(DMatrix::identity(n, n) * -1.0)), None);
        }
    }
}
