//! The fit of a measured matrix: first with the stated noise alone, as LOCO weighs it, then with an error of the model whose size is learnt.
//!
//! Damped Gauss-Newton on
//!
//! `sum (measured - predicted)^2 / (sigma^2 + tau^2) + sum ((p - mean)/width)^2`,
//!
//! `sigma` the stated noise of an element, `tau` what the model misses, one number for each block of the matrix (x and y monitors, H and V
//! correctors, the dispersion of both planes). `tau` is such that each block's sum of squares is what is left of its number of elements once the
//! unknowns are fitted. Stated noise is that of the monitors; where the model misses more, error bars without `tau` are wrong.

use nalgebra::{DMatrix, DVector};
use twin::{Plane, Rf};

use crate::error::MeasuredError;
use crate::folder::Folder;
use crate::model::{Model, Prediction};
use crate::normal::{Normal, Places};
use crate::unknowns::{Kind, Magnets, Unknown, Widths, groups, unknowns};

/// How a matrix is fitted.
#[derive(Debug, Clone, Copy)]
pub struct Settings {
    /// What the machine holds.
    pub rf: Rf,
    /// Priors.
    pub widths: Widths,
    /// Whether instruments may see or kick the other plane; as in the reference fit, and yes without one.
    pub coupling: Option<bool>,
}

impl Default for Settings {
    /// A storage ring holds its RF frequency.
    fn default() -> Self {
        Self { rf: Rf::FixedFrequency, widths: Widths::default(), coupling: None }
    }
}

/// Monitors' plane and correctors' plane, or the dispersion in a plane.
pub const BLOCKS: [&str; 6] = ["x to H", "x to V", "y to H", "y to V", "x to RF", "y to RF"];

/// A fitted measurement.
#[derive(Debug, Clone)]
pub struct Fit {
    /// Groups of gradients and of skew gradients.
    pub groups: [Vec<Magnets>; 2],
    /// What is fitted.
    pub unknowns: Vec<Unknown>,
    /// Most probable values.
    pub values: DVector<f64>,
    /// Their covariance.
    pub covariance: DMatrix<f64>,
    /// Sum of squares over the stated noise, per element, at the values that make it least, as LOCO counts it.
    pub chi2_loco: f64,
    /// The same at the start.
    pub chi2_start: f64,
    /// Elements that count.
    pub elements: usize,
    /// Elements that were set aside: row and column.
    pub outliers: Vec<[usize; 2]>,
    /// What the model misses in each of [`BLOCKS`] [mm]; NaN where nothing was measured.
    pub discrepancy: [f64; 6],
    /// Measured less predicted [mm], with the dispersion as the last column; 0 where nothing counts.
    pub residual: DMatrix<f64>,
    /// The same of the fit with the stated noise alone.
    pub stated_residual: DMatrix<f64>,
    /// One over the variance of each element [1/mm^2].
    pub weight: DMatrix<f64>,
    /// Gauss-Newton steps.
    pub steps: usize,
    /// False where the last descent was still moving when its steps were used up: the model is far from the measurement.
    pub has_ended: bool,
}

/// Steps of one descent; those of measured rings take 5 to 60.
const STEPS: usize = 100;
/// A descent has ended when the best step promises less than this, or this share of its sum of squares.
const ENOUGH: f64 = 1e-3;
const ENOUGH_SHARE: f64 = 1e-7;
/// LOCO's outlier factor.
const OUTLIER: f64 = 10.0;
/// Rounds of the model's error.
const ROUNDS: usize = 6;

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
    /// Of a folder.
    pub fn of(folder: &Folder) -> Self {
        let (rows, correctors) = folder.matrix.shape();
        let columns = correctors + usize::from(folder.dispersion.is_some());
        let value = |i: usize, j: usize| match &folder.dispersion {
            Some(dispersion) if j == correctors => dispersion[i],
            _ => folder.matrix[(i, j)],
        };
        let uses_dispersion = folder.meta.reference_fit.as_ref().is_none_or(|fit| fit.flags.dispersion == "Yes");
        let counts = |i: usize, j: usize| {
            let column = if j == correctors { uses_dispersion } else { folder.correctors[j].is_used };
            folder.monitors[i].is_used && column && value(i, j).is_finite()
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

    /// One over the variance of each element with an error of the model in each block [mm].
    pub fn weight(&self, discrepancy: &[f64; 6]) -> DMatrix<f64> {
        self.sigma.zip_map(&self.block, |sigma, block| 1.0 / (sigma.powi(2) + discrepancy[block].powi(2)))
    }

    /// Sum of squares over the stated noise.
    fn chi2(&self, at: &Prediction) -> f64 {
        let weight = self.weight(&[0.0; 6]);
        let left = residual(&self.measured, at, &weight);
        left.component_mul(&left).dot(&weight)
    }

    /// Let elements count no longer that are ten times further off than the rms of all, by the stated noise.
    fn set_outliers_aside(&mut self, at: &Prediction) -> Vec<[usize; 2]> {
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

/// Fit a measurement.
///
/// # Errors
/// [`MeasuredError`].
pub fn fit(folder: &Folder, settings: &Settings, progress: &mut dyn FnMut(&str)) -> Result<Fit, MeasuredError> {
    let groups: [Vec<Magnets>; 2] = groups(folder).into();
    let model = Model::of(folder, &groups, settings.rf)?;
    let of_reference = folder.meta.reference_fit.as_ref().is_none_or(|fit| fit.flags.coupling == "Yes");
    let coupling = settings.coupling.unwrap_or(of_reference);
    let unknowns = unknowns(folder, [&groups[0], &groups[1]].map(Vec::len), coupling, &settings.widths);
    let mut data = Data::of(folder);
    let values = DVector::from_iterator(unknowns.len(), unknowns.iter().map(|one| one.mean));
    let start = model.predict(&unknowns, &values)?;
    let chi2_start = data.chi2(&start) / data.elements() as f64;
    let (mut as_stated, mut outliers) = (
        Descent { values, covariance: DMatrix::zeros(0, 0), prediction: start, steps: 0, has_ended: false },
        Vec::new(),
    );
    loop {
        progress(&format!("as stated, {} outliers", outliers.len()));
        let before = as_stated.steps;
        as_stated = descend(&model, &unknowns, &data.measured, &data.weight(&[0.0; 6]), as_stated.values)?;
        as_stated.steps += before;
        let further = data.set_outliers_aside(&as_stated.prediction);
        if further.is_empty() {
            break;
        }
        outliers.extend(further);
    }
    let elements = data.elements();
    let chi2_loco = data.chi2(&as_stated.prediction) / elements as f64;
    let stated_residual = residual(&data.measured, &as_stated.prediction, &data.weight(&[0.0; 6]));
    let steps = as_stated.steps;
    let (here, discrepancy) = with_model_error(&model, &unknowns, &data, as_stated, progress)?;
    let weight = data.weight(&discrepancy);
    Ok(Fit {
        groups,
        chi2_loco,
        chi2_start,
        elements,
        outliers,
        discrepancy,
        residual: residual(&data.measured, &here.prediction, &weight),
        stated_residual,
        weight,
        steps: steps + here.steps,
        has_ended: here.has_ended,
        values: here.values,
        covariance: here.covariance,
        unknowns,
    })
}

/// Descend with an error of the model in each block [mm], which is learnt in turn with the unknowns.
///
/// # Errors
/// [`MeasuredError`].
pub fn with_model_error(
    model: &Model,
    unknowns: &[Unknown],
    data: &Data,
    from: Descent,
    progress: &mut dyn FnMut(&str),
) -> Result<(Descent, [f64; 6]), MeasuredError> {
    let (mut here, mut discrepancy, mut steps) = (from, [0.0; 6], 0);
    for round in 1..=ROUNDS {
        progress(&format!("error of the model, round {round} of {ROUNDS}"));
        discrepancy = learnt(data, &here, &discrepancy);
        here = descend(model, unknowns, &data.measured, &data.weight(&discrepancy), here.values)?;
        steps += here.steps;
    }
    Ok((Descent { steps, ..here }, discrepancy))
}

/// Where a descent ended.
pub struct Descent {
    /// Most probable values.
    pub values: DVector<f64>,
    /// Their covariance.
    pub covariance: DMatrix<f64>,
    /// What they predict.
    pub prediction: Prediction,
    /// Steps taken.
    pub steps: usize,
    /// False where the steps were used up before.
    pub has_ended: bool,
}

/// Measured less predicted, where it counts.
fn residual(measured: &DMatrix<f64>, at: &Prediction, weight: &DMatrix<f64>) -> DMatrix<f64> {
    (measured - &at.matrix).zip_map(weight, |residual, weight| if weight > 0.0 { residual } else { 0.0 })
}

/// Damped Gauss-Newton.
///
/// # Errors
/// [`MeasuredError`].
pub fn descend(
    model: &Model,
    unknowns: &[Unknown],
    measured: &DMatrix<f64>,
    weight: &DMatrix<f64>,
    mut values: DVector<f64>,
) -> Result<Descent, MeasuredError> {
    let n = unknowns.len();
    let places = Places::of(unknowns, measured.nrows(), measured.ncols());
    let width = DVector::from_iterator(n, unknowns.iter().map(|one| one.width));
    let mean = DVector::from_iterator(n, unknowns.iter().map(|one| one.mean));
    let off = |values: &DVector<f64>| (values - &mean).component_div(&width);
    let mut prediction = model.predict(unknowns, &values)?;
    let mut damping = 1e-3;
    let mut step = 0;
    loop {
        // in units of the priors' widths
        let normal = Normal::of(&places, &prediction, &residual(measured, &prediction, weight), weight, n);
        let mut matrix = normal.matrix;
        for j in 0..n {
            for i in 0..n {
                matrix[(i, j)] *= width[i] * width[j];
            }
            matrix[(j, j)] += 1.0;
        }
        let slope = normal.slope.component_mul(&width) - off(&values);
        let now = normal.chi2 + off(&values).norm_squared();
        let factor = matrix.clone().cholesky().ok_or(MeasuredError::Singular(step))?;
        let has_ended = slope.dot(&factor.solve(&slope)) < ENOUGH.max(ENOUGH_SHARE * now);
        let further = (!has_ended && step < STEPS).then(|| {
            let sum = |values: &DVector<f64>, at: &Prediction| {
                let left = residual(measured, at, weight);
                left.component_mul(&left).dot(weight) + off(values).norm_squared()
            };
            further(
                model,
                unknowns,
                (&matrix, &slope),
                &mut damping,
                |moved| &values + moved.component_mul(&width),
                |v, at| sum(v, at) < now,
            )
        });
        match further.flatten() {
            Some(better) => (values, prediction) = better,
            None => {
                let mut covariance = factor.inverse();
                for j in 0..n {
                    for i in 0..n {
                        covariance[(i, j)] *= width[i] * width[j];
                    }
                }
                return Ok(Descent { values, covariance, prediction, steps: step, has_ended });
            }
        }
        step += 1;
    }
}

/// The first better point along the curve of damped steps, from the longest on; none where not even a millionth of a step is better: the
/// best ring is one at the edge of stability.
fn further(
    model: &Model,
    unknowns: &[Unknown],
    (matrix, slope): (&DMatrix<f64>, &DVector<f64>),
    damping: &mut f64,
    to: impl Fn(&DVector<f64>) -> DVector<f64>,
    is_better: impl Fn(&DVector<f64>, &Prediction) -> bool,
) -> Option<(DVector<f64>, Prediction)> {
    while *damping < 1e9 {
        let mut damped = matrix.clone();
        for i in 0..slope.len() {
            damped[(i, i)] *= 1.0 + *damping;
        }
        let values = to(&damped.cholesky()?.solve(slope));
        match model.predict(unknowns, &values) {
            Ok(at) if is_better(&values, &at) => {
                *damping = (*damping * 0.1).max(1e-9);
                return Some((values, at));
            }
            _ => *damping *= 10.0,
        }
    }
    None
}

/// The error of the model in each block: its weighted sum of squares is then the number of its elements less the unknowns that they determine.
fn learnt(data: &Data, here: &Descent, before: &[f64; 6]) -> [f64; 6] {
    let weight = data.weight(before);
    let residual = residual(&data.measured, &here.prediction, &weight);
    let mut of_block: [Vec<(f64, f64)>; 6] = Default::default();
    for ((&block, &sigma), &residual) in data.block.iter().zip(&data.sigma).zip(&residual) {
        if sigma.is_finite() {
            of_block[block].push((residual.powi(2), sigma.powi(2)));
        }
    }
    let all: usize = of_block.iter().map(Vec::len).sum();
    // all unknowns together take their number from all elements together
    let left = 1.0 - (here.values.len() as f64 / all as f64).min(0.5);
    of_block.map(|elements| {
        let excess =
            |tau2: f64| elements.iter().map(|(r2, s2)| r2 / (s2 + tau2)).sum::<f64>() - left * elements.len() as f64;
        let (mut low, mut high) = (0.0, elements.iter().map(|(r2, _)| r2).sum::<f64>());
        if elements.is_empty() || excess(0.0) <= 0.0 {
            return 0.0;
        }
        while high - low > 1e-9 * high {
            let middle = 0.5 * (low + high);
            if excess(middle) > 0.0 { low = middle } else { high = middle }
        }
        (0.5 * (low + high)).sqrt()
    })
}

impl Fit {
    /// Standard deviation of an unknown.
    pub fn sigma(&self, unknown: usize) -> f64 {
        self.covariance[(unknown, unknown)].sqrt()
    }

    /// Sets of unknowns that the measurement cannot tell apart: each is known less well than half its prior, and follows another one by a
    /// correlation above 0.9 of either sign.
    pub fn degenerate(&self) -> Vec<Vec<usize>> {
        let n = self.unknowns.len();
        let is_open = |i: usize| self.sigma(i) > 0.5 * self.unknowns[i].width;
        let open: Vec<usize> =
            (0..n).filter(|&i| is_open(i) && !matches!(self.unknowns[i].kind, Kind::RfScale)).collect();
        let follow = |i: usize, j: usize| (self.covariance[(i, j)] / (self.sigma(i) * self.sigma(j))).abs() > 0.9;
        let mut sets: Vec<Vec<usize>> = Vec::new();
        for &i in &open {
            let (joined, mut apart): (Vec<_>, Vec<_>) =
                sets.into_iter().partition(|set| set.iter().any(|&j| follow(i, j)));
            apart.push(joined.into_iter().flatten().chain([i]).collect());
            sets = apart;
        }
        sets.retain(|set| set.len() > 1);
        sets
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{NOISE, machine, measured, ring};

    fn fitted(sigma: f64, seed: u64) -> (Fit, DVector<f64>) {
        let ring = ring();
        let truth = machine(&ring, seed);
        let folder = measured(&ring, &truth, sigma, 100 + seed);
        (fit(&folder, &Settings::default(), &mut |_| ()).unwrap(), truth.2)
    }

    /// Mean square error of the strengths over their variance.
    fn nees((fit, truth): &(Fit, DVector<f64>)) -> f64 {
        let strengths = (0..fit.groups[0].len()).map(|i| ((fit.values[i] - truth[i]) / fit.sigma(i)).powi(2));
        strengths.sum::<f64>() / fit.groups[0].len() as f64
    }

    #[test]
    fn an_imperfect_ring_is_found_within_its_error_bars() {
        let all: Vec<_> = (0..4).map(|seed| fitted(NOISE, seed)).collect();
        for (fit, _) in &all {
            // 600 elements and 140 unknowns: 0.77 ± 0.06 of the stated noise
            assert!((0.55..0.95).contains(&fit.chi2_loco), "{}", fit.chi2_loco);
            assert!(fit.chi2_start > 100.0 && fit.outliers.is_empty());
            // the square of noise and model's error is known to 12 % from the 144 elements of a block, to 41 % from 12 of the dispersion; four
            // such errors
            let limits = [0.7, 0.7, 0.7, 0.7, 1.3, 1.3].map(|limit| limit * NOISE);
            assert!(fit.discrepancy.iter().zip(limits).all(|(tau, limit)| *tau < limit), "{:?}", fit.discrepancy);
        }
        // 96 strengths: their mean square scatters by 0.14
        let mean = all.iter().map(nees).sum::<f64>() / 4.0;
        assert!((0.5..1.5).contains(&mean), "NEES {mean}");
    }

    #[test]
    fn what_the_model_misses_is_learnt() {
        let found = fitted(5.0 * NOISE, 7);
        let expected = NOISE * 24f64.sqrt();
        for tau in found.0.discrepancy.iter().take(4) {
            // 144 elements of a block, a quarter of them for the unknowns: known to 7 %, three times that
            assert!((tau / expected - 1.0).abs() < 0.21, "{tau}, expected {expected}");
        }
        assert!((0.4..1.7).contains(&nees(&found)), "NEES {}", nees(&found));
    }

    #[test]
    fn an_element_far_off_is_set_aside() {
        let ring = ring();
        let truth = machine(&ring, 1);
        let mut folder = measured(&ring, &truth, NOISE, 2);
        folder.matrix[(3, 5)] += 0.5;
        let fit = fit(&folder, &Settings::default(), &mut |_| ()).unwrap();
        assert_eq!(fit.outliers, [[3, 5]]);
        assert_eq!(fit.weight[(3, 5)], 0.0);
    }
}
