//! Noise that monitors have in common within a frame: the momentum's jitter, in the dispersion's pattern, and that of a crate of
//! electronics, the same in neighbouring monitors.
//!
//! In units of the monitors' own noise a frame has the covariance `1 + F F^T`, a column of F for each mode, over the monitors whose
//! readings count in that frame; where their own noise is larger by a level, F is smaller by it. With the thin decomposition `F = Q D V^T` it is whitened by the symmetric
//! `M = 1 - Q (1 - (1 + D^2)^(-1/2)) Q^T`.

use nalgebra::{DMatrix, DVector};

/// The whitening of the modes of all frames, frame by frame.
#[derive(Debug, Clone, Default)]
pub struct Mixing {
    frames: Vec<Mixed>,
}

/// That of one frame.
#[derive(Debug, Clone)]
struct Mixed {
    /// `Q` [monitors][modes], 0 for a monitor whose reading does not count.
    basis: DMatrix<f64>,
    /// `1 - (1 + D^2)^(-1/2)` of each.
    shrink: DVector<f64>,
}

impl Mixing {
    /// Of F, rows monitors, in units of their own noise, over the readings that count in frames of which the noise has a level, rows frames.
    pub fn from_modes(modes: &DMatrix<f64>, levels: &[f64], counts: impl Fn(usize, usize) -> bool) -> Self {
        let mixed_in_frame = |(frame, level): (usize, &f64)| {
            let mut factors = modes / *level;
            for (b, mut row) in factors.row_iter_mut().enumerate() {
                if !counts(frame, b) {
                    row.fill(0.0);
                }
            }
            let svd = factors.svd(true, false);
            let shrink = svd.singular_values.map(|d| 1.0 - (1.0 + d * d).sqrt().recip());
            Mixed { basis: svd.u.expect("asked for"), shrink }
        };
        Self {
            frames: if modes.is_empty() { Vec::new() } else { levels.iter().enumerate().map(mixed_in_frame).collect() },
        }
    }

    /// True if monitors have nothing in common.
    pub fn is_none(&self) -> bool {
        self.frames.is_empty()
    }

    /// Multiply each frame by M; rows frames, columns monitors, 0 for readings that do not count.
    pub fn apply(&self, values: &mut DMatrix<f64>) {
        for (i, Mixed { basis, shrink }) in self.frames.iter().enumerate() {
            let common = (values.row(i) * basis).component_mul(&shrink.transpose());
            let mut row = values.row_mut(i);
            row -= common * basis.transpose();
        }
    }

    /// Diagonal of `M^2` of a monitor in a frame: what its readings tell beside those of the others.
    pub fn own(&self, frame: usize, b: usize) -> f64 {
        let Some(Mixed { basis, shrink }) = self.frames.get(frame) else { return 1.0 };
        1.0 - (0..shrink.len()).map(|k| basis[(b, k)].powi(2) * shrink[k] * (2.0 - shrink[k])).sum::<f64>()
    }

    /// `ln` of the determinant of the covariances.
    pub(crate) fn log_det(&self) -> f64 {
        (0..self.frames.len()).map(|frame| self.log_det_of(frame)).sum()
    }

    /// The same of one frame.
    pub(crate) fn log_det_of(&self, frame: usize) -> f64 {
        let log_det = |mixed: &Mixed| mixed.shrink.iter().map(|shrink| -2.0 * (1.0 - shrink).ln()).sum::<f64>();
        self.frames.get(frame).map_or(0.0, log_det)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_whitened_by_the_symmetric_root_of_its_covariance() {
        let factors = DMatrix::from_row_slice(4, 2, &[0.5, 0.0, -0.7, 0.0, 0.3, 0.6, 0.9, 0.6]);
        let counts = |frame: usize, b: usize| frame == 0 || b != 1;
        let levels = [1.0, 3.0];
        let mixing = Mixing::from_modes(&factors, &levels, counts);
        let mut log_det = 0.0;
        for frame in 0..2 {
            let kept =
                DMatrix::from_fn(4, 2, |b, k| if counts(frame, b) { factors[(b, k)] / levels[frame] } else { 0.0 });
            let covariance = DMatrix::identity(4, 4) + &kept * kept.transpose();
            log_det += covariance.determinant().ln();
            let mut root = DMatrix::zeros(4, 4);
            for b in 0..4 {
                let mut values = DMatrix::zeros(2, 4);
                values[(frame, b)] = 1.0;
                mixing.apply(&mut values);
                root.set_column(b, &values.row(frame).transpose());
            }
            assert!((&root * &covariance * &root - DMatrix::identity(4, 4)).amax() < 1e-12, "rounding");
            let square = &root * &root;
            (0..4).for_each(|b| assert!((mixing.own(frame, b) - square[(b, b)]).abs() < 1e-12, "rounding"));
        }
        assert!((mixing.log_det() - log_det).abs() < 1e-12, "rounding");
    }
}
