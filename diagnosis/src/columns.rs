//! Matrices side by side.

use nalgebra::{DMatrix, Dim, Dyn, Matrix, RawStorage};

/// The columns of two matrices, or of a matrix and a vector, those of the left one first.
pub fn beside<C: Dim>(left: DMatrix<f64>, right: &Matrix<f64, Dyn, C, impl RawStorage<f64, Dyn, C>>) -> DMatrix<f64> {
    let first = left.ncols();
    let mut all = left.insert_columns(first, right.ncols(), 0.0);
    all.columns_range_mut(first..).iter_mut().zip(right.iter()).for_each(|(to, from)| *to = *from);
    all
}
