//! Normal equations in the shape of an arrow: an unknown of a monitor meets those of other monitors nowhere, and one of a corrector those of other
//! correctors, so that blocks of one or two unknowns are eliminated in closed form.
//!
//! With the blocks `D`, the rest `C` and `B` between them, `X = D^-1 B` and `S = C - B^T X`
//!
//! `(D B; B^T C)^-1 = (D^-1 + X S^-1 X^T, -X S^-1; -S^-1 X^T, S^-1)`.

use evidence::Factor;
use nalgebra::{DMatrix, DVector};

use crate::linear::{product, transposed_product};

/// A symmetric positive matrix with blocks that do not meet, factored.
pub struct Arrow {
    /// Numbers of the unknowns of the blocks, block by block, and of all others.
    eliminated: Vec<usize>,
    rest: Vec<usize>,
    /// `D^-1`, an inverse a block.
    blocks: Vec<DMatrix<f64>>,
    /// `X`.
    follow: DMatrix<f64>,
    /// Factor of `S`.
    schur: Factor,
}

impl Arrow {
    /// None where the matrix is not positive.
    pub fn of(matrix: &DMatrix<f64>, blocks: &[Vec<usize>]) -> Option<Self> {
        let eliminated = blocks.concat();
        let mut is_rest = vec![true; matrix.nrows()];
        eliminated.iter().for_each(|&one| is_rest[one] = false);
        let rest: Vec<usize> = (0..matrix.nrows()).filter(|&one| is_rest[one]).collect();
        let part = |rows: &[usize], columns: &[usize]| {
            DMatrix::from_fn(rows.len(), columns.len(), |i, j| matrix[(rows[i], columns[j])])
        };
        let across = part(&eliminated, &rest);
        let inverse = |block: &Vec<usize>| Some(part(block, block).cholesky()?.inverse());
        let blocks = blocks.iter().map(inverse).collect::<Option<Vec<_>>>()?;
        let follow = by_blocks(&blocks, &across);
        let schur = Factor::of(part(&rest, &rest) - transposed_product(&across, &follow))?;
        Some(Self { eliminated, rest, blocks, follow, schur })
    }

    /// Solution for a right-hand side.
    pub fn solve(&self, right: &DVector<f64>) -> DVector<f64> {
        let of_blocks = right.select_rows(&self.eliminated);
        let rest = self.schur.solve(&(right.select_rows(&self.rest) - self.follow.tr_mul(&of_blocks)));
        let of_blocks = by_blocks(&self.blocks, &DMatrix::from_columns(&[of_blocks])).column(0) - &self.follow * &rest;
        let mut solution = DVector::zeros(right.len());
        self.eliminated.iter().zip(&of_blocks).for_each(|(&at, &one)| solution[at] = one);
        self.rest.iter().zip(&rest).for_each(|(&at, &one)| solution[at] = one);
        solution
    }

    /// Inverse of the matrix.
    pub fn inverse(&self) -> DMatrix<f64> {
        let schur = self.schur.inverse();
        let across = product(&self.follow, &schur);
        let of_blocks = product(&across, &self.follow.transpose());
        let n = self.eliminated.len() + self.rest.len();
        let mut inverse = DMatrix::zeros(n, n);
        for (j, &column) in self.eliminated.iter().enumerate() {
            self.eliminated.iter().enumerate().for_each(|(i, &row)| inverse[(row, column)] = of_blocks[(i, j)]);
        }
        for (j, &column) in self.rest.iter().enumerate() {
            self.rest.iter().enumerate().for_each(|(i, &row)| inverse[(row, column)] = schur[(i, j)]);
            for (i, &row) in self.eliminated.iter().enumerate() {
                inverse[(row, column)] = -across[(i, j)];
                inverse[(column, row)] = -across[(i, j)];
            }
        }
        let mut numbers = self.eliminated.as_slice();
        for block in &self.blocks {
            let (own, further) = numbers.split_at(block.nrows());
            numbers = further;
            for (i, j) in (0..own.len()).flat_map(|i| (0..own.len()).map(move |j| (i, j))) {
                inverse[(own[i], own[j])] += block[(i, j)];
            }
        }
        inverse
    }
}

/// Blocks in a row times a matrix.
fn by_blocks(blocks: &[DMatrix<f64>], matrix: &DMatrix<f64>) -> DMatrix<f64> {
    let mut made = DMatrix::zeros(matrix.nrows(), matrix.ncols());
    let mut first = 0;
    for block in blocks {
        made.rows_mut(first, block.nrows()).gemm(1.0, block, &matrix.rows(first, block.nrows()), 0.0);
        first += block.nrows();
    }
    made
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::normal;

    #[test]
    fn blocks_that_are_eliminated_leave_the_solution_as_it_is() {
        let (mut random, n) = (normal(2), 40);
        let blocks = vec![vec![3, 17], vec![20], vec![5, 4], vec![31, 30]];
        // each row of the root touches one block at most
        let in_block = |column: usize| blocks.iter().position(|block: &Vec<usize>| block.contains(&column));
        let root = DMatrix::from_fn(3 * n, n, |row, column| {
            let touches = in_block(column).is_none_or(|block| row % blocks.len() == block);
            if touches { random() } else { 0.0 }
        });
        let matrix = root.tr_mul(&root) + DMatrix::identity(n, n);
        let right = DVector::from_fn(n, |_, _| random());
        let arrow = Arrow::of(&matrix, &blocks).unwrap();
        let inverse = Factor::of(matrix.clone()).unwrap().inverse();
        assert!((arrow.inverse() - &inverse).amax() < 1e-12 * inverse.amax() * n as f64, "rounding");
        assert!((arrow.solve(&right) - inverse * right).amax() < 1e-11, "rounding");
        assert!(Arrow::of(&-&matrix, &blocks).is_none());
        let mut edge = matrix;
        edge[(0, 0)] = -1.0;
        assert!(Arrow::of(&edge, &blocks).is_none());
    }
}
