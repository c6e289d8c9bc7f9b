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
use twin::Rf;

use crate::data::Data;
use crate::descent::{Descent, EXACT, ROUGH, descend};
use crate::error::MeasuredError;
use crate::folder::Folder;
use crate::linear::LANES;
use crate::model::{Model, Prediction};
use crate::noise::Noise;
use crate::normal::Places;
use crate::uncertainty::Uncertainty;
use crate::unknowns::{Groups, Kind, Unknown, Widths, groups, unknowns};

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

/// A fitted measurement.
#[derive(Debug, Clone)]
pub struct Fit {
    /// Groups of magnets.
    pub groups: Groups,
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
    /// Errors of the elements.
    pub noise: Noise,
    /// Measured less predicted [mm], with the dispersion as the last column; 0 where nothing counts.
    pub residual: DMatrix<f64>,
    /// Gauss-Newton steps.
    pub steps: usize,
    /// False where the last descent was still moving when its steps were used up: the model is far from the measurement.
    pub has_ended: bool,
}

/// Where a fit begins.
pub(crate) struct Start {
    groups: Groups,
    model: Model,
    unknowns: Vec<Unknown>,
    data: Data,
    values: DVector<f64>,
    prediction: Prediction,
}

impl Start {
    /// Of a measurement.
    pub fn of(folder: &Folder, settings: &Settings) -> Result<Self, MeasuredError> {
        let groups = groups(folder);
        if groups.iter().all(Vec::is_empty) {
            return Err(MeasuredError::NoGradient(folder.name.clone()));
        }
        let model = Model::of(folder, &groups, settings.rf)?;
        let of_reference = folder.meta.reference_fit.as_ref().is_none_or(|fit| fit.flags.coupling == "Yes");
        let coupling = settings.coupling.unwrap_or(of_reference);
        let unknowns = unknowns(folder, &groups, coupling, &settings.widths);
        let data = Data::of(folder);
        if data.elements() == 0 {
            return Err(MeasuredError::Empty {
                name: folder.name.clone(),
                monitors: folder.monitors.len(),
                reading: folder.monitors.iter().filter(|one| one.is_used).count(),
                correctors: folder.correctors.len(),
                kicking: folder.correctors.iter().filter(|one| one.is_used).count(),
            });
        }
        let values = DVector::from_iterator(unknowns.len(), unknowns.iter().map(|one| one.mean));
        let prediction = model.predict(&unknowns, &values)?;
        Ok(Self { groups, model, unknowns, data, values, prediction })
    }
}

/// Standard deviations beyond which a sum of squares is no chance.
const CERTAIN: f64 = 4.0;
/// Noise from a few repeats is known to such a factor.
const KNOWN: f64 = 1.5;
/// Rounds of the model's error at most; the last one changes the residuals' probability by less than this [nat].
const ROUNDS: usize = 6;
const SETTLED: f64 = 0.01;

/// Fit a measurement.
///
/// # Errors
/// [`MeasuredError`].
pub fn fit(folder: &Folder, settings: &Settings, progress: &mut dyn FnMut(&str)) -> Result<Fit, MeasuredError> {
    let Start { groups, model, unknowns, mut data, values, prediction: start } = Start::of(folder, settings)?;
    let megabytes = memory(&unknowns, data.measured.shape()) >> 20;
    progress(&format!("{} unknowns of {} elements, {megabytes} MB of memory", unknowns.len(), data.elements()));
    let chi2_start = data.chi2(&start) / data.elements() as f64;
    let (mut as_stated, mut outliers) = (
        Descent { values, covariance: DMatrix::zeros(0, 0), prediction: start, steps: 0, has_ended: false },
        Vec::new(),
    );
    loop {
        progress(&format!("as stated, {} outliers", outliers.len()));
        let before = as_stated.steps;
        as_stated = descend(&model, &unknowns, &data.measured, &data.stated(), (as_stated.values, ROUGH))?;
        as_stated.steps += before;
        let further = data.set_outliers_aside(&as_stated.prediction);
        if further.is_empty() {
            break;
        }
        outliers.extend(further);
    }
    let elements = data.elements();
    let chi2_loco = data.chi2(&as_stated.prediction) / elements as f64;
    let steps = as_stated.steps;
    let stated = Noise::stated(data.measured.nrows());
    let (here, noise, uncertainty) = with_model_error(&model, &unknowns, &data, (as_stated, stated), progress)?;
    Ok(Fit {
        groups,
        chi2_loco,
        chi2_start,
        elements,
        outliers,
        residual: data.residual(&here.prediction),
        data,
        noise,
        steps: steps + here.steps,
        has_ended: here.has_ended,
        values: here.values,
        uncertainty,
        unknowns,
    })
}

/// Memory of a fit [bytes], roughly: 303 MB for a ring of 400 gradients, readings and kicks whose fit took 402. Of all unknowns eight square matrices at a
/// time, of each lane of a sum the machine's block, of two predictions some twenty matrices of the measured shape, and the factors of their derivatives.
pub fn memory(unknowns: &[Unknown], (rows, columns): (usize, usize)) -> usize {
    let n = unknowns.len();
    let is_machine = |one: &&Unknown| one.kind.is_of_machine();
    let machine = unknowns.iter().filter(is_machine).count();
    size_of::<f64>() * (8 * n * n + LANES * machine * machine + 20 * rows * columns + 12 * rows * machine)
}

/// Learn in turn what the model misses in each block and the unknowns, from where a descent with some errors of the elements ended: where the last
/// descent ended, the errors of the elements, and how well the unknowns are known.
///
/// # Errors
/// [`MeasuredError`].
pub fn with_model_error(
    model: &Model,
    unknowns: &[Unknown],
    data: &Data,
    (mut here, mut noise): (Descent, Noise),
    progress: &mut dyn FnMut(&str),
) -> Result<(Descent, Noise, Uncertainty), MeasuredError> {
    let mut steps = 0;
    let places = Places::of(unknowns, data.measured.nrows(), data.measured.ncols());
    for round in 1..=ROUNDS {
        progress(&format!("error of the model, round {round} of {ROUNDS}"));
        let residual = data.residual(&here.prediction);
        let followed = noise.followed(data, &places, &here.prediction, (&residual, &here.covariance));
        let gained;
        (noise, gained) = noise.learnt(data, &residual, &followed);
        let weight = data.weight(&noise, &residual);
        here = descend(model, unknowns, &data.measured, &weight, (here.values, EXACT))?;
        steps += here.steps;
        if gained.abs() < SETTLED {
            break;
        }
    }
    let uncertainty = Uncertainty::of(unknowns, &here.prediction, data, &noise)?;
    Ok((Descent { steps, ..here }, noise, uncertainty))
}

impl Fit {
    /// Standard deviation of an unknown.
    pub fn sigma(&self, unknown: usize) -> f64 {
        self.uncertainty.sigma[unknown]
    }

    /// By how much the stated noise is larger than what the fit leaves over, unknowns counted, where that is more than chance and than noise is
    /// known to.
    pub fn overstated_noise(&self) -> Option<f64> {
        let freedom = self.elements as f64 - self.unknowns.len() as f64;
        let left = self.chi2_loco * self.elements as f64 / freedom;
        // a mean of so many squares scatters by the root
        let is_chance = freedom <= 0.0 || left > 1.0 - CERTAIN * (2.0 / freedom).sqrt();
        (!is_chance).then(|| left.powf(-0.5)).filter(|factor| *factor > KNOWN)
    }

    /// Squares of the residuals over those of their scales: as an error has heavy tails, more than 1 on average.
    pub fn squares(&self) -> DMatrix<f64> {
        self.residual.component_mul(&self.residual).component_mul(&self.data.precision(&self.noise))
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
            assert_eq!(fit.overstated_noise(), None);
            // the square of noise and model's error is known to 12 % from the 144 elements of a block, to 41 % from 12 of the dispersion; four
            // such errors
            let limits = [0.7, 0.7, 0.7, 0.7, 1.3, 1.3].map(|limit| limit * NOISE);
            assert!(fit.noise.blocks.iter().zip(limits).all(|(one, limit)| one.scale < limit), "{:?}", fit.noise);
        }
        // 96 strengths: their mean square scatters by 0.14
        let mean = all.iter().map(nees).sum::<f64>() / 4.0;
        assert!((0.5..1.5).contains(&mean), "NEES {mean}");
    }

    #[test]
    fn noise_that_is_stated_ten_times_too_large_is_told() {
        let ring = ring();
        let mut folder = measured(&ring, &machine(&ring, 1), NOISE, 101);
        folder.monitors.iter_mut().for_each(|one| one.sigma *= 10.0);
        let factor = fit(&folder, &Settings::default(), &mut |_| ()).unwrap().overstated_noise().unwrap();
        // 460 degrees of freedom tell it to 3 %, fewer where priors hold unknowns
        assert!((8.0..11.0).contains(&factor), "{factor}");
    }

    /// The same matrix for kicks of 1 rad: elements of metres, noise of millimetres.
    #[test]
    fn a_fit_does_not_depend_on_the_kick_that_the_matrix_is_counted_for() {
        let ring = ring();
        let folder = measured(&ring, &machine(&ring, 1), NOISE, 101);
        let mut per_radian = folder.clone();
        // a power of 2 scales everything without rounding
        per_radian.matrix *= 4096.0;
        per_radian.correctors.iter_mut().for_each(|one| one.kick *= 4096.0);
        per_radian.monitors.iter_mut().for_each(|one| one.sigma *= 4096.0);
        per_radian.dispersion.iter_mut().for_each(|one| *one *= 4096.0);
        per_radian.meta.delta_rf *= 4096.0;
        assert!(per_radian.matrix.amax() > 1e3);
        let [small, large] =
            [folder, per_radian].map(|folder| fit(&folder, &Settings::default(), &mut |_| ()).unwrap());
        assert!((small.values - large.values).amax() < 1e-9 && (small.chi2_loco - large.chi2_loco).abs() < 1e-9);
    }

    /// The ring with its focusing in dipoles.
    fn combined_function() -> Folder {
        let mut ring = ring();
        ring.meta.reference_fit = None;
        let share = 0.05;
        for row in ring.lattice.iter_mut() {
            match row.name.as_str() {
                "QF" | "QD" => row.bend = share,
                "B" => row.bend -= 2.0 * share,
                _ => {}
            }
        }
        ring
    }

    #[test]
    fn dipoles_with_gradients_are_unknowns() {
        let ring = combined_function();
        let fitted = |seed| {
            let truth = machine(&ring, seed);
            (fit(&measured(&ring, &truth, NOISE, 300 + seed), &Settings::default(), &mut |_| ()).unwrap(), truth.2)
        };
        let all: Vec<_> = (0..4).map(fitted).collect();
        for (fit, _) in &all {
            assert_eq!(fit.groups.each_ref().map(Vec::len), [24, 0, 0, 0]);
            assert!((0.55..0.95).contains(&fit.chi2_loco), "{}", fit.chi2_loco);
        }
        // 96 strengths, as above
        let mean = all.iter().map(nees).sum::<f64>() / 4.0;
        assert!((0.5..1.5).contains(&mean), "NEES {mean}");
    }

    #[test]
    fn a_ring_without_a_gradient_has_nothing_to_fit() {
        let mut ring = combined_function();
        ring.lattice.iter_mut().for_each(|row| row.k1 = 0.0);
        assert_eq!(
            fit(&ring, &Settings::default(), &mut |_| ()).unwrap_err().to_string(),
            "ring: nothing to fit: lattice.csv has neither a quadrupole nor a dipole with a gradient (k1_start_1_m2)"
        );
    }

    /// All dipoles as one parameter that starts at 0.
    #[test]
    fn a_gradient_that_starts_at_nothing_is_added() {
        let mut ring = ring();
        let dipoles = (0..ring.lattice.len()).filter(|&row| ring.lattice[row].bend != 0.0).collect();
        let reference = ring.meta.reference_fit.as_mut().unwrap();
        reference.fit_parameters.insert(0, crate::folder::Group { elements: dipoles, field: "K".into() });
        let (model, unknowns, mut truth) = machine(&ring, 7);
        assert_eq!((unknowns[0].kind, unknowns[1].kind), (Kind::Added(0), Kind::Strength(1)));
        truth[0] = 0.02;
        let folder = measured(&ring, &(model, unknowns, truth.clone()), NOISE, 8);
        let fit = fit(&folder, &Settings::default(), &mut |_| ()).unwrap();
        assert!(
            (fit.values[0] - 0.02).abs() < 3.0 * fit.sigma(0) && fit.sigma(0) < 0.005,
            "{} {}",
            fit.values[0],
            fit.sigma(0)
        );
        let nees = nees(&(fit, truth));
        assert!((0.13..1.87).contains(&nees), "NEES {nees}");
    }

    #[test]
    fn what_the_model_misses_is_learnt() {
        let all: Vec<_> = (0..8).map(|seed| fitted(5.0 * NOISE, seed)).collect();
        let of_blocks = all.iter().flat_map(|(fit, _)| fit.noise.blocks.iter().take(4));
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
        let tailed = all.iter().flat_map(|(fit, _)| fit.noise.blocks.iter().take(4)).filter(|one| one.freedom < 5.0);
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
