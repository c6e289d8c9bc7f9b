//! What a recording says of the orbit response: one quadratic form a monitor, baselines eliminated.
//!
//! A prediction is linear in the response `rho` of a monitor (a row of [`crate::ResponseModel::response`]) once the frame's
//! drive `k` (kicks, RF offset) is known, so that all frames together say
//!
//! `chi2 = rho^T A rho - 2 m rho + const`, `A = sum of k k^T/variance`, `m = sum of k reading/variance`,
//!
//! less what the unknown baseline takes (the Schur complement of its row). Two things are not linear in the response and are
//! taken from the readings beforehand, at the MAP: the frame's own supply currents, which scatter by 2e-4 (they move an
//! orbit by up to 3 um, and by less than 0.1 um differently within the posterior), and the second order of the RF orbit.
//!
//! Two data modes: all frames with baselines ([`Readings::of_frames`]), and, as the paper did, differences of one frame pair
//! a corrector ([`Readings::of_pairs`]).

use nalgebra::{DMatrix, DVector};
use serde::Serialize;
use twin::{OrbitError, Ring};

use crate::map::{BatchError, BatchFit, Drive, first_family, rf_orbit};
use crate::model::ResponseModel;
use crate::recording::{Recording, Row};

/// A recording with what the exact batch fit found out about it.
#[derive(Debug, Clone)]
pub struct Campaign {
    /// The ring as designed.
    pub ring: Ring,
    /// Its frames.
    pub recording: Recording,
    /// MAP, monitors, and which readings count.
    pub fit: BatchFit,
    /// What drove the beam in each frame.
    drives: Vec<Drive>,
    /// Mean `ln` of the supplies' factors.
    supplies: [f64; 2],
    /// Readings at the mean supply currents, first order in the RF offset [frame][monitor] [m].
    reduced: Vec<Vec<Option<f64>>>,
    /// Rms of what misalignments add to the dispersion [m per unit of RF offset], in x and y.
    spurious: [f64; 2],
}

/// The quadratic forms.
#[derive(Debug, Clone, Serialize)]
pub struct Readings {
    forms: Vec<Form>,
    /// `ln` of each quadrupole's supply factor, to be added to the params.
    supplies: Vec<f64>,
}

#[derive(Debug, Clone, Serialize)]
struct Form {
    gram: DMatrix<f64>,
    moment: DVector<f64>,
    square: f64,
}

/// Two frames of one corrector.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pair {
    /// Row of the initial setting.
    pub initial: usize,
    /// Row of the final setting.
    pub last: usize,
}

/// Why a recording cannot be reduced.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReadingsError {
    /// There is no batch answer.
    #[error(transparent)]
    Fit(#[from] BatchError),
    /// The ring at the MAP has no closed orbit.
    #[error("no closed orbit at the MAP: {0}")]
    Orbit(#[from] OrbitError),
    /// No tables for this ring.
    #[error(transparent)]
    Training(#[from] training::TrainingError),
}

impl Campaign {
    /// Fit a recording by the twin; `progress` hears of each Gauss-Newton step.
    ///
    /// # Errors
    /// [`ReadingsError`].
    pub fn of(ring: &Ring, recording: &Recording, progress: impl FnMut(usize)) -> Result<Self, ReadingsError> {
        let fit = BatchFit::of(ring, recording, progress)?;
        let drives: Vec<Drive> = recording.rows.iter().map(|row| Drive::of(recording, row)).collect();
        let mean = |family: usize| drives.iter().map(|d| d.strength[family]).sum::<f64>() / drives.len() as f64;
        let tables: training::BoosterGreen = training::green::tables(ring)?;
        let spurious = [0, 1].map(|plane| f64::from(tables.dispersion.spurious[plane]) * fit.orbit[plane]);
        let supplies = [mean(0), mean(1)];
        let reduced = reduce(ring, recording, &fit, &drives, supplies)?;
        Ok(Self { ring: ring.clone(), recording: recording.clone(), fit, drives, supplies, reduced, spurious })
    }

    /// Number of horizontal monitors; they come first.
    pub fn horizontal_monitors(&self) -> usize {
        self.ring.horizontal_monitors()
    }

    /// Drive of a frame as a row of the response: kicks, RF offset.
    pub fn drive(&self, frame: usize) -> DVector<f64> {
        self.drives[frame].kick.clone().push(self.drives[frame].rf_offset)
    }

    /// Reading of a monitor in a frame, if it counts, at the mean supply currents [m].
    pub fn reading(&self, frame: usize, b: usize) -> Option<f64> {
        self.reduced[frame][b].filter(|_| self.fit.screened.accepted[frame] >> b & 1 == 1)
    }

    /// The same, whether it counts or not [m].
    pub fn raw(&self, frame: usize, b: usize) -> Option<f64> {
        self.reduced[frame][b]
    }

    /// Noise of one reading of a monitor [m].
    pub fn noise(&self, b: usize) -> f64 {
        f64::from(self.fit.screened.health[b].weighted_as)
    }

    /// `ln` of each quadrupole's mean supply factor.
    pub fn supplies(&self) -> Vec<f64> {
        let first = first_family(&self.ring);
        (0..self.ring.quadrupoles.len()).map(|q| self.supplies[usize::from(q >= first)]).collect()
    }

    /// Error that readings of one setting share: the model's own, and the dispersion of unknown misalignments [m].
    fn shared_error(&self, model: &ResponseModel, b: usize, rf_offset: f64) -> f64 {
        let plane = usize::from(b >= self.horizontal_monitors());
        model.stated_error(b).hypot(self.spurious[plane] * rf_offset)
    }

    /// Number of frames that repeat each frame's setting, itself included.
    fn repeats(&self) -> Vec<usize> {
        let same = |one: &Row, other: &Row| {
            (one.corrector.as_ref(), one.setting, one.rf_offset)
                == (other.corrector.as_ref(), other.setting, other.rf_offset)
        };
        let rows = &self.recording.rows;
        rows.iter().map(|row| rows.iter().filter(|other| same(row, other)).count()).collect()
    }
}

/// Take from each reading what is not linear in the response: the effect of its own supply currents and the second order
/// of its RF offset.
fn reduce(
    ring: &Ring,
    recording: &Recording,
    fit: &BatchFit,
    drives: &[Drive],
    supplies: [f64; 2],
) -> Result<Vec<Vec<Option<f64>>>, ReadingsError> {
    let first = first_family(ring);
    let model = ResponseModel::twin(ring)?;
    let moved = |step: [f64; 2]| -> Vec<f64> {
        let at = |(q, theta): (usize, &f64)| theta + supplies[usize::from(q >= first)] + step[usize::from(q >= first)];
        fit.map_params.iter().enumerate().map(at).collect()
    };
    const STEP: f64 = 1e-4;
    let slope = |family: usize| -> Result<DMatrix<f64>, OrbitError> {
        let mut step = [0.0; 2];
        step[family] = STEP;
        let up = model.response(&moved(step))?;
        Ok((up - model.response(&moved(step.map(|s| -s)))?) / (2.0 * STEP))
    };
    let (slopes, here) = ([slope(0)?, slope(1)?], moved([0.0; 2]));
    let dispersion = model.response(&here)?.column(drives[0].kick.len()).into_owned();
    let whole = ring.with_vars(&here.iter().map(|theta| theta.exp()).collect::<Vec<_>>());
    let mut bent: Vec<(f64, DVector<f64>)> = Vec::new(); // second order of each RF offset
    let mut reduced = Vec::with_capacity(drives.len());
    for (drive, row) in drives.iter().zip(&recording.rows) {
        let offset = drive.rf_offset;
        if offset != 0.0 && bent.iter().all(|(known, _)| *known != offset) {
            bent.push((offset, rf_orbit(&whole, offset)? - &dispersion * offset));
        }
        let k = drive.kick.clone().push(offset);
        let mut correction = (&slopes[0] * &k) * (drive.strength[0] - supplies[0]);
        correction += (&slopes[1] * &k) * (drive.strength[1] - supplies[1]);
        bent.iter().filter(|(known, _)| *known == offset).for_each(|(_, second)| correction += second);
        reduced.push(row.reading.iter().zip(&correction).map(|(reading, c)| reading.map(|r| r - c)).collect());
    }
    Ok(reduced)
}

impl Readings {
    /// All frames, the baseline of each monitor unknown.
    pub fn of_frames(campaign: &Campaign, model: &ResponseModel) -> Self {
        let repeats = campaign.repeats();
        let of_monitor = |b: usize| {
            let mut form = Form::new(campaign.drives[0].kick.len() + 1);
            let (mut weight, mut pull, mut slope) = (0.0, 0.0, DVector::zeros(form.moment.len()));
            for (frame, &repeats) in repeats.iter().enumerate() {
                let Some(reading) = campaign.reading(frame, b) else { continue };
                let (k, offset) = (campaign.drive(frame), campaign.drives[frame].rf_offset);
                // repeats share the error: their mean has the variance of one over n, plus all of it
                let shared = campaign.shared_error(model, b, offset).powi(2) * repeats as f64;
                let w = 1.0 / (campaign.noise(b).powi(2) + shared);
                form.add(&k, reading, w);
                (weight, pull) = (weight + w, pull + w * reading);
                slope.axpy(w, &k, 1.0);
            }
            form.eliminate(&slope, pull, weight);
            form
        };
        Self { forms: (0..campaign.noises()).map(of_monitor).collect(), supplies: campaign.supplies() }
    }

    /// Differences of frame pairs, each independent of the others.
    pub fn of_pairs(campaign: &Campaign, model: &ResponseModel, pairs: &[Pair]) -> Self {
        let of_monitor = |b: usize| {
            let mut form = Form::new(campaign.drives[0].kick.len() + 1);
            for pair in pairs {
                let (Some(initial), Some(last)) = (campaign.reading(pair.initial, b), campaign.reading(pair.last, b))
                else {
                    continue;
                };
                let k = campaign.drive(pair.last) - campaign.drive(pair.initial);
                let shared = campaign.shared_error(model, b, k[k.len() - 1]);
                form.add(&k, last - initial, 1.0 / (2.0 * campaign.noise(b).powi(2) + shared.powi(2)));
            }
            form
        };
        Self { forms: (0..campaign.noises()).map(of_monitor).collect(), supplies: campaign.supplies() }
    }

    /// `ln` of each quadrupole's supply factor, to be added to the params.
    pub fn supplies(&self) -> &[f64] {
        &self.supplies
    }

    /// Chi-square at a response, and its derivative with respect to each entry.
    pub fn chi_square(&self, response: &DMatrix<f64>) -> (f64, DMatrix<f64>) {
        let (mut chi_square, mut weights) = (0.0, DMatrix::zeros(response.nrows(), response.ncols()));
        let (mut rho, mut image) = (DVector::zeros(response.ncols()), DVector::zeros(response.ncols()));
        for (b, form) in self.forms.iter().enumerate() {
            rho.tr_copy_from(&response.row(b));
            image.gemv(1.0, &form.gram, &rho, 0.0);
            chi_square += form.square + rho.dot(&image) - 2.0 * rho.dot(&form.moment);
            image.axpy(-2.0, &form.moment, 2.0);
            weights.row_mut(b).tr_copy_from(&image);
        }
        (chi_square, weights)
    }

    /// Half the second derivative of chi-square along a Jacobian of the response: `sum of J^T A J`.
    pub fn curvature(&self, jacobian: &[DMatrix<f64>]) -> DMatrix<f64> {
        let params = jacobian.first().map_or(0, DMatrix::ncols);
        let each = self.forms.iter().zip(jacobian).map(|(form, j)| j.tr_mul(&(&form.gram * j)));
        each.fold(DMatrix::zeros(params, params), |sum, one| sum + one)
    }
}

impl Campaign {
    fn noises(&self) -> usize {
        self.fit.screened.health.len()
    }
}

impl Form {
    fn new(drives: usize) -> Self {
        Self { gram: DMatrix::zeros(drives, drives), moment: DVector::zeros(drives), square: 0.0 }
    }

    fn add(&mut self, k: &DVector<f64>, reading: f64, weight: f64) {
        self.gram.ger(weight, k, k, 1.0);
        self.moment.axpy(weight * reading, k, 1.0);
        self.square += weight * reading * reading;
    }

    /// Take the best baseline from all readings, given the sums of weight times drive, reading and one.
    fn eliminate(&mut self, slope: &DVector<f64>, pull: f64, weight: f64) {
        if weight > 0.0 {
            self.gram.ger(-1.0 / weight, slope, slope, 1.0);
            self.moment.axpy(-pull / weight, slope, 1.0);
            self.square -= pull * pull / weight;
        }
    }
}
