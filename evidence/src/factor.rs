//! The Cholesky factor of a positive matrix, in blocks: the products of blocks, most of the work of large ones, are several times as fast as nalgebra's own
//! factorisation and solution, which go column by column.
//!
//! Source: G. Golub and C. Van Loan, Matrix Computations (2013), ch. 4.2.9, recursive block Cholesky.

use nalgebra::allocator::Allocator;
use nalgebra::{DMatrix, DMatrixView, DMatrixViewMut, DefaultAllocator, Dim, Dyn, Matrix, OMatrix, Storage};

/// Rows that are solved column by column, and factorised so.
const ROWS: usize = 48;
const FACTORISED: usize = 160;
/// Columns of a product of which half is left out.
const COLUMNS: usize = 100;
/// Columns up to which blocks are no gain, and from which on the inverse of a small block is one.
const FEW: usize = 3;
const MANY: usize = 96;

/// `L` of a positive matrix `L L^T`.
#[derive(Debug, Clone)]
pub struct Factor {
    /// Above the diagonal it is not `L`, and not read.
    lower: DMatrix<f64>,
}

impl Factor {
    /// Of a matrix of which the lower triangle is read; none if it is not positive.
    pub fn of(mut matrix: DMatrix<f64>) -> Option<Self> {
        if matrix.nrows() <= FACTORISED {
            return Some(Self { lower: matrix.cholesky()?.unpack_dirty() });
        }
        factorise(matrix.as_view_mut())?;
        Some(Self { lower: matrix })
    }

    /// `L`, zero above its diagonal.
    pub fn lower(&self) -> DMatrix<f64> {
        self.lower.lower_triangle()
    }

    /// The matrix, `L L^T`.
    pub fn matrix(&self) -> DMatrix<f64> {
        let lower = self.lower();
        &lower * lower.transpose()
    }

    /// Diagonal of `L`.
    pub fn diagonal(&self) -> impl Iterator<Item = f64> + '_ {
        (0..self.lower.nrows()).map(|i| self.lower[(i, i)])
    }

    /// `ln` of the determinant of the matrix.
    pub fn log_determinant(&self) -> f64 {
        2.0 * self.diagonal().map(f64::ln).sum::<f64>()
    }

    /// `L^-1 B`.
    pub fn whiten<C: Dim, S: Storage<f64, Dyn, C>>(&self, right: &Matrix<f64, Dyn, C, S>) -> OMatrix<f64, Dyn, C>
    where
        DefaultAllocator: Allocator<Dyn, C>,
    {
        let mut right = right.clone_owned();
        forward(self.lower.as_view(), whole(&mut right));
        right
    }

    /// The matrix' inverse times `B`.
    pub fn solve<C: Dim, S: Storage<f64, Dyn, C>>(&self, right: &Matrix<f64, Dyn, C, S>) -> OMatrix<f64, Dyn, C>
    where
        DefaultAllocator: Allocator<Dyn, C>,
    {
        self.solve_transposed(self.whiten(right))
    }

    /// `L^-T B`.
    pub fn solve_transposed<C: Dim>(&self, mut right: OMatrix<f64, Dyn, C>) -> OMatrix<f64, Dyn, C>
    where
        DefaultAllocator: Allocator<Dyn, C>,
    {
        backward(self.lower.as_view(), whole(&mut right));
        right
    }

    /// The matrix' inverse.
    pub fn inverse(&self) -> DMatrix<f64> {
        gram(&self.inverse_lower())
    }

    /// Diagonal of the matrix' inverse.
    pub fn inverse_diagonal(&self) -> Vec<f64> {
        self.inverse_lower().column_iter().map(|column| column.norm_squared()).collect()
    }

    /// `L^-1`.
    pub fn inverse_lower(&self) -> DMatrix<f64> {
        let n = self.lower.nrows();
        let mut inverse = DMatrix::identity(n, n);
        invert(self.lower.as_view(), inverse.as_view_mut());
        inverse
    }
}

/// `A^T A`.
pub fn gram(columns: &DMatrix<f64>) -> DMatrix<f64> {
    symmetric(columns, columns)
}

/// `A^T B` that is symmetric: half of the products.
pub fn symmetric(columns: &DMatrix<f64>, others: &DMatrix<f64>) -> DMatrix<f64> {
    let back = columns.transpose();
    let mut gram = DMatrix::zeros(columns.ncols(), columns.ncols());
    lower_gram(back.as_view(), others.as_view(), gram.as_view_mut());
    gram.fill_upper_triangle_with_lower_triangle();
    gram
}

fn lower_gram(back: DMatrixView<f64>, columns: DMatrixView<f64>, mut gram: DMatrixViewMut<f64>) {
    let (n, half) = (gram.nrows(), gram.nrows() / 2);
    if n <= COLUMNS {
        gram.gemm(1.0, &back, &columns, 0.0);
        return;
    }
    lower_gram(back.rows(0, half), columns.columns(0, half), gram.view_mut((0, 0), (half, half)));
    gram.view_mut((half, 0), (n - half, half)).gemm(1.0, &back.rows(half, n - half), &columns.columns(0, half), 0.0);
    lower_gram(
        back.rows(half, n - half),
        columns.columns(half, n - half),
        gram.view_mut((half, half), (n - half, n - half)),
    );
}

/// A matrix as one of any number of columns.
fn whole<C: Dim>(matrix: &mut OMatrix<f64, Dyn, C>) -> DMatrixViewMut<'_, f64>
where
    DefaultAllocator: Allocator<Dyn, C>,
{
    let (rows, columns) = matrix.shape();
    DMatrixViewMut::from_slice(matrix.as_mut_slice(), rows, columns)
}

/// The lower triangle of `A` becomes that of `L`: with `A` in four blocks, `L11` of `A11`, `L21 = A21 L11^-T`, `L22` of `A22 - L21 L21^T`.
fn factorise(mut matrix: DMatrixViewMut<f64>) -> Option<()> {
    let n = matrix.nrows();
    if n <= FACTORISED {
        let factor = matrix.clone_owned().cholesky()?;
        matrix.copy_from(factor.l_dirty());
        return Some(());
    }
    let half = n / 2;
    factorise(matrix.view_mut((0, 0), (half, half)))?;
    let mut across = matrix.view((half, 0), (n - half, half)).transpose();
    forward(matrix.view((0, 0), (half, half)), across.as_view_mut());
    let below = across.transpose();
    matrix.view_mut((half, half), (n - half, n - half)).gemm(-1.0, &below, &across, 1.0);
    matrix.view_mut((half, 0), (n - half, half)).copy_from(&below);
    factorise(matrix.view_mut((half, half), (n - half, n - half)))
}

/// `L^-1` in place of 1: with `L` in four blocks, `L11^-1`, `-L22^-1 L21 L11^-1`, `L22^-1`.
fn invert(lower: DMatrixView<f64>, mut inverse: DMatrixViewMut<f64>) {
    let n = lower.nrows();
    if n <= ROWS {
        lower.solve_lower_triangular_unchecked_mut(&mut inverse);
        return;
    }
    let half = n / 2;
    invert(lower.view((0, 0), (half, half)), inverse.view_mut((0, 0), (half, half)));
    let below = lower.view((half, 0), (n - half, half)) * -inverse.view((0, 0), (half, half));
    inverse.view_mut((half, 0), (n - half, half)).copy_from(&below);
    let of_rest = lower.view((half, half), (n - half, n - half));
    forward(of_rest, inverse.view_mut((half, 0), (n - half, half)));
    invert(of_rest, inverse.view_mut((half, half), (n - half, n - half)));
}

/// Solve column by column, or many columns by the product with the inverse.
fn solve_block(mut right: DMatrixViewMut<f64>, solve: impl Fn(&mut DMatrixViewMut<f64>)) {
    if right.ncols() < MANY {
        return solve(&mut right);
    }
    let mut inverse = DMatrix::identity(right.nrows(), right.nrows());
    solve(&mut inverse.as_view_mut());
    let product = inverse * &right;
    right.copy_from(&product);
}

fn forward(lower: DMatrixView<f64>, mut right: DMatrixViewMut<f64>) {
    let n = lower.nrows();
    if n <= ROWS || right.ncols() <= FEW {
        return solve_block(right, |columns| lower.solve_lower_triangular_unchecked_mut(columns));
    }
    let half = n / 2;
    let (mut first, mut rest) = right.rows_range_pair_mut(..half, half..);
    forward(lower.view((0, 0), (half, half)), first.as_view_mut());
    rest.gemm(-1.0, &lower.view((half, 0), (n - half, half)), &first, 1.0);
    forward(lower.view((half, half), (n - half, n - half)), rest);
}

/// `L^-T B` in place of `B`.
fn backward(lower: DMatrixView<f64>, mut right: DMatrixViewMut<f64>) {
    let n = lower.nrows();
    if n <= ROWS || right.ncols() <= FEW {
        return solve_block(right, |columns| lower.tr_solve_lower_triangular_unchecked_mut(columns));
    }
    let half = n / 2;
    let (mut first, mut rest) = right.rows_range_pair_mut(..half, half..);
    backward(lower.view((half, half), (n - half, n - half)), rest.as_view_mut());
    first.gemm(-1.0, &lower.view((half, 0), (n - half, half)).transpose(), &rest, 1.0);
    backward(lower.view((0, 0), (half, half)), first);
}

#[cfg(test)]
mod tests {
    use nalgebra::DVector;

    use super::*;

    fn positive(n: usize) -> DMatrix<f64> {
        let root = DMatrix::from_fn(n, n, |i, j| (1.0 + (3 * i + 7 * j) as f64).sin());
        &root * root.transpose() / n as f64 + DMatrix::identity(n, n)
    }

    #[test]
    fn a_matrix_times_its_solution_is_the_right_side() {
        for (n, columns) in [(1, 5), (ROWS, 5), (ROWS + 1, 5), (5 * ROWS + 3, 5), (5 * ROWS + 3, MANY)] {
            let right = DMatrix::from_fn(n, columns, |i, j| ((i + 1) * (j + 2)) as f64 % 5.0);
            let matrix = positive(n);
            let factor = Factor::of(matrix.clone()).unwrap();
            let near = |one: &DMatrix<f64>, other: &DMatrix<f64>| assert!((one - other).amax() < 1e-11, "{n} rows");
            near(&(&matrix * factor.solve(&right)), &right);
            near(&(factor.lower() * factor.whiten(&right)), &right);
            near(&factor.matrix(), &matrix);
            near(&(&matrix * factor.inverse()), &DMatrix::identity(n, n));
            let one: DVector<f64> = right.column(2).into_owned();
            assert!((&matrix * factor.solve(&one) - one).amax() < 1e-11, "{n} rows");
            let own = matrix.clone().cholesky().unwrap();
            assert!((factor.log_determinant() - own.determinant().ln()).abs() < 1e-9, "{n} rows");
            let diagonal = DVector::from_vec(factor.inverse_diagonal());
            assert!((diagonal - own.inverse().diagonal()).amax() < 1e-12, "{n} rows");
        }
    }

    #[test]
    fn half_of_the_products_make_the_whole_gram_matrix() {
        let columns = DMatrix::from_fn(7, 3 * ROWS + 5, |i, j| (1.0 + (3 * i + 7 * j) as f64).sin());
        assert!((gram(&columns) - columns.transpose() * &columns).amax() < 1e-12, "rounding");
    }

    #[test]
    fn what_is_not_positive_has_no_factor() {
        let mut matrix = positive(5 * ROWS);
        matrix[(2 * ROWS, 2 * ROWS)] = -1.0;
        assert!(Factor::of(matrix).is_none());
    }
}
