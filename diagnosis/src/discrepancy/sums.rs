//! Sums of whitened numbers, as the evidence of free amplitudes needs them.
//!
//! They are taken monitor by monitor. Where monitors have noise in common within a frame, a pattern that only one of them reads leaves
//! something in the others when the frame is whitened; it is counted as if their readings and memory were the same, and what the
//! free amplitudes of different monitors then share is left out. For slow noise of a fifth, jitter that adds as much as the noise and a crate of a
//! fifth that changes `ln` Bayes factors by 0.03 at most.

use core::ops::Range;

use evidence::{Factor, gram};
use nalgebra::{DMatrix, DVector};
use twin::Signature;

use crate::data::Data;
use crate::fit::Fitted;
use inference::Settings;

/// Sums of whitened numbers over settings or stretches of time, one group for each amplitude.
#[derive(Clone)]
pub struct Sums {
    /// `E^T S^-1 E`.
    pub gram: DMatrix<f64>,
    /// `C = E^T S^(-1/2) J L^-T`, rows groups, with `L L^T = 1 + J^T J`: what the fit's unknowns absorb of the Gram matrix is `C C^T`.
    pub cross: DMatrix<f64>,
    /// `E^T S^(-1/2) r`.
    pub pull: DVector<f64>,
}

/// The Gram matrix of a monitor's amplitudes for settings. No frame has two, so that it is diagonal but for the common terms of the
/// readings, `diag(alone) - common common^T`, and for what their noise remembers.
pub struct Apart {
    pub alone: DVector<f64>,
    pub common: DMatrix<f64>,
    /// The matrix itself, of few settings of noise that remembers; of many such settings the memory is left out.
    whole: Option<DMatrix<f64>>,
}

/// Settings up to which their matrix is taken as it is.
const FEW: usize = 64;

/// Residuals and derivatives of a fit, as the sums of one monitor's numbers need them.
pub struct Seen {
    pub residual: DVector<f64>,
    /// `J L^-T`.
    pub jacobian: DMatrix<f64>,
}

impl Data {
    /// Sums of a monitor's numbers over the columns of `indicator` (rows pools).
    pub fn sums(&self, b: usize, seen: &Seen, indicator: &DMatrix<f64>) -> Sums {
        let whitened = self.whiten_columns(b, indicator);
        let (start, n) = (self.start(b), whitened.nrows());
        let back = whitened.transpose();
        Sums {
            gram: gram(&whitened) * self.own_share(b),
            cross: &back * seen.jacobian.rows(start, n),
            pull: back * seen.residual.rows(start, n),
        }
    }

    /// Sums of one tune's numbers over the columns of `indicator`, in units that make its noise as large as that of a monitor; none if the
    /// tune meter has too few readings.
    pub fn tune_sums(&self, plane: usize, seen: &Seen, indicator: &DMatrix<f64>) -> Option<Sums> {
        let noise = self.tune_noise(plane)?;
        Some(self.sums(self.monitors() + plane, seen, &(indicator * (noise / self.mean_noise))))
    }
}

/// The same at some monitors only; the tunes always count.
pub fn at_monitors(signature: &Signature, monitors: &[usize]) -> Signature {
    let mut some = Signature { readings: signature.readings.clone() * 0.0, ..signature.clone() };
    monitors.iter().for_each(|&b| some.readings.set_column(b, &signature.readings.column(b)));
    some
}

impl Seen {
    /// Some rows of a fit.
    pub fn from_fit(fitted: &Fitted, rows: Range<usize>) -> Self {
        let residual = fitted.residual.rows_range(rows.clone()).into_owned();
        let whitened = fitted.free.whiten(&fitted.jacobian.rows_range(rows).transpose());
        Self { residual, jacobian: whitened.transpose() }
    }

    pub fn taken_back(data: &Data, own: &Self) -> Self {
        let residual = DMatrix::from_columns(core::slice::from_ref(&own.residual));
        let residual = data.taken_back(&residual).column(0).into_owned();
        Self { residual, jacobian: data.taken_back(&own.jacobian) }
    }
}

impl Sums {
    pub fn zero(numbers: usize, unknowns: usize) -> Self {
        let (gram, cross) = (DMatrix::zeros(numbers, numbers), DMatrix::zeros(numbers, unknowns));
        Self { gram, cross, pull: DVector::zeros(numbers) }
    }

    /// Of whitened patterns of all readings, one a column.
    pub fn from_columns(columns: &DMatrix<f64>, own: &Seen) -> Self {
        let back = columns.transpose();
        Self { gram: &back * columns, cross: &back * &own.jacobian, pull: back * &own.residual }
    }

    /// Of several monitors, each with its own amplitudes.
    pub fn stacked(each: &[Self]) -> Self {
        let amplitudes = each.iter().map(|sums| sums.pull.len()).sum();
        let mut all = Self::zero(amplitudes, each.first().map_or(0, |sums| sums.cross.ncols()));
        let mut at = 0;
        for sums in each {
            let n = sums.pull.len();
            all.gram.view_mut((at, at), (n, n)).copy_from(&sums.gram);
            all.cross.rows_mut(at, n).copy_from(&sums.cross);
            all.pull.rows_mut(at, n).copy_from(&sums.pull);
            at += n;
        }
        all
    }

    /// Add those of amplitudes that do `share` as much, and of which the other readings see `other` as much.
    pub fn add(&mut self, sums: &Self, share: f64, other: f64) {
        let add = |to: &mut [f64], from: &[f64], factor: f64| {
            to.iter_mut().zip(from).for_each(|(to, from)| *to += factor * from);
        };
        add(self.gram.as_mut_slice(), sums.gram.as_slice(), share * other);
        add(self.cross.as_mut_slice(), sums.cross.as_slice(), share);
        add(self.pull.as_mut_slice(), sums.pull.as_slice(), share);
    }

    /// Of some of the groups.
    pub fn select(&self, groups: &[usize]) -> Self {
        let gram = self.gram.select_rows(groups).select_columns(groups);
        Self { gram, cross: self.cross.select_rows(groups), pull: self.pull.select_rows(groups) }
    }

    /// Of amplitudes that are sums of some, block by block: `steps`, rows those of a block.
    pub fn through(&self, steps: &DMatrix<f64>) -> Self {
        let (from, to) = steps.shape();
        let blocks = self.pull.len() / from;
        let mut all = Self::zero(blocks * to, self.cross.ncols());
        for i in 0..blocks {
            for j in 0..blocks {
                let block = self.gram.view((i * from, j * from), (from, from));
                all.gram.view_mut((i * to, j * to), (to, to)).copy_from(&(steps.transpose() * block * steps));
            }
            all.cross.rows_mut(i * to, to).copy_from(&steps.tr_mul(&self.cross.rows(i * from, from)));
            all.pull.rows_mut(i * to, to).copy_from(&steps.tr_mul(&self.pull.rows(i * from, from)));
        }
        all
    }
}

impl Apart {
    pub fn from_sums(data: &Data, b: usize, settings: &Settings, sums: &Sums) -> Self {
        let (alone, common) = data.information(b, &settings.of_frame, settings.count());
        Self { alone, common, whole: data.remembers(b).then(|| sums.gram.clone()) }
    }

    /// Of some of the settings.
    pub fn select(&self, settings: &[usize]) -> Self {
        let whole = self.whole.as_ref().filter(|_| settings.len() <= FEW);
        Self {
            alone: self.alone.select_rows(settings),
            common: self.common.select_rows(settings),
            whole: whole.map(|gram| gram.select_rows(settings).select_columns(settings)),
        }
    }

    /// `ln det D` and `sides^T D^-1 sides`, `D = 1 + variance (diag(alone) - common common^T)`: with `d` its diagonal and
    /// `R = 1 - variance common^T d^-1 common`, `det D = det d det R`, `D^-1 = d^-1 + variance d^-1 common R^-1 common^T d^-1`.
    pub fn grown(&self, variance: f64, sides: &DMatrix<f64>) -> Option<(f64, DMatrix<f64>)> {
        if let Some(gram) = &self.whole {
            let mut grown = gram * variance;
            (0..grown.ncols()).for_each(|i| grown[(i, i)] += 1.0);
            let factor = Factor::of(grown)?;
            let whitened = factor.whiten(sides);
            return Some((factor.log_determinant(), whitened.transpose() * whitened));
        }
        let diagonal = self.alone.map(|alone| 1.0 + variance * alone);
        let over = |columns: &DMatrix<f64>| {
            let mut over = columns.clone();
            over.column_iter_mut().for_each(|mut column| column.component_div_assign(&diagonal));
            over
        };
        let (common, across) = (self.common.tr_mul(&over(&self.common)), self.common.tr_mul(&over(sides)));
        let rest = Factor::of(DMatrix::identity(common.nrows(), common.ncols()) - common * variance)?;
        let log_det = diagonal.iter().map(|d| d.ln()).sum::<f64>() + rest.log_determinant();
        let whitened = rest.whiten(&across);
        Some((log_det, sides.transpose() * over(sides) + whitened.transpose() * whitened * variance))
    }
}
