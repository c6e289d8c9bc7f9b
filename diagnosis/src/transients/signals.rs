//! What passes within a setting, of each cause: the signal of a monitor that is late, of a corrector that settles, and of a machine that keeps
//! a share of its former orbit.
//!
//! Orbits and responses are as measured, by the means of the runs, so that no model's error is taken for a transient; for white noise a run's mean is
//! independent of the differences within it.

use evidence::gram;
use nalgebra::{DMatrix, DVector};
use twin::{EffectKind, Site};

use super::differences::run_means;
use crate::term::Term;
use inference::Campaign;

/// What the signals are made of.
pub struct Signals<'c> {
    campaign: &'c Campaign,
    /// Kicks as believed, rows frames [rad].
    kick: DMatrix<f64>,
    /// Mean reading of the frame's run, rows frames; not a number without one [m].
    orbit: DMatrix<f64>,
    /// Cycles since the frame before, 0 for the first.
    elapsed: Vec<u32>,
    /// Measured response, rows correctors, columns monitors [m/rad].
    response: DMatrix<f64>,
}

/// Response that a corrector without data may have [m/rad]: no ring's is larger.
const LARGEST: f64 = 300.0;

impl<'c> Signals<'c> {
    /// From readings without what is known to pass, rows frames [m].
    pub fn from_readings(campaign: &'c Campaign, readings: &DMatrix<f64>) -> Self {
        let kick = DMatrix::from_rows(&campaign.drives.iter().map(|drive| drive.kick.transpose()).collect::<Vec<_>>());
        let rows = &campaign.recording.rows;
        let since = |frame: usize| rows[frame].sequence.wrapping_sub(rows[frame - 1].sequence);
        let elapsed = (0..rows.len()).map(|frame| if frame == 0 { 0 } else { since(frame) }).collect();
        let orbit = run_means(readings, &campaign.settings.repeatable);
        let response = response(campaign, &kick, &orbit);
        Self { campaign, kick, orbit, elapsed, response }
    }

    /// The signal of an effect, rows frames, columns monitors [m].
    pub fn of_effect(&self, term: Term, amplitude: f64) -> DMatrix<f64> {
        let mut signal = DMatrix::zeros(self.orbit.nrows(), self.orbit.ncols());
        match (term.kind, term.site) {
            (EffectKind::BpmTiming, Site::Monitor(at)) => {
                let read = self.campaign.ring.read_monitors.iter().position(|&read| read == at);
                read.into_iter().for_each(|b| signal.set_column(b, &(self.coming(b) * amplitude)));
            }
            (EffectKind::CorrectorSettling, Site::Corrector(c)) => {
                signal.ger(1.0, &self.lacking(c, amplitude), &self.response.row(c).transpose(), 0.0);
            }
            _ => {}
        }
        signal
    }

    /// What all monitors read while the machine keeps its whole former orbit for the first frame of a setting [m].
    pub(crate) fn of_former_orbit(&self) -> DMatrix<f64> {
        let columns: Vec<DVector<f64>> = (0..self.orbit.ncols()).map(|b| self.coming(b)).collect();
        DMatrix::from_columns(&columns)
    }

    /// Measured response of the monitors to a corrector [m/rad].
    pub fn of_corrector(&self, corrector: usize) -> DVector<f64> {
        self.response.row(corrector).transpose()
    }

    /// What the orbit of the cycle before has beyond that of each frame, at a monitor [m]; 0 where that cycle is not recorded.
    fn coming(&self, b: usize) -> DVector<f64> {
        let change = |frame: usize| match self.elapsed[frame] {
            1 => self.orbit[(frame - 1, b)] - self.orbit[(frame, b)],
            _ => 0.0,
        };
        DVector::from_fn(self.orbit.nrows(), |frame, _| Some(change(frame)).filter(|x| x.is_finite()).unwrap_or(0.0))
    }

    /// `j - k` of a corrector that settles, `j_i = k_i + a (j_(i-1) - k_i)`, in each frame [rad].
    fn lacking(&self, c: usize, share: f64) -> DVector<f64> {
        let (kick, mut lacking) = (self.kick.column(c), 0.0);
        DVector::from_fn(kick.len(), |frame, _| {
            let before = kick[frame.saturating_sub(1)];
            lacking = share.powi(self.elapsed[frame].min(100) as i32) * (lacking + before - kick[frame]);
            lacking
        })
    }
}

/// Least squares of the orbits on kicks and RF offset, about a baseline.
fn response(campaign: &Campaign, kick: &DMatrix<f64>, orbit: &DMatrix<f64>) -> DMatrix<f64> {
    let (frames, correctors) = kick.shape();
    let mut drive = kick.clone().insert_columns(correctors, 2, 1.0);
    drive.column_mut(correctors).iter_mut().zip(&campaign.drives).for_each(|(to, drive)| *to = drive.rf_offset);
    let unit: Vec<f64> = drive.column_iter().map(|column| column.amax().max(f64::MIN_POSITIVE)).collect();
    drive.column_iter_mut().zip(&unit).for_each(|(mut column, unit)| column /= *unit);
    let mut response = DMatrix::zeros(correctors, orbit.ncols());
    for b in 0..orbit.ncols() {
        let known: Vec<usize> = (0..frames).filter(|&frame| orbit[(frame, b)].is_finite()).collect();
        let columns = drive.select_rows(&known);
        let readings = DVector::from_iterator(known.len(), known.iter().map(|&frame| orbit[(frame, b)]));
        let noise = campaign.recording.header.noise[b];
        let mut normal = gram(&columns);
        (0..normal.ncols()).for_each(|c| normal[(c, c)] += (noise / (LARGEST * unit[c])).powi(2).max(1e-12));
        let Some(factor) = normal.cholesky() else { continue };
        let found = factor.solve(&columns.tr_mul(&readings));
        (0..correctors).for_each(|c| response[(c, b)] = found[c] / unit[c]);
    }
    response
}
