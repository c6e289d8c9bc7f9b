//! What the model of a measured matrix lacks: what the RF holds, cables, and instruments whose readings nothing explains.
//!
//! The pattern `d` of a held frequency is scored to first order about the fit, all unknowns adapting. With `r` the residuals, `W` the weights and
//! `P` the projection that removes what the unknowns can absorb, `g = d P r` and `h = d P d`:
//!
//! `ln Bayes factor = g^2/(1 + h)/2 - ln(1 + h)/2` for a share with a prior width of 1.
//!
//! It is then fitted with all unknowns, and the error of the model is learnt anew. What patterns gain that are like it, the same orbit with
//! the kicks' shares in other correctors, tells how much chance and the model's other errors give.

use nalgebra::{DMatrix, DVector};
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand::seq::SliceRandom;
use twin::{Plane, Rf};

use crate::about::About;
use crate::descent::descend;
use crate::error::MeasuredError;
use crate::fit::{Fit, Learnt, Settings, with_model_error};
use crate::folder::Folder;
use crate::model::{Model, Prediction};
use crate::sides::{Sides, sides};
use crate::standing::{Standing, standing};
use crate::unknowns::{Kind, Unknown};

/// Patterns that the term of a held frequency is compared with.
const SHUFFLES: usize = 99;

/// The share of a held frequency, fitted with everything else.
#[derive(Debug, Clone)]
pub struct Share {
    /// 1 where the frequency is held, 0 where the momentum is.
    pub value: f64,
    /// Its standard deviation by the scatter of the residuals, alike along rows and columns.
    pub scatter: f64,
    /// What the model misses of the measured dispersion, relative: the term is the product of two dispersions, and errors of the model's
    /// dispersion are long waves, which do not average.
    pub systematic: f64,
    /// Gain of `ln` likelihood, the errors of the model learnt in both fits.
    pub gain: f64,
    /// How many of `shuffles` patterns with the correctors' shares exchanged gain as much, to first order.
    pub as_good: usize,
    /// Patterns tried.
    pub shuffles: usize,
}

impl Share {
    /// Standard deviation of the share, both causes together.
    pub fn sigma(&self) -> f64 {
        self.scatter.hypot(self.systematic)
    }
}

/// An instrument whose readings the model explains worse than those of the others.
#[derive(Debug, Clone)]
pub struct Unexplained {
    /// Its name.
    pub at: String,
    /// Rms of its residuals [mm].
    pub rms: f64,
    /// Its mean square over that of all other elements, by their weights.
    pub ratio: f64,
}

/// What was found.
#[derive(Debug, Clone)]
pub struct Diagnosis {
    /// Of the held frequency.
    pub share: Share,
    /// Of instruments, the worst first.
    pub unexplained: Vec<Unexplained>,
    /// Values that stand out of those of their kind.
    pub standing: Vec<Standing>,
    /// Where what is left over lies.
    pub sides: Sides,
}

/// An instrument is worse than others from this ratio on.
const WORSE: f64 = 2.5;

/// Diagnose a fitted measurement.
///
/// # Errors
/// [`MeasuredError`].
pub fn diagnose(
    folder: &Folder,
    fitted: &Fit,
    settings: &Settings,
    progress: &mut dyn FnMut(&str),
) -> Result<Diagnosis, MeasuredError> {
    let model = Model::of(folder, &fitted.groups, settings.rf)?;
    let share = share(folder, fitted, &model, settings, progress)?;
    progress("lattice or instruments");
    let unexplained = unexplained(folder, fitted);
    // where the fit did not end its values are not those of the ring
    let standing = if fitted.has_ended { standing(folder, fitted) } else { Vec::new() };
    Ok(Diagnosis { share, sides: sides(folder, fitted, &model)?, standing, unexplained })
}

/// Of an amplitude with a prior standard deviation of 1.
fn of_amplitude((pull, power): (f64, f64)) -> f64 {
    0.5 * pull * pull / (1.0 + power) - 0.5 * power.ln_1p()
}

/// The unknowns of a fit with the share of a held frequency among those of the machine.
fn with_share(fitted: &Fit, share: f64) -> (Vec<Unknown>, DVector<f64>) {
    let at = fitted.groups[0].len() + fitted.groups[1].len();
    let (mut unknowns, mut values) = (fitted.unknowns.clone(), fitted.values.as_slice().to_vec());
    unknowns.insert(at, Unknown { kind: Kind::HeldFrequency, mean: share, width: 1.0 });
    values.insert(at, share);
    (unknowns, DVector::from_vec(values))
}

/// The share of a held frequency.
fn share(
    folder: &Folder,
    fitted: &Fit,
    model: &Model,
    settings: &Settings,
    progress: &mut dyn FnMut(&str),
) -> Result<Share, MeasuredError> {
    let believed = f64::from(u8::from(settings.rf == Rf::FixedFrequency));
    let (unknowns, values) = with_share(fitted, believed);
    let at = fitted.groups[0].len() + fitted.groups[1].len();
    let pattern = model.predict(&unknowns, &values)?.by_machine.swap_remove(at);
    let horizontal = folder.correctors.iter().enumerate().filter(|(_, one)| one.plane == Plane::X && one.is_used);
    let horizontal: Vec<usize> = horizontal.map(|(column, _)| column).collect();
    let patterns: Vec<DMatrix<f64>> = (1..=SHUFFLES as u64).map(|seed| shuffled(&pattern, &horizontal, seed)).collect();
    // by squares: tails that the missing term has given the errors would hide it from a rank by their likelihood
    let data = &fitted.data;
    let precision = data.precision(&fitted.missed);
    let prediction = model.predict(&fitted.unknowns, &fitted.values)?;
    let about = About::of(&fitted.unknowns, prediction, precision.component_mul(&fitted.residual), precision)?;
    let own = of_amplitude(about.score(&pattern));
    let as_good = patterns.iter().filter(|pattern| of_amplitude(about.score(pattern)) >= own).count();
    let from = descend(model, &unknowns, &data.measured, &data.weight(&fitted.missed, &fitted.residual), values)?;
    let Learnt { here, missed, uncertainty } = with_model_error(model, &unknowns, data, from, progress)?;
    let residual = data.residual(&here.prediction);
    let gain = data.log_likelihood(&missed, &residual) - data.log_likelihood(&fitted.missed, &fitted.residual);
    let systematic = dispersion_missed(folder, &here.prediction);
    let slope = data.weight(&missed, &residual).component_mul(&residual);
    let (value, scatter) = (here.values[at], uncertainty.sigma[at]);
    let beside = About::of(&unknowns, here.prediction, slope, data.information(&missed))?;
    let scatter = scatter.max(beside.of_patterns(&patterns));
    Ok(Share { value, scatter, systematic, gain, as_good, shuffles: SHUFFLES })
}

/// Scatter of the measured horizontal dispersion about the predicted one, at the scale that suits it best, over the rms of the predicted: by the
/// median, since few monitors are far off. 0 where it was not measured.
fn dispersion_missed(folder: &Folder, at: &Prediction) -> f64 {
    let Some(dispersion) = &folder.dispersion else { return 0.0 };
    let read = (0..folder.monitors.len())
        .filter(|&row| folder.monitors[row].is_used && folder.monitors[row].plane == Plane::X);
    let last = at.matrix.ncols() - 1;
    let pairs: Vec<(f64, f64)> =
        read.map(|row| (dispersion[row], at.matrix[(row, last)])).filter(|(m, _)| m.is_finite()).collect();
    let [squares, product] =
        [pairs.iter().map(|(_, p)| p * p).sum::<f64>(), pairs.iter().map(|(m, p)| m * p).sum::<f64>()];
    let scale = product / squares;
    let mut off: Vec<f64> = pairs.iter().map(|(m, p)| (m - scale * p).abs()).collect();
    off.sort_by(f64::total_cmp);
    if pairs.is_empty() || squares == 0.0 {
        return 0.0;
    }
    let rms = scale.abs() * (squares / pairs.len() as f64).sqrt();
    1.4826 * off.get(off.len() / 2).copied().unwrap_or(0.0) / rms
}

/// The pattern with the columns of some correctors exchanged at random, the size of each with it.
fn shuffled(pattern: &DMatrix<f64>, columns: &[usize], seed: u64) -> DMatrix<f64> {
    let mut order = columns.to_vec();
    order.shuffle(&mut StdRng::seed_from_u64(seed));
    let mut other = pattern.clone();
    for (&to, &from) in columns.iter().zip(&order) {
        other.set_column(to, &pattern.column(from));
    }
    other
}

/// Monitors' rows and correctors' columns whose residuals are larger than those of the others.
fn unexplained(folder: &Folder, fitted: &Fit) -> Vec<Unexplained> {
    let (squares, sigma) = (fitted.squares(), &fitted.data.sigma);
    let (all, elements) = (squares.sum(), fitted.data.elements() as f64);
    let judge = |at: String, squares: f64, residual: f64, n: usize| {
        let others = (all - squares) / (elements - n as f64);
        Unexplained { at, rms: (residual / n.max(1) as f64).sqrt(), ratio: squares / n.max(1) as f64 / others }
    };
    let counted = |sigmas: &mut dyn Iterator<Item = &f64>| sigmas.filter(|sigma| sigma.is_finite()).count();
    let rows = (0..folder.monitors.len()).map(|i| {
        judge(
            folder.monitor(i),
            squares.row(i).sum(),
            fitted.residual.row(i).norm_squared(),
            counted(&mut sigma.row(i).iter()),
        )
    });
    let columns = (0..folder.correctors.len()).map(|j| {
        judge(
            folder.corrector(j),
            squares.column(j).sum(),
            fitted.residual.column(j).norm_squared(),
            counted(&mut sigma.column(j).iter()),
        )
    });
    let mut worst: Vec<Unexplained> = rows.chain(columns).filter(|one| one.ratio > WORSE).collect();
    worst.sort_by(|a, b| b.ratio.total_cmp(&a.ratio));
    worst
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::fit;
    use crate::testing::{NOISE, machine, measured, ring};

    fn diagnosed(folder: &Folder, rf: Rf) -> Diagnosis {
        let settings = Settings { rf, ..Settings::default() };
        let fitted = fit(folder, &settings, &mut |_| ()).unwrap();
        diagnose(folder, &fitted, &settings, &mut |_| ()).unwrap()
    }

    #[test]
    fn a_held_frequency_that_the_model_lacks_is_found_in_its_size() {
        let ring = ring();
        let folder = measured(&ring, &machine(&ring, 11), NOISE, 1);
        let found = diagnosed(&folder, Rf::FixedMomentum);
        assert_eq!(found.share.as_good, 0);
        assert!((found.share.value - 1.0).abs() < 3.0 * found.share.sigma(), "{:?}", found.share);
        assert!(found.share.sigma() < 0.1, "{:?}", found.share);
        let right = diagnosed(&folder, Rf::FixedFrequency);
        assert!((right.share.value - 1.0).abs() < 3.0 * right.share.sigma(), "{:?}", right.share);
        assert!(right.unexplained.is_empty(), "{:?}", right);
    }
}
