//! Products of matrices of hundreds and thousands, by faer: nalgebra's are several times slower there.
//!
//! Work is cut into as many lanes on every computer, and their results are added in order: no number depends on how many run at once. Each lane is a thread where
//! the work takes longer than starting one.

use faer::linalg::matmul::{matmul, triangular};
use faer::{Accum, MatMut, MatRef, Par};
use nalgebra::DMatrix;

/// Parts of one sum.
pub const LANES: usize = 4;
/// Multiplications from which on each lane is a thread; the small rings of the tests take three times as long where all are.
const THREADED: usize = 1 << 21;

/// What a function makes of some items, cut into lanes, of so many multiplications in all.
pub fn in_lanes<T: Send>(items: &[usize], work: usize, each: impl Fn(&[usize]) -> T + Sync) -> Vec<T> {
    let (each, lanes) = (&each, items.chunks(items.len().div_ceil(LANES).max(1)));
    if work < THREADED {
        return lanes.map(each).collect();
    }
    std::thread::scope(|scope| {
        let lanes: Vec<_> = lanes.map(|items| scope.spawn(move || each(items))).collect();
        lanes.into_iter().map(|lane| lane.join().expect("a lane does not panic")).collect()
    })
}

/// `A B`, its columns in lanes.
pub fn product(left: &DMatrix<f64>, right: &DMatrix<f64>) -> DMatrix<f64> {
    of_columns(left.nrows(), left.ncols(), right, |columns, into| {
        matmul(into, Accum::Replace, view(left), columns, 1.0, Par::Seq);
    })
}

/// `A^T B`, its columns in lanes.
pub fn transposed_product(left: &DMatrix<f64>, right: &DMatrix<f64>) -> DMatrix<f64> {
    of_columns(left.ncols(), left.nrows(), right, |columns, into| {
        matmul(into, Accum::Replace, view(left).transpose(), columns, 1.0, Par::Seq);
    })
}

/// What is made of the columns of a matrix, lane by lane, with so many multiplications an element.
fn of_columns(
    rows: usize,
    depth: usize,
    right: &DMatrix<f64>,
    make: impl Fn(MatRef<'_, f64>, MatMut<'_, f64>) + Sync,
) -> DMatrix<f64> {
    let columns: Vec<usize> = (0..right.ncols()).collect();
    let lanes = in_lanes(&columns, rows * depth * columns.len(), |columns| {
        let mut made = vec![0.0; rows * columns.len()];
        let from = view(right).subcols(columns[0], columns.len());
        make(from, MatMut::from_column_major_slice_mut(&mut made, rows, columns.len()));
        made
    });
    DMatrix::from_vec(rows, right.ncols(), lanes.concat())
}

/// `A L` with the lower triangle of a matrix.
pub fn lower_product(left: &DMatrix<f64>, lower: &DMatrix<f64>) -> DMatrix<f64> {
    let (rows, columns) = (left.nrows(), lower.ncols());
    let mut made = DMatrix::zeros(rows, columns);
    let into = MatMut::from_column_major_slice_mut(made.as_mut_slice(), rows, columns);
    let [all, triangle] = [triangular::BlockStructure::Rectangular, triangular::BlockStructure::TriangularLower];
    triangular::matmul(into, all, Accum::Replace, view(left), all, view(lower), triangle, 1.0, Par::Seq);
    made
}

/// Add `A^T A` to the lower triangle of the first rows of a matrix with as many columns as `A`.
pub fn add_square(factor: &DMatrix<f64>, into: &mut DMatrix<f64>) {
    let (rows, n) = into.shape();
    let into = MatMut::from_column_major_slice_mut(into.as_mut_slice(), rows, n).subrows_mut(0, n);
    let [all, lower] = [triangular::BlockStructure::Rectangular, triangular::BlockStructure::TriangularLower];
    let factor = view(factor);
    triangular::matmul(into, lower, Accum::Add, factor.transpose(), all, factor, all, 1.0, Par::Seq);
}

fn view(matrix: &DMatrix<f64>) -> MatRef<'_, f64> {
    MatRef::from_column_major_slice(matrix.as_slice(), matrix.nrows(), matrix.ncols())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::normal;

    #[test]
    fn products_are_those_of_nalgebra() {
        let mut random = normal(1);
        for n in [1, 3, 64, 203] {
            let root = DMatrix::from_fn(n + 7, n, |_, _| random());
            let matrix = root.transpose() * &root + DMatrix::identity(n, n);
            assert!((product(&root, &matrix) - &root * &matrix).amax() < 1e-9 * matrix.amax(), "{n}");
            assert!((transposed_product(&root, &root) - root.transpose() * &root).amax() < 1e-9, "{n}");
            assert!((lower_product(&root, &matrix) - &root * matrix.lower_triangle()).amax() < 1e-9 * matrix.amax());
            let mut square = DMatrix::zeros(n + 2, n);
            add_square(&root, &mut square);
            let lower = square.rows(0, n).lower_triangle() - (root.transpose() * &root).lower_triangle();
            assert!(lower.amax() < 1e-9 && square.rows(n, 2).amax() == 0.0, "{n}");
        }
    }
}
