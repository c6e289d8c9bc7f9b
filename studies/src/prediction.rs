//! Prediction: what the prior and the posterior of one subset expect of another's differences, of which no frame was fitted,
//! how often they are right, and the twin's error with and without the point estimates.

use core::ops::Range;

use inference::Pair;
use inference::quantile;
use inference::simulate::{self, VarsError};
use nalgebra::DMatrix;
use report::{Axes, Figure, Panel, Reference, Section, Series};
use statrs::distribution::{ContinuousCDF, Normal};
use twin::{OrbitError, Plane};

use super::sampling::Sampling;
use super::subsets::{Subset, Subsets};
use super::{Sampled, StudyError};

/// Draws that make a predictive distribution; its standard deviation is then known to 5 %.
const DRAWS: usize = 200;
const MILLIMETRE: f64 = 1e3;

/// Predicted mean and standard deviation, without noise, of every difference: rows pairs, columns monitors [m].
struct Predictive {
    mean: DMatrix<f64>,
    sigma: DMatrix<f64>,
    /// 2.5 % and 97.5 % quantiles.
    outer: [DMatrix<f64>; 2],
}

/// One difference that was read.
struct Checked {
    monitor: usize,
    /// Measured less predicted [m].
    deviation: f64,
    /// Where it lies in its predictive distribution, 0..1.
    rank: f64,
}

/// Predict what the other subsets of the widest differences hold from the posterior of the first; none without such.
///
/// # Errors
/// [`StudyError`].
pub fn study(sampling: &mut Sampling, subsets: &Subsets) -> Result<Option<Section>, StudyError> {
    let seed = sampling.seed();
    let sampling = &*sampling;
    let Some((known, fitted)) = subsets.first() else { return Ok(None) };
    let differences = subsets.words(known.kind);
    let test = &unseen(subsets, known);
    if test.pairs.is_empty() {
        return Ok(None);
    }
    let posterior = predictive(sampling, test, &posterior_draws(fitted))?;
    let prior = predictive(sampling, test, &prior_draws(sampling, seed)?)?;
    let checked = check(sampling, test, &posterior);
    let mut figures = Vec::new();
    for plane in [Plane::X, Plane::Y] {
        figures.extend(deviations(sampling, test, plane, &differences, &posterior, &prior));
    }
    let curve = |checked: &[&Checked]| calibration(checked);
    let all: Vec<&Checked> = checked.iter().collect();
    let axes = Axes::new(
        "Calibration, all monitors",
        "stated probability of the central band [1]",
        "share of differences in it [1]",
    );
    figures.push(("How often the posterior's central bands hold the differences that were not fitted; shaded: 95 % of what chance allows.".into(), Figure::lines(&axes.compared(Reference::Diagonal), &curve(&all))));
    let panel = |(b, name): (usize, &String)| Panel {
        name: name.clone(),
        series: curve(&checked.iter().filter(|c| c.monitor == b).collect::<Vec<_>>()),
    };
    let names = sampling.campaign().ring.monitor_names();
    let axes = Axes::new("Calibration of each monitor", "stated probability [1]", "share in it [1]")
        .compared(Reference::Diagonal);
    figures.push((
        "The same for each monitor.".into(),
        Figure::small_multiples(&axes, &names.iter().enumerate().map(panel).collect::<Vec<_>>()),
    ));
    figures.push(twin_error(sampling, test, fitted)?);
    let inside =
        |p: f64| all.iter().filter(|c| (2.0 * c.rank - 1.0).abs() <= p).count() as f64 / all.len().max(1) as f64;
    let rms = (all.iter().map(|c| c.deviation * c.deviation).sum::<f64>() / all.len().max(1) as f64).sqrt();
    Ok(Some(Section {
        heading: "Predictions of differences that were not fitted".into(),
        text: vec![format!(
            "The posterior of the first subset of differences {differences} predicts {} pairs of the others, of which no frame was fitted, at the \
             monitors of the plane that is kicked. {} differences: rms deviation {:.3} mm (noisy monitors included); {:.1} % lie in the \
             68 % band and {:.1} % in the 95 % band. The prior's bands are those of rings whose tunes keep a beam.",
            test.pairs.len(),
            all.len(),
            MILLIMETRE * rms,
            100.0 * inside(0.68),
            100.0 * inside(0.95)
        )],
        figures,
        ..Section::default()
    }))
}

/// Pairs of the other subsets of a kind, none of whose frames stands in `known`.
fn unseen(subsets: &Subsets, known: &Subset) -> Subset {
    let seen: Vec<usize> = known.pairs.iter().flat_map(|pair| [pair.initial, pair.last]).collect();
    let others =
        subsets.all.iter().filter(|(subset, _)| subset.kind == known.kind).flat_map(|(subset, _)| &subset.pairs);
    let mut pairs: Vec<Pair> = Vec::new();
    for pair in others.filter(|pair| !seen.contains(&pair.initial) && !seen.contains(&pair.last)) {
        if !pairs.contains(pair) {
            pairs.push(*pair);
        }
    }
    Subset { kind: known.kind, pairs }
}

fn posterior_draws(fitted: &Sampled) -> Vec<Vec<f64>> {
    let every = (fitted.vars.nrows() / DRAWS).max(1);
    fitted.vars.row_iter().step_by(every).map(|row| row.iter().copied().collect()).collect()
}

fn prior_draws(sampling: &Sampling, seed: u64) -> Result<Vec<Vec<f64>>, VarsError> {
    let ring = &sampling.campaign().ring;
    simulate::seeds(seed).take(DRAWS).map(|seed| simulate::vars(ring, false, seed)).collect()
}

fn predictive(sampling: &Sampling, subset: &Subset, draws: &[Vec<f64>]) -> Result<Predictive, OrbitError> {
    let mut predictions = Vec::new();
    for vars in draws {
        predictions.push(differences(sampling, &subset.pairs, vars)?);
    }
    let n = predictions.len() as f64;
    let mean = predictions.iter().sum::<DMatrix<f64>>() / n;
    let square = predictions.iter().map(|p| (p - &mean).map(|d| d * d)).sum::<DMatrix<f64>>() / (n - 1.0);
    let outer = [0.025, 0.975].map(|p| {
        DMatrix::from_fn(mean.nrows(), mean.ncols(), |i, b| {
            let mut values: Vec<f64> = predictions.iter().map(|one| one[(i, b)]).collect();
            values.sort_by(f64::total_cmp);
            quantile(&values, p)
        })
    });
    Ok(Predictive { mean, sigma: square.map(f64::sqrt), outer })
}

/// What a ring with these vars makes of frame pairs [m]: rows pairs, columns monitors.
fn differences(sampling: &Sampling, pairs: &[Pair], vars: &[f64]) -> Result<DMatrix<f64>, OrbitError> {
    let params: Vec<f64> = vars.iter().map(|var| var.ln()).collect();
    let response = sampling.twin.predict(&sampling.reduced.strength(&params))?.response;
    let rows: Vec<_> = pairs
        .iter()
        .map(|pair| {
            (&response * (sampling.reduced.drive(pair.last) - sampling.reduced.drive(pair.initial))).transpose()
        })
        .collect();
    Ok(DMatrix::from_rows(&rows))
}

fn difference(sampling: &Sampling, pair: &Pair, b: usize) -> Option<f64> {
    Some(sampling.reduced.reading(pair.last, b)? - sampling.reduced.reading(pair.initial, b)?)
}

/// Monitors of a plane.
fn monitors(sampling: &Sampling, plane: Plane) -> Range<usize> {
    let (horizontal, all) = (sampling.campaign().ring.horizontal_monitors(), sampling.campaign().monitors());
    if plane == Plane::X { 0..horizontal } else { horizontal..all }
}

/// The plane that a pair's corrector kicks in.
fn kicked(sampling: &Sampling, pair: &Pair) -> Plane {
    let correctors = &sampling.campaign().ring.correctors;
    let k = sampling.reduced.drive(pair.last) - sampling.reduced.drive(pair.initial);
    correctors[k.rows(0, correctors.len()).icamax()].plane
}

fn check(sampling: &Sampling, subset: &Subset, predictive: &Predictive) -> Vec<Checked> {
    let mut checked = Vec::new();
    for (i, pair) in subset.pairs.iter().enumerate() {
        // across the planes a twin without coupling predicts nothing, which would be checked in vain
        for monitor in monitors(sampling, kicked(sampling, pair)) {
            let Some(measured) = difference(sampling, pair, monitor) else { continue };
            let deviation = measured - predictive.mean[(i, monitor)];
            let sigma = predictive.sigma[(i, monitor)].hypot(sampling.reduced.noise(monitor) * 2f64.sqrt());
            let rank = Normal::standard().cdf(deviation / sigma);
            checked.push(Checked { monitor, deviation, rank });
        }
    }
    checked
}

/// Share of differences in central bands of stated probability, and what chance allows: 95 % of the binomial.
fn calibration(checked: &[&Checked]) -> Vec<Series> {
    let n = checked.len().max(1) as f64;
    let stated: Vec<f64> = (1..20).map(|i| 0.05 * f64::from(i)).collect();
    let share = |p: &f64| checked.iter().filter(|c| (2.0 * c.rank - 1.0).abs() <= *p).count() as f64 / n;
    let band = |p: &f64| {
        let sigma = (p * (1.0 - p) / n).sqrt();
        ((p - 1.96 * sigma).max(0.0), (p + 1.96 * sigma).min(1.0))
    };
    let shares = stated.iter().map(share).collect();
    let chance =
        Series::line("what chance allows", stated.clone(), stated.clone()).within(stated.iter().map(band).collect());
    vec![chance, Series::line("differences not fitted", stated, shares)]
}

/// Deviations from the posterior mean along the ring for the first corrector of a plane, with the bands of both.
fn deviations(
    sampling: &Sampling,
    subset: &Subset,
    plane: Plane,
    differences: &str,
    posterior: &Predictive,
    prior: &Predictive,
) -> Option<(String, Figure)> {
    let ring = &sampling.campaign().ring;
    let monitors = monitors(sampling, plane);
    let (i, pair) = subset.pairs.iter().enumerate().find(|(_, pair)| kicked(sampling, pair) == plane)?;
    let (corrector, _) = sampling.campaign().recording.rows[pair.last].correctors.first()?;
    let corrector = ring.corrector_name(*corrector);
    let names: Vec<String> = ring.monitor_names()[monitors.clone()].to_vec();
    let x: Vec<f64> = (0..names.len()).map(|b| b as f64).collect();
    let noise = |b: usize| sampling.reduced.noise(b) * 2f64.sqrt();
    let band = |label: &str, p: &Predictive| {
        let centre: Vec<f64> =
            monitors.clone().map(|b| MILLIMETRE * (p.mean[(i, b)] - posterior.mean[(i, b)])).collect();
        // quantiles of the draws, their distances from the mean in quadrature with the noise
        let bound = |b: usize, side: usize, sign: f64| {
            let away = (p.outer[side][(i, b)] - p.mean[(i, b)]).hypot(1.96 * noise(b));
            MILLIMETRE * (p.mean[(i, b)] + sign * away - posterior.mean[(i, b)])
        };
        let bounds = monitors.clone().map(|b| (bound(b, 0, -1.0), bound(b, 1, 1.0))).collect();
        Series::line(label, x.clone(), centre).within(bounds)
    };
    let measured = monitors
        .clone()
        .map(|b| difference(sampling, pair, b).map_or(f64::NAN, |d| MILLIMETRE * (d - posterior.mean[(i, b)])));
    let series = [
        band("prior of rings that hold beam, 95 %", prior),
        band("posterior, 95 %", posterior),
        Series::points("measured", x.clone(), measured.collect()),
    ];
    let title = format!("Corrector {corrector}: deviation from the posterior mean");
    let axes = Axes::new(&title, "monitor", "deviation of x or y [mm]").named(&names).compared(Reference::Level(0.0));
    Some((
        format!(
            "Difference {differences} of corrector {corrector}, not fitted, with prior and posterior predictive bands."
        ),
        Figure::lines(&axes, &series),
    ))
}

/// Rms deviation at each monitor, by the design and by the point estimates.
fn twin_error(sampling: &Sampling, subset: &Subset, fitted: &Sampled) -> Result<(String, Figure), OrbitError> {
    let names = sampling.campaign().ring.monitor_names();
    let rms = |vars: &[f64]| -> Result<Vec<f64>, OrbitError> {
        let predicted = differences(sampling, &subset.pairs, vars)?;
        let at = |b: usize| {
            let squares: Vec<f64> = subset
                .pairs
                .iter()
                .enumerate()
                .filter_map(|(i, pair)| Some((difference(sampling, pair, b)? - predicted[(i, b)]).powi(2)))
                .collect();
            MILLIMETRE * (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
        };
        Ok((0..names.len()).map(at).collect())
    };
    let x: Vec<f64> = (0..names.len()).map(|b| b as f64).collect();
    let noise = (0..names.len()).map(|b| MILLIMETRE * sampling.reduced.noise(b) * 2f64.sqrt()).collect();
    let series = [
        Series::points("design (vars = 1)", x.clone(), rms(&vec![1.0; fitted.summary.len()])?),
        Series::points("point estimates", x.clone(), rms(&fitted.mean())?),
        Series::line("noise of a difference", x, noise),
    ];
    let axes = Axes::new("Error of the twin at each monitor", "monitor", "rms deviation [mm]").named(&names);
    Ok((
        "Error of the twin with and without the point estimates, on differences that were not fitted.".into(),
        Figure::lines(&axes, &series),
    ))
}
