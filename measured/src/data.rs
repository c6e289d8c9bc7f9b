//! The measured elements of a matrix, and what each of them counts.

use nalgebra::DMatrix;
use twin::Plane;

use crate::folder::{Flags, Folder};
use crate::model::Prediction;

/// Monitors' plane and correctors' plane, or the dispersion in a plane.
pub const BLOCKS: [&str; 6] = ["x to H", "x to V", "y to H", "y to V", "x to RF", "y to RF"];

/// LOCO's outlier factor.
const OUTLIER: f64 = 10.0;

/// Measured elements, and what they count.
#[derive(Debug, Clone)]
pub struct Data {
    /// The matrix with the dispersion as its last column [mm]; 0 where nothing counts.
    pub measured: DMatrix<f64>,
    /// Stated noise [mm]; infinite where nothing counts.
    pub sigma: DMatrix<f64>,
    /// Which of [`BLOCKS`] each element is of.
    pub block: DMatrix<usize>,
}

impl Data {
    /// Of a folder, the elements that the reference fit counts.
    pub fn of(folder: &Folder) -> Self {
        // without couplings LOCO takes the blocks x to V and y to H out of the data, and keeps both planes of the dispersion
        Self::with_blocks(folder, uses(folder, |flags| &flags.coupling))
    }

    /// The same with the blocks of the other plane, which a reference fit without couplings leaves out, but for some elements: row and column.
    pub fn with_coupling(folder: &Folder, outliers: &[[usize; 2]]) -> Self {
        let mut data = Self::with_blocks(folder, true);
        outliers.iter().for_each(|&[row, column]| data.sigma[(row, column)] = f64::INFINITY);
        data
    }

    fn with_blocks(folder: &Folder, uses_coupling: bool) -> Self {
        let (rows, correctors) = folder.matrix.shape();
        let columns = correctors + usize::from(folder.dispersion.is_some());
        let value = |i: usize, j: usize| match &folder.dispersion {
            Some(dispersion) if j == correctors => dispersion[i],
            _ => folder.matrix[(i, j)],
        };
        let uses_dispersion = uses(folder, |flags| &flags.dispersion);
        let counts = |i: usize, j: usize| {
            let monitor = &folder.monitors[i];
            let column = match folder.correctors.get(j) {
                Some(one) => one.is_used && (uses_coupling || one.plane == monitor.plane),
                None => uses_dispersion,
            };
            monitor.is_used && column && value(i, j).is_finite()
        };
        Self {
            measured: DMatrix::from_fn(rows, columns, |i, j| if counts(i, j) { value(i, j) } else { 0.0 }),
            sigma: DMatrix::from_fn(
                rows,
                columns,
                |i, j| if counts(i, j) { folder.monitors[i].sigma } else { f64::INFINITY },
            ),
            block: DMatrix::from_fn(rows, columns, |i, j| {
                let is_y = usize::from(folder.monitors[i].plane == Plane::Y);
                match folder.correctors.get(j) {
                    Some(one) => 2 * is_y + usize::from(one.plane == Plane::Y),
                    None => 4 + is_y,
                }
            }),
        }
    }

    /// Measured less predicted [mm], where it counts.
    pub fn residual(&self, at: &Prediction) -> DMatrix<f64> {
        residual(&self.measured, at, &self.stated())
    }

    /// One over the square of the stated noise of each element [1/mm^2].
    pub fn stated(&self) -> DMatrix<f64> {
        self.sigma.map(|sigma| sigma.powi(-2))
    }

    /// Sum of squares over the stated noise.
    pub fn chi2(&self, at: &Prediction) -> f64 {
        let left = self.residual(at);
        left.component_mul(&left).dot(&self.stated())
    }

    /// Let elements count no longer that are ten times further off than the rms of all, by the stated noise.
    pub fn set_outliers_aside(&mut self, at: &Prediction) -> Vec<[usize; 2]> {
        let largest = OUTLIER * (self.chi2(at) / self.elements() as f64).sqrt();
        let mut found = Vec::new();
        for j in 0..self.sigma.ncols() {
            for i in 0..self.sigma.nrows() {
                if ((self.measured[(i, j)] - at.matrix[(i, j)]) / self.sigma[(i, j)]).abs() > largest {
                    self.sigma[(i, j)] = f64::INFINITY;
                    found.push([i, j]);
                }
            }
        }
        found
    }

    /// Elements that count.
    pub fn elements(&self) -> usize {
        self.sigma.iter().filter(|sigma| sigma.is_finite()).count()
    }
}

/// True where the reference fit has a flag, and where there is no reference fit.
fn uses(folder: &Folder, flag: fn(&Flags) -> &str) -> bool {
    folder.meta.reference_fit.as_ref().is_none_or(|fit| flag(&fit.flags) == "Yes")
}

/// Measured less predicted, where it counts.
pub fn residual(measured: &DMatrix<f64>, at: &Prediction, weight: &DMatrix<f64>) -> DMatrix<f64> {
    (measured - &at.matrix).zip_map(weight, |residual, weight| if weight > 0.0 { residual } else { 0.0 })
}

#[cfg(test)]
mod tests {
    use crate::fit::{Settings, fit};
    use crate::testing::{NOISE, machine, measured, ring};

    /// A machine with skew gradients of 0.002 /m, fitted without couplings.
    #[test]
    fn blocks_of_the_other_plane_are_no_data_of_a_fit_without_couplings() {
        let mut ring = ring();
        let truth = machine(&ring, 1);
        let reference = ring.meta.reference_fit.as_mut().unwrap();
        reference.flags.coupling = "No".into();
        reference.fit_parameters.retain(|group| group.field == "K");
        let fitted = fit(&measured(&ring, &truth, NOISE, 2), &Settings::default(), &mut |_| ()).unwrap();
        // 12 monitors and 12 correctors a plane, and the dispersion of both
        assert_eq!(fitted.elements, 2 * 12 * 12 + 24);
        assert!(fitted.noise.blocks[1].scale == 0.0 && fitted.noise.blocks[2].scale == 0.0);
        // what the couplings do in the blocks of one plane is of second order
        assert!(fitted.chi2_loco < 2.0, "{}", fitted.chi2_loco);
    }
}
