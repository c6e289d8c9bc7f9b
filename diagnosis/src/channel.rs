//! The pooled readings of one monitor, or of one tune, whitened.
//!
//! A pool's mean has the noise of its frames: `sigma^2/n` of white noise, and otherwise the mean of the memory's covariance over the
//! frames of both pools ([`Filter`]); more where their level is higher ([`Levels`]). With `A` the inverse of the root of that covariance, and the common terms of the readings as the thin decomposition
//! `A U = Q D V^T`, the whitening is
//!
//! `T = (1 - Q (1 - (1 + D^2)^(-1/2)) Q^T) A`, so that `T^T T = (C + U U^T)^-1`.

use nalgebra::{DMatrix, DMatrixViewMut, DVector};

use super::levels::Levels;
use super::memory::{Filter, Memory};

/// A monitor's or a tune's readings.
#[derive(Debug, Clone)]
pub struct Channel {
    /// Pools with readings that count.
    pub rows: Vec<usize>,
    /// Noise of one reading.
    pub sigma: f64,
    root: Root,
    /// `Q` [rows][factors].
    basis: DMatrix<f64>,
    /// `1 - (1 + D^2)^(-1/2)` of each.
    shrink: DVector<f64>,
    /// `ln` of the covariance's determinant.
    pub log_det: f64,
}

/// Root of the covariance of the means, in units of the noise of one reading.
#[derive(Debug, Clone)]
enum Root {
    /// White noise: the roots of the numbers of readings, of such as have the ordinary level.
    White(DVector<f64>),
    /// Noise with a memory.
    Remembers(Filter),
}

impl Root {
    /// `frames` of each row.
    fn from_memory(memory: Memory, levels: &Levels, frames: &[Vec<usize>]) -> Self {
        let origin = frames.first().map_or(0, |frames| frames[0]);
        let filter = Filter::from_pools(memory, levels, origin, frames);
        if memory.is_none() {
            Self::White(filter.roots().map(f64::recip).collect::<Vec<_>>().into())
        } else {
            Self::Remembers(filter)
        }
    }

    fn whiten(&self, mut columns: DMatrixViewMut<f64>) {
        for mut column in columns.column_iter_mut() {
            match self {
                Self::White(roots) => column.component_mul_assign(roots),
                Self::Remembers(filter) => filter.whiten(column.iter_mut()),
            }
        }
    }

    /// Standard deviation of each row's mean, given those before.
    fn noise_of_means(&self) -> DVector<f64> {
        match self {
            Self::White(roots) => roots.map(f64::recip),
            Self::Remembers(filter) => filter.roots().collect::<Vec<_>>().into(),
        }
    }
}

impl Channel {
    /// Of the readings in some frames of each row, with noise `sigma` each at the ordinary level, and their common terms in standard deviations
    /// [rows][factors].
    pub fn from_frames(
        rows: Vec<usize>,
        frames: &[Vec<usize>],
        (sigma, memory, levels): (f64, Memory, &Levels),
        common: DMatrix<f64>,
    ) -> Self {
        let root = Root::from_memory(memory, levels, frames);
        let mut common = common / sigma;
        root.whiten(common.as_view_mut());
        let (basis, of_common) = match rows.is_empty() {
            true => (DMatrix::zeros(0, 0), DVector::zeros(0)),
            false => {
                let svd = common.svd(true, false);
                (svd.u.expect("asked for"), svd.singular_values)
            }
        };
        let grown = of_common.map(|d| 1.0 + d * d);
        let of_noise = 2.0 * (&root.noise_of_means() * sigma).iter().map(|root| root.ln()).sum::<f64>();
        let log_det = of_noise + grown.iter().map(|g| g.ln()).sum::<f64>();
        Self { rows, sigma, root, basis, shrink: grown.map(|g| 1.0 - g.sqrt().recip()), log_det }
    }

    /// How many factors its readings have in common.
    pub fn factors(&self) -> usize {
        self.basis.ncols()
    }

    /// Whiten numbers in units of the noise of one reading, rows as [`Channel::rows`].
    pub fn whiten(&self, mut columns: DMatrix<f64>) -> DMatrix<f64> {
        self.whiten_mut(columns.as_view_mut());
        columns
    }

    /// The same in place.
    pub(crate) fn whiten_mut(&self, mut columns: DMatrixViewMut<f64>) {
        self.root.whiten(columns.as_view_mut());
        // column by column, since there are few factors
        for mut column in columns.column_iter_mut() {
            let common = self.basis.tr_mul(&column).component_mul(&self.shrink);
            column.gemv(-1.0, &self.basis, &common, 1.0);
        }
    }

    /// The part of `T^T T` that common terms take, `common common^T` [rows][factors], for white noise: `T^T T = diag(n) - common common^T`.
    pub fn taken(&self) -> DMatrix<f64> {
        let mut taken = self.basis.clone();
        for (mut column, shrink) in taken.column_iter_mut().zip(self.shrink.iter()) {
            column *= (shrink * (2.0 - shrink)).sqrt();
            if let Root::White(roots) = &self.root {
                column.component_mul_assign(roots);
            }
        }
        taken
    }

    /// Standard deviation of each row's mean, given those before, in units of the noise of one reading.
    pub fn noise_of_means(&self) -> DVector<f64> {
        self.root.noise_of_means()
    }

    /// Readings of each row of white noise: as many as tell as much at the ordinary level.
    pub fn readings(&self) -> DVector<f64> {
        match &self.root {
            Root::White(roots) => roots.map(|root| root * root),
            Root::Remembers(_) => DVector::from_element(self.rows.len(), 1.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FRAMES: [&[usize]; 4] = [&[0, 1, 2], &[4], &[5, 6], &[9, 10, 11, 12]];

    /// `T^T T` is the inverse of the covariance of the means, computed from that of the frames.
    #[test]
    fn whitened_means_are_independent() {
        let frames: Vec<Vec<usize>> = FRAMES.iter().map(|frames| frames.to_vec()).collect();
        let common = DMatrix::from_fn(4, 2, |i, k| (1.3 * i as f64 + k as f64).sin() * [4.0, 0.3][k]);
        let sigma = 0.7;
        let none = Memory::NONE;
        let remembers = Memory { share: 0.3, time: 4.0, steps: 0.1 };
        let larger = Levels::some(2..6, 3.0);
        for (memory, levels) in
            [(none, &Levels::CONSTANT), (remembers, &Levels::CONSTANT), (none, &larger), (remembers, &larger)]
        {
            let channel = Channel::from_frames(vec![0, 1, 2, 3], &frames, (sigma, memory, levels), common.clone());
            let covariance = |i: usize, j: usize| memory.covariance(levels, 0, [i, j]);
            let mean = |one: &[usize], other: &[usize]| {
                let all = one.iter().flat_map(|&i| other.iter().map(move |&j| covariance(i, j)));
                all.sum::<f64>() / (one.len() * other.len()) as f64
            };
            let noise = DMatrix::from_fn(4, 4, |i, j| sigma * sigma * mean(&frames[i], &frames[j]));
            let covariance = noise + &common * common.transpose();
            let t = channel.whiten(DMatrix::identity(4, 4) / sigma);
            assert!((t.tr_mul(&t) * &covariance - DMatrix::identity(4, 4)).amax() < 1e-12, "rounding");
            assert!((channel.log_det - covariance.determinant().ln()).abs() < 1e-12, "rounding");
            if memory == none {
                let taken = channel.taken();
                let apart = DMatrix::from_diagonal(&channel.readings()) - &taken * taken.transpose();
                assert!((t.tr_mul(&t) * sigma * sigma - apart).amax() < 1e-12, "rounding");
            }
        }
    }
}
