//! The information of a campaign on the orbit response, one quadratic form a monitor with the baselines eliminated, and on the tunes.
//!
//! A prediction is linear in the response `rho` of a monitor (a row of [`crate::ResponseModel::predict`]) once the frame's
//! drive `k` (kicks, RF offset) is known, so that all frames together give
//!
//! `chi2 = rho^T A rho - 2 m rho + const`, `A = sum of k k^T/variance`, `m = sum of k reading/variance`,
//!
//! less what the unknown baseline absorbs, and how it follows supplies and RF (the Schur complement of these terms). Two things are not linear in the response and are
//! subtracted from the readings beforehand, at the MAP: the frame's own supply currents, which scatter by 2e-4 (they move an
//! orbit by up to 3 um, and by less than 0.1 um differently within the posterior), and the second order of the RF orbit.
//!
//! The amplitudes `d` of a base model ([`crate::BaseModel`]), off those of the fit, add `S d` to the response, with its derivatives S at the fit. At their
//! best they are eliminated: they are normal, so that chi-square is then that of the vars alone.
//!
//! Two data modes: all frames with baselines ([`Readings::of_frames`]), and, as the paper did with a model taken for exact, differences of one frame pair
//! a corrector ([`Readings::of_pairs`]).

use nalgebra::{DMatrix, DVector, Vector2};
use serde::Serialize;
use twin::OrbitError;

use crate::base_model::FittedTerm;
use crate::campaign::{Campaign, Common, Eliminated, Meter, Weighed};
use crate::map_fit::{BatchFit, TuneUse};
use crate::model::{Prediction, ResponseModel};

/// A campaign with its fit, its readings linear in the response.
#[derive(Debug, Clone)]
pub struct Reduced {
    /// The campaign.
    pub campaign: Campaign,
    /// Its batch fit.
    pub fit: BatchFit,
    /// Readings at the mean supply currents, first order in the RF offset, rows frames, columns monitors [m].
    readings: DMatrix<f64>,
    /// Factor of the base model, as fitted, on each drive: kicks and RF offset.
    factors: DVector<f64>,
    /// Derivatives by its terms.
    base: Vec<BaseSlope>,
}

/// Derivative of what a model predicts by one term of the base model, at the fit.
#[derive(Debug, Clone, Serialize)]
struct BaseSlope {
    /// As [`Prediction::response`]; the tunes follow the magnets alone, which are exact here.
    response: DMatrix<f64>,
    /// Amplitude at the fit.
    value: f64,
    /// One over the variance of its prior.
    precision: f64,
}

/// The quadratic forms, and the tunes.
#[derive(Debug, Clone, Serialize)]
pub struct Readings {
    forms: Vec<Form>,
    base: Base,
    /// Measured tunes, where they count.
    meters: [Option<Meter>; 2],
    /// `ln` of each quadrupole's supply factor [M].
    supplies: Vec<f64>,
    /// Param of each quadrupole [M].
    parameters: Vec<Option<usize>>,
    /// Number of params.
    dimension: usize,
}

#[derive(Debug, Clone, Serialize)]
struct Form {
    gram: DMatrix<f64>,
    moment: DVector<f64>,
    square: f64,
}

/// The terms of a base model, eliminated.
#[derive(Debug, Clone, Serialize)]
struct Base {
    slopes: Vec<BaseSlope>,
    /// What a unit of each adds to the derivative of chi-square by the prediction.
    weights: Vec<DMatrix<f64>>,
    /// Inverse of half the second derivative of chi-square with respect to the amplitudes.
    inverse: DMatrix<f64>,
}

/// Two frames of one corrector.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pair {
    /// Row of the initial setting.
    pub initial: usize,
    /// Row of the final setting.
    pub last: usize,
}

impl Reduced {
    /// Take from each reading what is not linear in the response at the fit's params.
    ///
    /// # Errors
    /// [`OrbitError`] if these have no closed orbit.
    pub fn from_fit(campaign: Campaign, fit: BatchFit) -> Result<Self, OrbitError> {
        let Campaign { ring, supplies, drives, .. } = &campaign;
        let (vars, values) = (fit.map_params.len(), fit.values());
        let amplitudes = &values[vars..];
        let linearised = campaign.linearised(fit.base_model, &DVector::from_column_slice(&values))?;
        let exact = linearised.orbits(drives);
        let factors = fit.base_model.kick_factors(ring, amplitudes).push(fit.base_model.rf_factor(amplitudes));
        let strength: Vec<f64> = ring.strengths(&fit.map_params, supplies).iter().map(|factor| factor.ln()).collect();
        let response = ResponseModel::twin(ring)?.predict(&strength)?.response;
        let mut readings = &campaign.readings - exact;
        for (mut row, drive) in readings.row_iter_mut().zip(drives) {
            row += (&response * drive.kick.push(drive.rf_offset).component_mul(&factors)).transpose();
        }
        let slopes: Vec<DMatrix<f64>> = (0..readings.ncols()).map(|b| linearised.at_mean.slopes_at(b)).collect();
        let slope = |(at, fitted): (usize, &FittedTerm)| {
            let response = |b: usize, c: usize| slopes[b][(vars + at, c)] / factors[c];
            BaseSlope {
                response: DMatrix::from_fn(slopes.len(), factors.len(), response),
                value: fitted.measured.value,
                precision: fitted.term.width().powi(-2),
            }
        };
        let base = fit.base.iter().enumerate().map(slope).collect();
        Ok(Self { campaign, fit, readings, factors, base })
    }

    /// Drive of a frame as a row of the response: kicks, RF offset, with the factors of the base model.
    pub fn drive(&self, frame: usize) -> DVector<f64> {
        let drive = &self.campaign.drives[frame];
        drive.kick.push(drive.rf_offset).component_mul(&self.factors)
    }

    /// Reading of a monitor in a frame, if it counts, at the mean supply currents [m].
    pub fn reading(&self, frame: usize, b: usize) -> Option<f64> {
        self.campaign.counts(frame, b).then(|| self.readings[(frame, b)])
    }

    /// The same, whether it counts or not [m].
    pub fn raw(&self, frame: usize, b: usize) -> Option<f64> {
        Some(self.readings[(frame, b)]).filter(|reading| !reading.is_nan())
    }

    /// Noise of one reading of a monitor [m].
    pub fn noise(&self, b: usize) -> f64 {
        self.campaign.noise(b)
    }

    /// `ln` of the factor on each quadrupole's gradient at some params [M].
    pub fn strength(&self, params: &[f64]) -> Vec<f64> {
        let factors = self.campaign.ring.strengths(params, &self.campaign.supplies);
        factors.iter().map(|factor| factor.ln()).collect()
    }

    /// Number of frames that repeat each frame's setting, itself included.
    fn repeats(&self) -> Vec<usize> {
        let of_frame = &self.campaign.settings.repeatable;
        let repeats = |setting: &Option<usize>| match setting {
            Some(_) => of_frame.iter().filter(|other| *other == setting).count(),
            None => 1,
        };
        of_frame.iter().map(repeats).collect()
    }

    /// The forms of all monitors beside tunes and circuits.
    fn readings(&self, forms: Vec<Form>, tunes: TuneUse, base: &[BaseSlope]) -> Readings {
        let ring = &self.campaign.ring;
        let meters = if tunes == TuneUse::Readings { self.campaign.meters.clone() } else { [None, None] };
        Readings {
            base: Base::eliminated(base.to_vec(), &forms),
            forms,
            meters,
            supplies: self.strength(&[]),
            parameters: ring.quadrupoles.iter().map(|quadrupole| quadrupole.parameter).collect(),
            dimension: ring.parameters.len(),
        }
    }
}

impl Readings {
    /// All frames, the baseline of each monitor unknown.
    pub fn of_frames(reduced: &Reduced, model: &ResponseModel, tunes: TuneUse) -> Self {
        let (repeats, drives) = (reduced.repeats(), reduced.campaign.ring.correctors.len() + 1);
        let of_monitor = |b: usize| {
            let terms = reduced.campaign.terms(b);
            let baselines = reduced.campaign.times.count();
            let (mut gram, mut common) =
                (DMatrix::zeros(drives, drives), Common::new(drives, terms.nrows(), baselines, 0.0));
            for (frame, &repeats) in repeats.iter().enumerate() {
                let Some(reading) = reduced.reading(frame, b) else { continue };
                let k = reduced.drive(frame);
                // repeats share the error: their mean has the variance of one over n, plus all of it
                let w = 1.0 / (reduced.noise(b).powi(2) + model.stated_error(b).powi(2) * repeats as f64);
                gram.ger(w, &k, &k, 1.0);
                common.add(&k.column(0), &Weighed::one(terms.column(frame).as_slice(), reading, w));
            }
            let Eliminated { columns, moment, square } = common.eliminated();
            gram.gemm(-1.0, &columns, &columns.transpose(), 1.0);
            Form { gram, moment, square }
        };
        reduced.readings((0..reduced.campaign.monitors()).map(of_monitor).collect(), tunes, &reduced.base)
    }

    /// Differences of frame pairs, each independent of the others; no tunes, as in the paper. `error` is that of the model in a difference, by monitor [m].
    pub fn of_pairs(reduced: &Reduced, error: impl Fn(usize) -> f64, pairs: &[Pair]) -> Self {
        let of_monitor = |b: usize| {
            let terms = reduced.campaign.terms(b);
            let mut form = Form::new(reduced.campaign.ring.correctors.len() + 1);
            for pair in pairs {
                let (Some(initial), Some(last)) = (reduced.reading(pair.initial, b), reduced.reading(pair.last, b))
                else {
                    continue;
                };
                let k = reduced.drive(pair.last) - reduced.drive(pair.initial);
                let moved = (terms.column(pair.last) - terms.column(pair.initial)).norm_squared();
                let variance = 2.0 * reduced.noise(b).powi(2) + error(b).powi(2) + moved;
                form.add(&k, last - initial, 1.0 / variance);
            }
            form
        };
        reduced.readings((0..reduced.campaign.monitors()).map(of_monitor).collect(), TuneUse::LeftOut, &[])
    }

    /// `ln` of the factor on each quadrupole's gradient at some params [M].
    pub fn strength(&self, params: &[f64]) -> Vec<f64> {
        let param = |parameter: &Option<usize>| parameter.map_or(0.0, |parameter| params[parameter]);
        self.parameters.iter().zip(&self.supplies).map(|(parameter, supply)| param(parameter) + supply).collect()
    }

    /// Derivative with respect to each param of what has these derivatives with respect to each quadrupole's strength.
    pub fn gather(&self, gradient: &[f64]) -> Vec<f64> {
        let mut gathered = vec![0.0; self.dimension];
        for (parameter, slope) in self.parameters.iter().zip(gradient) {
            parameter.iter().for_each(|parameter| gathered[*parameter] += slope);
        }
        gathered
    }

    /// Chi-square of a prediction, and its derivative with respect to each number of it.
    pub fn chi_square(&self, predicted: &Prediction) -> (f64, Prediction) {
        let (fitted, mut weights) = self.as_fitted(predicted);
        let slope = self.base.pull(&weights.response);
        let amplitudes = -(&self.base.inverse * &slope);
        // the derivative is linear in the prediction
        for (more, &amplitude) in self.base.weights.iter().zip(amplitudes.iter()) {
            weights.response.zip_apply(more, |weight, more| *weight += more * amplitude);
        }
        (fitted + self.base.cost() + slope.dot(&amplitudes), weights)
    }

    /// The same with the base model as fitted, without its prior.
    fn as_fitted(&self, predicted: &Prediction) -> (f64, Prediction) {
        let response = &predicted.response;
        let (mut chi_square, mut weights) = (0.0, DMatrix::zeros(response.nrows(), response.ncols()));
        let (mut rho, mut image) = (DVector::zeros(response.ncols()), DVector::zeros(response.ncols()));
        for (b, form) in self.forms.iter().enumerate() {
            rho.tr_copy_from(&response.row(b));
            image.gemv(1.0, &form.gram, &rho, 0.0);
            chi_square += form.square + rho.dot(&image) - 2.0 * rho.dot(&form.moment);
            image.axpy(-2.0, &form.moment, 2.0);
            weights.row_mut(b).tr_copy_from(&image);
        }
        let mut tunes = [0.0; 2];
        for (plane, meter) in self.meters.iter().enumerate() {
            let Some(meter) = meter else { continue };
            let miss = meter.miss(Vector2::new(predicted.tunes[plane], 0.0));
            chi_square += miss.norm_squared();
            tunes[plane] = -2.0 * miss.dot(&meter.whiten.column(0));
        }
        (chi_square, Prediction { response: weights, tunes })
    }

    /// Half the second derivative of chi-square with respect to the params, that of the prediction left out: `sum of J^T A J`, less what the base
    /// model takes.
    ///
    /// # Errors
    /// [`OrbitError`] where there is no stable ring.
    pub fn curvature(&self, model: &ResponseModel, params: &[f64]) -> Result<DMatrix<f64>, OrbitError> {
        let (jacobian, tune_slopes) = model.jacobian(&self.strength(params))?;
        let mut curvature = DMatrix::zeros(self.dimension, self.dimension);
        let of_base = &self.base.weights;
        let mut mixed: DMatrix<f64> = DMatrix::zeros(of_base.len(), self.dimension);
        for (b, (form, of_quadrupoles)) in self.forms.iter().zip(&jacobian).enumerate() {
            let j = self.gather_columns(of_quadrupoles);
            for (mut row, base) in mixed.row_iter_mut().zip(of_base) {
                row += base.row(b) * &j / 2.0;
            }
            curvature += j.tr_mul(&(&form.gram * &j));
        }
        let tune_slopes = self.gather_columns(&tune_slopes);
        for (plane, meter) in self.meters.iter().enumerate() {
            let Some(meter) = meter else { continue };
            let slope = tune_slopes.row(plane).transpose();
            curvature.ger(meter.whiten.column(0).norm_squared(), &slope, &slope, 1.0);
        }
        Ok(curvature - mixed.tr_mul(&(&self.base.inverse * &mixed)))
    }

    /// Columns of quadrupoles as columns of params.
    fn gather_columns(&self, of_quadrupoles: &DMatrix<f64>) -> DMatrix<f64> {
        let mut gathered = DMatrix::zeros(of_quadrupoles.nrows(), self.dimension);
        for (parameter, column) in self.parameters.iter().zip(of_quadrupoles.column_iter()) {
            parameter.iter().for_each(|&parameter| gathered.column_mut(parameter).axpy(1.0, &column, 1.0));
        }
        gathered
    }
}

impl Base {
    fn eliminated(slopes: Vec<BaseSlope>, forms: &[Form]) -> Self {
        let weights: Vec<DMatrix<f64>> = slopes.iter().map(|one| one.weights(forms)).collect();
        let normal = DMatrix::from_fn(slopes.len(), slopes.len(), |i, j| {
            let prior = if i == j { slopes[i].precision } else { 0.0 };
            slopes[i].along(&weights[j]) / 2.0 + prior
        });
        let inverse = normal.cholesky().expect("a prior's precision is positive").inverse();
        Self { slopes, weights, inverse }
    }

    /// Half the derivative of chi-square by the amplitudes, given that by the prediction.
    fn pull(&self, weights: &DMatrix<f64>) -> DVector<f64> {
        let each = self.slopes.iter().map(|one| one.along(weights) / 2.0 + one.precision * one.value);
        DVector::from_iterator(self.slopes.len(), each)
    }

    /// Squares of the amplitudes as fitted, in widths.
    fn cost(&self) -> f64 {
        self.slopes.iter().map(|one| one.precision * one.value.powi(2)).sum()
    }
}

impl BaseSlope {
    /// What a unit of the amplitude changes of a function of the response with these derivatives.
    fn along(&self, weights: &DMatrix<f64>) -> f64 {
        self.response.dot(weights)
    }

    /// What a unit of the amplitude adds to the derivative of chi-square by the response.
    fn weights(&self, forms: &[Form]) -> DMatrix<f64> {
        let mut weights = self.response.clone();
        for (b, form) in forms.iter().enumerate() {
            weights.set_row(b, &(self.response.row(b) * &form.gram * 2.0));
        }
        weights
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
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base_model::BaseModel;
    use crate::recording::Recording;
    use crate::testing::ten_cells;

    /// A recording of format 2 need not name the correctors that were set.
    #[test]
    fn frames_repeat_each_other_by_their_read_backs() {
        let (ring, mut recording) = ten_cells();
        let repeats = |recording: &Recording| {
            let campaign = Campaign::of(&ring, recording).unwrap();
            let fit = BatchFit::best(&campaign, TuneUse::LeftOut, BaseModel::EXACT, |_| ()).unwrap();
            Reduced::from_fit(campaign, fit).unwrap().repeats()
        };
        let named = repeats(&recording);
        recording.rows.iter_mut().for_each(|row| row.correctors.clear());
        assert_eq!(repeats(&recording), named);
        assert_eq!(named.iter().max(), Some(&40)); // the frames without a kick
    }
}
