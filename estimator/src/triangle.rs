//! Symmetric and triangular matrices, packed: a lower triangle row by row, half the memory of a square.

use crate::linear::{Real, add, add_four, add_four_to_each, combine, dot};
use crate::state::{Bytes, State, StateError};

/// Lower triangle of an `N x N` matrix; `T = N (N + 1)/2` entries, row `i` holds columns `0..=i`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Triangle<const N: usize, const T: usize, R = f32>([R; T]);

impl<const N: usize, const T: usize, R: State> State for Triangle<N, T, R> {
    fn pass(&mut self, bytes: &mut impl Bytes) -> Result<(), StateError> {
        self.0.pass(bytes)
    }
}

impl<const N: usize, const T: usize, R: Real> Triangle<N, T, R> {
    const FITS: () = assert!(T == N * (N + 1) / 2, "T entries make a triangle of N");

    /// All zero.
    pub const ZERO: Self = Self([R::ZERO; T]);

    /// The rows, each up to its diagonal.
    pub fn rows(&self) -> Rows<'_, R> {
        self.rows_from(0)
    }

    /// The rows, to be changed.
    pub fn rows_mut(&mut self) -> RowsMut<'_, R> {
        self.rows_from_mut(0)
    }

    /// The rows from the `i`-th on.
    pub fn rows_from(&self, i: usize) -> Rows<'_, R> {
        let () = Self::FITS;
        Rows { rest: self.0.get(start(i)..).unwrap_or_default(), length: i + 1 }
    }

    /// The rows from the `i`-th on, to be changed.
    pub fn rows_from_mut(&mut self, i: usize) -> RowsMut<'_, R> {
        let () = Self::FITS;
        RowsMut { rest: self.0.get_mut(start(i)..).unwrap_or_default(), length: i + 1 }
    }

    /// All entries, row by row.
    pub fn entries(&self) -> &[R] {
        &self.0
    }

    /// The same, to be changed.
    pub fn entries_mut(&mut self) -> &mut [R] {
        &mut self.0
    }

    /// One row up to its diagonal; empty beyond the last.
    pub fn row(&self, i: usize) -> &[R] {
        self.0.get(start(i)..start(i + 1)).unwrap_or_default()
    }

    /// One row, to be changed.
    pub fn row_mut(&mut self, i: usize) -> &mut [R] {
        self.0.get_mut(start(i)..start(i + 1)).unwrap_or_default()
    }

    /// An entry of the symmetric matrix; 0 beyond its edge.
    pub fn get(&self, i: usize, j: usize) -> R {
        self.row(i.max(j)).get(i.min(j)).copied().unwrap_or(R::ZERO)
    }

    /// Copy a whole row, which is also a column, of the symmetric matrix.
    pub fn copy_row(&self, i: usize, to: &mut [R; N]) {
        let (left, right) = to.split_at_mut_checked(i + 1).unwrap_or_default();
        left.iter_mut().zip(self.row(i)).for_each(|(to, v)| *to = *v);
        let below = self.rows_from(i + 1);
        right.iter_mut().zip(below).for_each(|(to, row)| *to = row.get(i).copied().unwrap_or(R::ZERO));
    }

    /// Set the diagonal to one value, the rest to zero.
    pub fn fill_diagonal(&mut self, value: R) {
        self.0.fill(R::ZERO);
        self.rows_mut().filter_map(<[R]>::last_mut).for_each(|diagonal| *diagonal = value);
    }

    /// `A += sum of factor * row` for four rows, each of them with its own factor for each row of `A`.
    pub fn add_products(&mut self, factors: impl Fn(usize) -> [R; 4], rows: [&[R]; 4]) {
        self.add_products_from(0, factors, rows);
    }

    /// The same for the part of `A` from row and column `from` on.
    fn add_products_from(&mut self, from: usize, factors: impl Fn(usize) -> [R; 4], rows: [&[R]; 4]) {
        let rows = rows.map(|row| row.get(from..).unwrap_or_default());
        let own = (from..).zip(self.rows_from_mut(from));
        add_four_to_each(own.map(|(i, row)| (row.get_mut(from..).unwrap_or_default(), factors(i))), rows);
    }

    /// `A x` for the symmetric matrix.
    pub fn multiply(&self, x: &[R; N]) -> [R; N] {
        let mut product = [R::ZERO; N];
        for (i, (row, xi)) in self.rows().zip(x).enumerate() {
            let Some((diagonal, left)) = row.split_last() else { continue };
            add(&mut product, *xi, left);
            if let Some(to) = product.get_mut(i) {
                *to += *diagonal * *xi + dot(left, x);
            }
        }
        product
    }
}

impl<const N: usize, const T: usize> Triangle<N, T, f64> {
    /// Cholesky factor `L` of the symmetric matrix, in place, and the logarithm of its determinant; none if it is not
    /// positive. nalgebra's own takes a full matrix by value, 9 kB of stack.
    ///
    /// Four columns of the factor at a time, then their products are subtracted from the remaining rows.
    #[inline(never)] // four columns on the stack
    pub fn factorise(&mut self) -> Option<f64> {
        let mut log_determinant = 0.0;
        for from in (0..N).step_by(4) {
            let to = (from + 4).min(N);
            let mut columns = [[0.0; N]; 4];
            for (j, m) in (from..to).zip(0..) {
                let (done, [column, ..]) = columns.split_at_mut_checked(m)? else { return None };
                log_determinant += libm::log(self.factorise_column(j, column, done)?);
            }
            let factors = |r: usize| columns.each_ref().map(|column| -column.get(r).copied().unwrap_or(0.0));
            self.add_products_from(to, factors, columns.each_ref().map(<[f64; N]>::as_slice));
        }
        Some(log_determinant)
    }

    /// Column `j` of the factor, to `column` and in place; earlier columns have been eliminated, except those of its own
    /// group. Returns its pivot, the square of its diagonal.
    fn factorise_column(&mut self, j: usize, column: &mut [f64; N], group: &[[f64; N]]) -> Option<f64> {
        let below = column.get_mut(j..)?;
        below.iter_mut().zip(self.rows_from(j)).for_each(|(to, row)| *to = row.get(j).copied().unwrap_or(0.0));
        combine(
            below,
            group.iter().map(|before| (-before.get(j).unwrap_or(&0.0), before.get(j..).unwrap_or_default())),
        );
        let pivot = *below.first()?;
        if !(pivot.is_finite() && pivot > 0.0) {
            return None;
        }
        let scale = 1.0 / libm::sqrt(pivot);
        for (l, row) in below.iter_mut().zip(self.rows_from_mut(j)) {
            *l *= scale;
            row.get_mut(j).into_iter().for_each(|to| *to = *l);
        }
        Some(pivot)
    }

    /// Invert a lower triangle, in place: `x_i = (e_i - sum over k < i of L_ik x_k)/L_ii` by rows.
    ///
    /// Four rows of the inverse at a time; in the rows below, entries left of the remaining factor hold the sum so far.
    #[inline(never)] // four rows on the stack
    pub fn invert(&mut self) {
        for from in (0..N).step_by(4) {
            let to = (from + 4).min(N);
            let mut inverse = [[0.0; N]; 4];
            for (i, m) in (from..to).zip(0..) {
                let Some((done, [x, ..])) = inverse.split_at_mut_checked(m) else { return };
                invert_row(self.row_mut(i), from, done, x);
            }
            for row in self.rows_from_mut(to) {
                let Some(sum) = row.get_mut(..to) else { return };
                let mut factor = [0.0; 4];
                let own = sum.get_mut(from..).unwrap_or_default();
                factor.iter_mut().zip(own).for_each(|(to, l)| *to = -core::mem::take(l));
                add_four(sum, factor, inverse.each_ref().map(<[f64; N]>::as_slice));
            }
        }
    }

    /// `L^T L` of a lower triangle, in place: `sum over i >= j of L_ij L_ik` by rows `j`, for which only later rows are needed.
    pub fn square(&mut self) {
        square(&mut self.0);
    }

    /// `L x` for a lower triangle, in place.
    pub fn apply_lower(&self, x: &mut [f64; N]) {
        for i in (0..N).rev() {
            let product = dot(self.row(i), x);
            x.get_mut(i).into_iter().for_each(|x| *x = product);
        }
    }

    /// `L^T x` for a lower triangle.
    pub fn apply_upper(&self, x: &[f64; N]) -> [f64; N] {
        let mut product = [0.0; N];
        self.rows().zip(x).for_each(|(row, x)| add(&mut product, *x, row));
        product
    }

    /// `L x = b` for a lower triangle, in place.
    pub fn solve_lower(&self, x: &mut [f64; N]) {
        for (i, row) in self.rows().enumerate() {
            if let (Some((pivot, left)), Some((done, [here, ..]))) = (row.split_last(), x.split_at_mut_checked(i)) {
                *here = (*here - dot(left, done)) / pivot;
            }
        }
    }

    /// `L^T x = b` for a lower triangle, in place.
    pub fn solve_upper(&self, x: &mut [f64; N]) {
        for i in (0..N).rev() {
            if let (Some((pivot, left)), Some((open, [here, ..]))) =
                (self.row(i).split_last(), x.split_at_mut_checked(i))
            {
                *here /= pivot;
                add(open, -*here, left);
            }
        }
    }
}

/// [`Triangle::square`] of the entries of a triangle of any size.
#[inline(never)]
pub fn square(entries: &mut [f64]) {
    let mut j = 0;
    while let Some((done, below)) = entries.split_at_mut_checked(start(j + 1)) {
        let row = done.get_mut(start(j)..).unwrap_or_default();
        let own = row.last().copied().unwrap_or(0.0);
        row.iter_mut().for_each(|l| *l *= own);
        let below = Rows { rest: below, length: j + 2 };
        combine(row, below.map(|l| (l.get(j).copied().unwrap_or(0.0), l)));
        j += 1;
    }
}

/// Start of a row among the entries of a packed triangle.
pub const fn start(row: usize) -> usize {
    row.saturating_mul(row.saturating_add(1)) / 2
}

/// A row of the inverse, to `x` and in place: left of `from` the row holds the sum so far, from there on the factor, whose
/// rows `done` are inverted.
fn invert_row<const N: usize>(row: &mut [f64], from: usize, done: &[[f64; N]], x: &mut [f64; N]) {
    let Some((diagonal, left)) = row.split_last_mut() else { return };
    let scale = 1.0 / *diagonal;
    let (sum, own) = left.split_at_mut_checked(from).unwrap_or_default();
    x.iter_mut().zip(sum.iter()).for_each(|(x, sum)| *x = *sum);
    combine(x, own.iter().map(|l| -l).zip(done.iter().map(<[f64; N]>::as_slice)));
    x.iter_mut().for_each(|x| *x *= scale);
    left.iter_mut().zip(x.iter()).for_each(|(to, x)| *to = *x);
    *diagonal = scale;
    x.get_mut(left.len()).into_iter().for_each(|x| *x = scale);
}

/// The rows of a packed triangle, one longer than the other.
#[derive(Debug, Clone)]
pub struct Rows<'a, R> {
    rest: &'a [R],
    length: usize,
}

impl<'a, R> Iterator for Rows<'a, R> {
    type Item = &'a [R];

    fn next(&mut self) -> Option<&'a [R]> {
        let (row, rest) = self.rest.split_at_checked(self.length)?;
        (self.rest, self.length) = (rest, self.length + 1);
        Some(row)
    }
}

/// The rows of a packed triangle, to be changed.
#[derive(Debug)]
pub struct RowsMut<'a, R> {
    rest: &'a mut [R],
    length: usize,
}

impl<'a, R> Iterator for RowsMut<'a, R> {
    type Item = &'a mut [R];

    fn next(&mut self) -> Option<&'a mut [R]> {
        let (row, rest) = core::mem::take(&mut self.rest).split_at_mut_checked(self.length)?;
        (self.rest, self.length) = (rest, self.length + 1);
        Some(row)
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{SMatrix, SVector};

    use super::*;

    /// A positive matrix, and its triangle.
    fn example() -> (SMatrix<f64, 9, 9>, Triangle<9, 45, f64>) {
        let r = SMatrix::<f64, 9, 9>::from_fn(|i, j| libm::sin((3 * i + 5 * j * j) as f64));
        let a = r * r.transpose() + SMatrix::identity();
        let mut triangle = Triangle::ZERO;
        for (i, row) in triangle.rows_mut().enumerate() {
            row.iter_mut().enumerate().for_each(|(j, v)| *v = a[(i, j)]);
        }
        (a, triangle)
    }

    #[test]
    fn entries_rows_and_products_are_those_of_the_matrix() {
        let (a, triangle) = example();
        let x: [f64; 9] = core::array::from_fn(|i| i as f64 - 2.0);
        let product = a * SVector::from(x);
        for i in 0..9 {
            let mut row = [0.0; 9];
            triangle.copy_row(i, &mut row);
            assert_eq!(row, core::array::from_fn(|j| a[(i.max(j), i.min(j))]));
            assert!((triangle.multiply(&x)[i] - product[i]).abs() < 1e-12); // rounding
            assert_eq!(triangle.get(i, 3), a[(i.max(3), i.min(3))]);
        }
        assert_eq!((triangle.rows().count(), triangle.get(9, 0), triangle.row(9).len()), (9, 0.0, 0));
    }

    #[test]
    fn the_factor_solves_and_inverts() {
        let (a, mut factor) = example();
        let log_determinant = factor.factorise().unwrap();
        assert!((log_determinant - libm::log(a.determinant())).abs() < 1e-12);
        let x = SVector::<f64, 9>::from_fn(|i, _| i as f64 - 2.0);
        let mut b: [f64; 9] = (a * x).into();
        factor.solve_lower(&mut b);
        factor.solve_upper(&mut b);
        let mut inverse = factor;
        inverse.invert();
        for i in 0..9 {
            assert!((b[i] - x[i]).abs() < 1e-12, "{} {}", b[i], x[i]);
            for j in 0..=i {
                let product: f64 = (j..=i).map(|k| factor.get(i, k) * inverse.get(k, j)).sum();
                assert!((product - f64::from(u8::from(i == j))).abs() < 1e-13);
            }
        }
    }

    #[test]
    fn products_of_a_lower_triangle() {
        let (_, lower) = example();
        let l = SMatrix::<f64, 9, 9>::from_fn(|i, j| lower.row(i).get(j).copied().unwrap_or(0.0));
        let x = SVector::<f64, 9>::from_fn(|i, _| i as f64 - 2.0);
        let (mut low, mut square) = (x.into(), lower);
        lower.apply_lower(&mut low);
        square.square();
        assert!((SVector::from(low) - l * x).norm() < 1e-12); // rounding
        assert!((SVector::from(lower.apply_upper(&x.into())) - l.transpose() * x).norm() < 1e-12);
        let expected = l.transpose() * l;
        assert!((0..9).all(|i| (0..9).all(|j| (square.get(i, j) - expected[(i, j)]).abs() < 1e-12)));
    }

    #[test]
    fn what_is_not_positive_has_no_factor() {
        let mut zero = Triangle::<3, 6, f64>::ZERO;
        assert_eq!(zero.factorise(), None);
        zero.fill_diagonal(f64::NAN);
        assert_eq!(zero.factorise(), None);
    }
}
