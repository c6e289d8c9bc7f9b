//! The fit of a measured matrix: first with the stated noise alone, as LOCO weighs it, then with an error of the model whose size is learnt.
//!
//! Damped Gauss-Newton on
//!
//! `sum w (measured - predicted)^2 + sum ((p - mean)/width)^2`,
//!
//! `w` one over the square of the stated noise at first, then with what the model misses ([`crate::missed`]), learnt for each block of the matrix
//! (x and y monitors, H and V correctors, the dispersion of both planes) in turn with the unknowns. Stated noise is that of the monitors; where
//! the model misses more, error bars from it alone are wrong.

use nalgebra::{DMatrix, DVector};
use twin::{Plane, Rf};

use crate::error::MeasuredError;
use crate::folder::Folder;
use crate::missed::Missed;
use crate::model::{Model, Prediction};
use crate::normal::{Normal, Places};
use crate::uncertainty::Uncertainty;
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
    /// How well they are known.
    pub uncertainty: Uncertainty,
    /// Sum of squares over the stated noise, per element, at the values that make it least, as LOCO counts it.
    pub chi2_loco: f64,
    /// The same at the start.
    pub chi2_start: f64,
    /// Elements that count.
    pub elements: usize,
    /// Elements that were set aside: row and column.
    pub outliers: Vec<[usize; 2]>,
    /// What was fitted, without the outliers.
    pub data: Data,
    /// What the model misses in each of [`BLOCKS`].
    pub missed: [Missed; 6],
    /// Measured less predicted [mm], with the dispersion as the last column; 0 where nothing counts.
    pub residual: DMatrix<f64>,
    /// The same of the fit with the stated noise alone.
    pub stated_residual: DMatrix<f64>,
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
/// Of an element that the unknowns follow further than this, what is left tells nothing of its error.
const LEAST_LEFT: f64 = 0.1;

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

    /// Measured less predicted [mm], where it counts.
    pub fn residual(&self, at: &Prediction) -> DMatrix<f64> {
        residual(&self.measured, at, &self.stated())
    }

    /// One over the square of the stated noise of each element [1/mm^2].
    pub fn stated(&self) -> DMatrix<f64> {
        self.each(&[Missed::NOTHING; 6], |missed, sigma| missed.spread(sigma).powi(-2))
    }

    /// The same with what the model misses in each block.
    pub fn precision(&self, missed: &[Missed; 6]) -> DMatrix<f64> {
        self.each(missed, |missed, sigma| missed.spread(sigma).powi(-2))
    }

    /// What each element counts [1/mm^2], the less the further it is off.
    pub fn weight(&self, missed: &[Missed; 6], residual: &DMatrix<f64>) -> DMatrix<f64> {
        DMatrix::from_fn(residual.nrows(), residual.ncols(), |i, j| {
            missed[self.block[(i, j)]].weight(self.sigma[(i, j)], residual[(i, j)])
        })
    }

    /// What each element says on average [1/mm^2].
    pub fn information(&self, missed: &[Missed; 6]) -> DMatrix<f64> {
        self.each(missed, Missed::information)
    }

    /// `ln` of the likelihood of residuals [mm].
    pub fn log_likelihood(&self, missed: &[Missed; 6], residual: &DMatrix<f64>) -> f64 {
        let elements = self.sigma.iter().zip(&self.block).zip(residual).filter(|((sigma, _), _)| sigma.is_finite());
        elements.map(|((&sigma, &block), &residual)| missed[block].log_likelihood(sigma, residual)).sum()
    }

    fn each(&self, missed: &[Missed; 6], of: impl Fn(&Missed, f64) -> f64) -> DMatrix<f64> {
        self.sigma.zip_map(&self.block, |sigma, block| of(&missed[block], sigma))
    }

    /// Sum of squares over the stated noise.
    fn chi2(&self, at: &Prediction) -> f64 {
        let left = self.residual(at);
        left.component_mul(&left).dot(&self.stated())
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
        as_stated = descend(&model, &unknowns, &data.measured, &data.stated(), as_stated.values)?;
        as_stated.steps += before;
        let further = data.set_outliers_aside(&as_stated.prediction);
        if further.is_empty() {
            break;
        }
        outliers.extend(further);
    }
    let elements = data.elements();
    let chi2_loco = data.chi2(&as_stated.prediction) / elements as f64;
    let stated_residual = data.residual(&as_stated.prediction);
    let steps = as_stated.steps;
    let Learnt { here, missed, uncertainty } = with_model_error(&model, &unknowns, &data, as_stated, progress)?;
    Ok(Fit {
        groups,
        chi2_loco,
        chi2_start,
        elements,
        outliers,
        residual: data.residual(&here.prediction),
        data,
        missed,
        stated_residual,
        steps: steps + here.steps,
        has_ended: here.has_ended,
        values: here.values,
        uncertainty,
        unknowns,
    })
}

/// Descend with what the model misses in each block, which is learnt in turn with the unknowns.
///
/// # Errors
/// [`MeasuredError`].
pub fn with_model_error(
    model: &Model,
    unknowns: &[Unknown],
    data: &Data,
    from: Descent,
    progress: &mut dyn FnMut(&str),
) -> Result<Learnt, MeasuredError> {
    let (mut here, mut missed, mut steps) = (from, [Missed::NOTHING; 6], 0);
    for round in 1..=ROUNDS {
        progress(&format!("error of the model, round {round} of {ROUNDS}"));
        missed = learnt(data, &errors(data, unknowns, &here, &missed));

        let weight = data.weight(&missed, &data.residual(&here.prediction));
        here = descend(model, unknowns, &data.measured, &weight, here.values)?;
        steps += here.steps;
    }
    let uncertainty = Uncertainty::of(unknowns, &here.prediction, data, &missed)?;
    Ok(Learnt { here: Descent { steps, ..here }, missed, uncertainty })
}

/// A descent with what the model misses.
pub struct Learnt {
    /// Where it ended.
    pub here: Descent,
    /// What the model misses in each of [`BLOCKS`].
    pub missed: [Missed; 6],
    /// How well the unknowns are known.
    pub uncertainty: Uncertainty,
}

/// Where a descent ended.
pub struct Descent {
    /// Most probable values.
    pub values: DVector<f64>,
    /// Their covariance as the elements count.
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
        let normal = Normal::of(&places, &prediction, &residual(measured, &prediction, weight), weight, n);
        let matrix = in_widths(normal.matrix, &width);
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
                let covariance = times(factor.inverse(), &width);
                return Ok(Descent { values, covariance, prediction, steps: step, has_ended });
            }
        }
        step += 1;
    }
}

/// An information matrix in units of the priors' widths, with the priors.
fn in_widths(information: DMatrix<f64>, width: &DVector<f64>) -> DMatrix<f64> {
    let n = width.len();
    times(information, width) + DMatrix::identity(n, n)
}

/// Each element times the widths of its row and of its column.
fn times(mut matrix: DMatrix<f64>, width: &DVector<f64>) -> DMatrix<f64> {
    for (mut column, &of_column) in matrix.column_iter_mut().zip(width) {
        column.component_mul_assign(width);
        column *= of_column;
    }
    matrix
}

/// Covariance of the unknowns about a prediction, with what each element says [1/mm^2].
pub(crate) fn covariance(
    unknowns: &[Unknown],
    at: &Prediction,
    information: &DMatrix<f64>,
) -> Result<DMatrix<f64>, MeasuredError> {
    let (rows, columns) = information.shape();
    let width = DVector::from_iterator(unknowns.len(), unknowns.iter().map(|one| one.width));
    let places = Places::of(unknowns, rows, columns);
    let normal = Normal::of(&places, at, &DMatrix::zeros(rows, columns), information, unknowns.len());
    let factor = in_widths(normal.matrix, &width).cholesky().ok_or(MeasuredError::Singular(0))?;
    Ok(times(factor.inverse(), &width))
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

/// Residuals as large as the errors that they are left of [mm]: the unknowns follow each element with a share `h` of it, its weight times the
/// variance that their covariance gives it, and leave `1 - h` of its variance.
///
/// Source: D. A. Belsley, E. Kuh and R. E. Welsch, Regression Diagnostics (1980), eq. 2.15.
fn errors(data: &Data, unknowns: &[Unknown], here: &Descent, missed: &[Missed; 6]) -> DMatrix<f64> {
    let residual = data.residual(&here.prediction);
    let places = Places::of(unknowns, residual.nrows(), residual.ncols());
    let followed = places.variance(&here.prediction, &here.covariance).component_mul(&data.weight(missed, &residual));
    residual.zip_map(&followed, |residual, followed| residual / (1.0 - followed).max(LEAST_LEFT).sqrt())
}

/// What the model misses in each block, from the errors of its elements [mm].
fn learnt(data: &Data, errors: &DMatrix<f64>) -> [Missed; 6] {
    let mut of_block: [Vec<(f64, f64)>; 6] = Default::default();
    for ((&block, &sigma), &error) in data.block.iter().zip(&data.sigma).zip(errors) {
        if sigma.is_finite() {
            of_block[block].push((error, sigma));
        }
    }
    of_block.map(|elements| Missed::of(&elements))
}

impl Fit {
    /// Standard deviation of an unknown.
    pub fn sigma(&self, unknown: usize) -> f64 {
        self.uncertainty.sigma[unknown]
    }

    /// Squares of the residuals over those of their scales: as an error has heavy tails, more than 1 on average.
    pub fn squares(&self) -> DMatrix<f64> {
        self.residual.component_mul(&self.residual).component_mul(&self.data.precision(&self.missed))
    }

    /// Sets of unknowns that the measurement cannot tell apart: each is known less well than half its prior, and follows another one by a
    /// correlation above 0.9 of either sign.
    pub fn degenerate(&self) -> Vec<Vec<usize>> {
        let n = self.unknowns.len();
        let covariance = &self.uncertainty.independent;
        let sigma = |i: usize| covariance[(i, i)].sqrt();
        let is_open = |i: usize| sigma(i) > 0.5 * self.unknowns[i].width;
        let open: Vec<usize> =
            (0..n).filter(|&i| is_open(i) && !matches!(self.unknowns[i].kind, Kind::RfScale)).collect();
        let follow = |i: usize, j: usize| (covariance[(i, j)] / (sigma(i) * sigma(j))).abs() > 0.9;
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
    use rand::SeedableRng;
    use rand::rngs::StdRng;
    use rand_distr::{Distribution, StudentT};

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
            assert!(fit.missed.iter().zip(limits).all(|(one, limit)| one.scale < limit), "{:?}", fit.missed);
        }
        // 96 strengths: their mean square scatters by 0.14
        let mean = all.iter().map(nees).sum::<f64>() / 4.0;
        assert!((0.5..1.5).contains(&mean), "NEES {mean}");
    }

    #[test]
    fn what_the_model_misses_is_learnt() {
        let all: Vec<_> = (0..8).map(|seed| fitted(5.0 * NOISE, seed)).collect();
        let of_blocks = all.iter().flat_map(|(fit, _)| fit.missed.iter().take(4));
        let (scales, freedoms): (Vec<f64>, Vec<f64>) = of_blocks.map(|one| (one.scale, one.freedom)).unzip();
        // 32 blocks of 144 elements, a quarter of them for the unknowns: each known to 7 %, their mean to 1.2 %; four times that
        let mean = scales.iter().sum::<f64>() / 32.0;
        assert!((mean / (NOISE * 24f64.sqrt()) - 1.0).abs() < 0.048, "{mean}");
        assert!(freedoms.iter().all(|nu| nu.is_infinite()), "tails of normal errors: {freedoms:?}");
        // 192 strengths: their mean square scatters by 0.10, four times that
        let nees = all.iter().map(nees).sum::<f64>() / 8.0;
        assert!((0.6..1.4).contains(&nees), "NEES {nees}");
    }

    #[test]
    fn errors_with_heavy_tails_do_no_harm() {
        let ring = ring();
        let tails = StudentT::new(2.0).unwrap();
        let mut random = StdRng::seed_from_u64(4);
        let all: Vec<_> = (0..8)
            .map(|seed| {
                let truth = machine(&ring, seed);
                let mut folder = measured(&ring, &truth, NOISE, 200 + seed);
                folder.matrix.iter_mut().for_each(|one| *one += 5.0 * NOISE * tails.sample(&mut random));
                (fit(&folder, &Settings::default(), &mut |_| ()).unwrap(), truth.2)
            })
            .collect();
        let nees = all.iter().map(nees).sum::<f64>() / 8.0;
        assert!((0.6..1.4).contains(&nees), "NEES {nees}");
        let tailed = all.iter().flat_map(|(fit, _)| fit.missed.iter().take(4)).filter(|one| one.freedom < 5.0);
        // 144 elements with two degrees of freedom have gained 25 nat over normal ones on average
        assert!(tailed.count() > 28);
    }

    #[test]
    fn an_element_far_off_is_set_aside() {
        let ring = ring();
        let truth = machine(&ring, 1);
        let mut folder = measured(&ring, &truth, NOISE, 2);
        folder.matrix[(3, 5)] += 0.5;
        let fit = fit(&folder, &Settings::default(), &mut |_| ()).unwrap();
        assert_eq!(fit.outliers, [[3, 5]]);
        assert_eq!(fit.data.stated()[(3, 5)], 0.0);
    }
}
