//! Matrices of the twin as arrays of numpy, rows first.

use nalgebra::DMatrix;
use numpy::{PyArray1, PyArray2, PyArray3, PyArrayMethods};
use pyo3::prelude::*;

/// A matrix.
pub fn matrix<'py>(py: Python<'py>, of: &DMatrix<f64>) -> PyResult<Bound<'py, PyArray2<f64>>> {
    let mut values = Vec::with_capacity(of.len());
    append(&mut values, of);
    PyArray1::from_vec(py, values).reshape([of.nrows(), of.ncols()])
}

/// Matrices of one shape, one behind the other.
pub fn matrices<'py>(py: Python<'py>, of: &[DMatrix<f64>], shape: [usize; 2]) -> PyResult<Bound<'py, PyArray3<f64>>> {
    let mut values = Vec::with_capacity(of.len() * shape[0] * shape[1]);
    of.iter().for_each(|one| append(&mut values, one));
    PyArray1::from_vec(py, values).reshape([of.len(), shape[0], shape[1]])
}

fn append(values: &mut Vec<f64>, matrix: &DMatrix<f64>) {
    for i in 0..matrix.nrows() {
        values.extend(matrix.row(i).iter());
    }
}
