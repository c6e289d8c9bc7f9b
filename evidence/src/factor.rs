//! The Cholesky factor of a positive matrix, and products of which half is made, by faer: nalgebra's go column by column and take several times as long.

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt::factor::{LltRegularization, cholesky_in_place, cholesky_in_place_scratch};
use faer::linalg::matmul::triangular;
use faer::linalg::triangular_inverse::invert_lower_triangular;
use faer::linalg::triangular_solve::{solve_lower_triangular_in_place, solve_upper_triangular_in_place};
use faer::{Accum, MatMut, MatRef, Par};
use nalgebra::allocator::Allocator;
use nalgebra::{DMatrix, DefaultAllocator, Dim, Dyn, Matrix, OMatrix, Storage};

/// `L` of a positive matrix `L L^T`.
#[derive(Debug, Clone)]
pub struct Factor {
    /// Above the diagonal it is not `L`, and not read.
    lower: DMatrix<f64>,
}

impl Factor {
    /// Of a matrix of which the lower triangle is read; none if it is not positive.
    pub fn of(mut matrix: DMatrix<f64>) -> Option<Self> {
        let mut memory = MemBuffer::new(cholesky_in_place_scratch::<f64>(matrix.nrows(), Par::Seq, Default::default()));
        let (regularization, stack) = (LltRegularization::default(), MemStack::new(&mut memory));
        cholesky_in_place(view_mut(&mut matrix), regularization, Par::Seq, stack, Default::default()).ok()?;
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
        solve_lower_triangular_in_place(view(&self.lower), view_mut(&mut right), Par::Seq);
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
        solve_upper_triangular_in_place(view(&self.lower).transpose(), view_mut(&mut right), Par::Seq);
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
        let mut inverse = DMatrix::zeros(n, n);
        invert_lower_triangular(view_mut(&mut inverse), view(&self.lower), Par::Seq);
        inverse
    }
}

/// `A^T A`.
pub fn gram(columns: &DMatrix<f64>) -> DMatrix<f64> {
    symmetric(columns, columns)
}

/// `A^T B` that is symmetric: half of the products.
pub fn symmetric(columns: &DMatrix<f64>, others: &DMatrix<f64>) -> DMatrix<f64> {
    use triangular::BlockStructure::{Rectangular, TriangularLower};
    let mut gram = DMatrix::zeros(columns.ncols(), columns.ncols());
    let (into, back) = (view_mut(&mut gram), view(columns).transpose());
    triangular::matmul(
        into,
        TriangularLower,
        Accum::Replace,
        back,
        Rectangular,
        view(others),
        Rectangular,
        1.0,
        Par::Seq,
    );
    gram.fill_upper_triangle_with_lower_triangle();
    gram
}

fn view(matrix: &DMatrix<f64>) -> MatRef<'_, f64> {
    MatRef::from_column_major_slice(matrix.as_slice(), matrix.nrows(), matrix.ncols())
}

fn view_mut<C: Dim>(matrix: &mut OMatrix<f64, Dyn, C>) -> MatMut<'_, f64>
where
    DefaultAllocator: Allocator<Dyn, C>,
{
    let (rows, columns) = matrix.shape();
    MatMut::from_column_major_slice_mut(matrix.as_mut_slice(), rows, columns)
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
        for (n, columns) in [(1, 5), (48, 5), (49, 5), (243, 5), (243, 96)] {
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
        let columns = DMatrix::from_fn(7, 149, |i, j| (1.0 + (3 * i + 7 * j) as f64).sin());
        assert!((gram(&columns) - columns.transpose() * &columns).amax() < 1e-12, "rounding");
    }

    #[test]
    fn what_is_not_positive_has_no_factor() {
        let mut matrix = positive(240);
        matrix[(96, 96)] = -1.0;
        assert!(Factor::of(matrix).is_none());
        assert!(Factor::of(positive(5) * f64::NAN).is_none());
    }
}
