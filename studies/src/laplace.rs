//! Laplace beside NUTS: the core's Gaussian (the device's, bit for bit), and those of the host with the surrogate and the twin.

use inference::LaplaceError;
use inference::{Laplace, Posterior, Prior, Readings, ResponseModel, TuneUse, stream};
use nalgebra::{DMatrix, DVector};
use report::{Axes, Figure, Reference, Section, Series, Table};
use schemars::JsonSchema;
use serde::Serialize;
use statrs::distribution::{ChiSquared, ContinuousCDF};

use super::sampled::{correlation, largest_difference};
use super::sampling::Sampling;
use super::{Sampled, StudyError};

/// One Laplace approximation beside the reference.
#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct Comparison {
    /// `green-on-device`, `green-on-host` or `twin`.
    pub name: &'static str,
    /// Each var.
    pub vars: Vec<LaplaceRow>,
    /// Largest difference of a correlation.
    pub correlation_difference: f64,
    /// Mean squared Mahalanobis distance of the reference's draws; the number of vars if they are its own.
    pub mahalanobis_mean: f64,
    /// Largest distance between the distribution of these and chi-square.
    pub mahalanobis_distance: f64,
}

/// One var of a comparison.
#[derive(Debug, Clone, Serialize, JsonSchema)]
pub struct LaplaceRow {
    /// Name.
    pub name: String,
    /// Mean less that of the reference, in its standard deviations.
    pub shift: f64,
    /// Standard deviation over that of the reference.
    pub ratio: f64,
    /// Monte Carlo error of the shift.
    pub shift_error: f64,
    /// Monte Carlo error of the ratio.
    pub ratio_error: f64,
}

/// A Gaussian of some coordinates of the vars, and the moments of the vars under it.
struct Approximation {
    name: &'static str,
    mean: Vec<f64>,
    sigma: Vec<f64>,
    correlation: DMatrix<f64>,
    /// Squared Mahalanobis distances of draws of the vars.
    distances: Vec<f64>,
}

/// Compare all three, or those that there are: a ring that is larger than the core's tables has only the twin's.
///
/// # Errors
/// [`StudyError`].
pub fn study(sampling: &Sampling, reference: &Sampled) -> Result<(Section, Vec<Comparison>), StudyError> {
    let (on_device, why) = match of_core(sampling, reference) {
        Ok(core) => (Some(core), None),
        Err(StudyError::Stream(error)) => (None, Some(format!("The core's is left out: {error}."))),
        Err(error) => return Err(error),
    };
    let green = ResponseModel::green(&sampling.campaign().ring).ok();
    let on_host = green.map(|green| of_host(sampling, green, "green-on-host", reference)).transpose()?;
    let twin = of_host(sampling, sampling.twin.clone(), "twin", reference)?;
    let approximations = on_device.into_iter().chain(on_host).chain([twin]);
    let names = sampling.names();
    let comparisons: Vec<Comparison> = approximations.map(|one| compare(&names, reference, &one)).collect();
    let x: Vec<f64> = (0..names.len()).map(|i| i as f64).collect();
    let of = |pick: fn(&LaplaceRow) -> f64| -> Vec<Series> {
        let series = |c: &Comparison| Series::points(c.name, x.clone(), c.vars.iter().map(pick).collect());
        comparisons.iter().map(series).collect()
    };
    let shifts = Axes::new("Mean of Laplace less that of NUTS", "quadrupole", "shift [sigma]").named(&names);
    let ratios = Axes::new("Standard deviation of Laplace over that of NUTS", "quadrupole", "ratio [1]").named(&names);
    let what = "green-on-device is the result of the no_std core, the same bits as on the chip; green-on-host the Laplace approximation \
                with the core's tables in f64, and twin that of the exact twin, both in coordinates without bounds. The reference is NUTS \
                on the twin. Joint test: squared Mahalanobis distances of the reference's draws under each Gaussian, which follow \
                chi-square with one degree of freedom a var if the Gaussian is the posterior. The core counts measured tunes as readings, \
                the others do not.";
    let section = Section {
        heading: "Laplace against NUTS".into(),
        text: core::iter::once(what.into()).chain(why).collect(),
        figures: vec![
            (
                "Shift of each mean.".into(),
                Figure::lines(&shifts.compared(Reference::Level(0.0)), &of(|row| row.shift)),
            ),
            (
                "Ratio of each width.".into(),
                Figure::lines(&ratios.compared(Reference::Level(1.0)), &of(|row| row.ratio)),
            ),
        ],
        tables: vec![overview(&comparisons), each_var(&names, &comparisons)],
    };
    Ok((section, comparisons))
}

/// The core's final result.
fn of_core(sampling: &Sampling, reference: &Sampled) -> Result<Approximation, StudyError> {
    let campaign = sampling.campaign();
    let mut core = stream::estimator(&campaign.ring, &campaign.recording, stream::Walk::NONE)?;
    let mut last = None;
    stream::replay(&mut core, &campaign.recording, |_, estimate| last = Some(estimate.clone()))?;
    let n = reference.summary.len();
    let last = last.expect("a recording has a frame");
    let covariance = DMatrix::from_fn(n, n, |i, j| f64::from(core.covariance(i, j)));
    let centre = DVector::from_fn(n, |i, _| f64::from(last.centre[i]));
    let factor = covariance.clone().cholesky();
    let degenerate = || StudyError::Laplace { run: "green-on-device".to_owned(), source: LaplaceError::Degenerate };
    let precision = factor.ok_or_else(degenerate)?.inverse();
    let distance = |row: nalgebra::RowDVector<f64>| {
        let away = row.transpose().map(f64::ln) - &centre;
        away.dot(&(&precision * &away))
    };
    Ok(Approximation {
        name: "green-on-device",
        mean: last.mean.iter().map(|v| f64::from(*v)).collect(),
        sigma: last.sigma.iter().map(|v| f64::from(*v)).collect(),
        correlation: correlation(&covariance),
        distances: reference.vars.row_iter().map(|row| distance(row.into_owned())).collect(),
    })
}

/// The Laplace approximation of a model on the host.
fn of_host(
    sampling: &Sampling,
    model: ResponseModel,
    name: &'static str,
    reference: &Sampled,
) -> Result<Approximation, StudyError> {
    let readings = Readings::of_frames(&sampling.reduced, &model, TuneUse::LeftOut);
    let posterior = Posterior::new(model, readings, Prior::from_ring(&sampling.campaign().ring));
    let laplace = posterior
        .laplace(&sampling.reduced.fit.map_params)
        .map_err(|source| StudyError::Laplace { run: name.to_owned(), source })?;
    let (mean, sigma) = moments(&posterior, &laplace);
    let distance = |row: nalgebra::RowDVector<f64>| {
        let params: Vec<f64> = row.iter().map(|var| var.ln()).collect();
        let away = posterior.coordinates.unbounded(&params) - &laplace.centre;
        laplace.factor.solve_lower_triangular(&away).map_or(f64::INFINITY, |z| z.norm_squared())
    };
    Ok(Approximation {
        name,
        mean,
        sigma,
        correlation: correlation(&(&laplace.factor * laplace.factor.transpose())),
        distances: reference.vars.row_iter().map(|row| distance(row.into_owned())).collect(),
    })
}

/// Mean and standard deviation of each var under a Laplace approximation.
///
/// The coordinate without bounds is normal; its map to the var is integrated over ±8 standard deviations.
fn moments(posterior: &Posterior, laplace: &Laplace) -> (Vec<f64>, Vec<f64>) {
    const POINTS: i32 = 400;
    let one = |(i, coordinate): (usize, &inference::Coordinate)| {
        let (centre, sigma) = (laplace.centre[i], laplace.factor.row(i).norm());
        let (mut weight, mut first, mut second) = (0.0, 0.0, 0.0);
        for k in -POINTS..=POINTS {
            let z = 8.0 * f64::from(k) / f64::from(POINTS);
            let (w, var) = ((-0.5 * z * z).exp(), coordinate.theta(centre + sigma * z).exp());
            (weight, first, second) = (weight + w, first + w * var, second + w * var * var);
        }
        let mean = first / weight;
        (mean, (second / weight - mean * mean).max(0.0).sqrt())
    };
    posterior.coordinates.each().iter().enumerate().map(one).unzip()
}

fn compare(names: &[String], reference: &Sampled, one: &Approximation) -> Comparison {
    let row = |(i, name): (usize, &String)| {
        let s = &reference.summary[i];
        LaplaceRow {
            name: name.clone(),
            shift: (one.mean[i] - s.mean) / s.sd,
            ratio: one.sigma[i] / s.sd,
            shift_error: s.mcse_mean / s.sd,
            // of a standard deviation from n independent draws of a normal
            ratio_error: (0.5 / s.ess_bulk.min(s.ess_tail)).sqrt(),
        }
    };
    let chi_square = ChiSquared::new(one.mean.len() as f64).expect("there are vars");
    let mut sorted = one.distances.clone();
    sorted.sort_by(f64::total_cmp);
    let n = sorted.len() as f64;
    let away = |(i, d): (usize, &f64)| (chi_square.cdf(*d) - (i as f64 + 0.5) / n).abs();
    Comparison {
        name: one.name,
        vars: names.iter().enumerate().map(row).collect(),
        correlation_difference: largest_difference(&one.correlation, &reference.correlation()),
        mahalanobis_mean: sorted.iter().sum::<f64>() / n,
        mahalanobis_distance: sorted.iter().enumerate().map(away).fold(0.0, f64::max),
    }
}

fn overview(comparisons: &[Comparison]) -> Table {
    let row = |c: &Comparison| {
        let shift = c.vars.iter().map(|v| v.shift.abs()).fold(0.0, f64::max);
        let low = c.vars.iter().map(|v| v.ratio).fold(f64::INFINITY, f64::min);
        let high = c.vars.iter().map(|v| v.ratio).fold(0.0, f64::max);
        vec![
            c.name.to_owned(),
            format!("{shift:.3}"),
            format!("{low:.3}..{high:.3}"),
            format!("{:.3}", c.correlation_difference),
            format!("{:.2}", c.mahalanobis_mean),
            format!("{:.3}", c.mahalanobis_distance),
        ]
    };
    let header = ["Laplace of", "shift [sigma]", "sigma ratio", "correlation", "mean distance²", "from chi-square"];
    Table {
        caption: "Each approximation against NUTS on the twin: largest shift of a mean, range of the sigma ratios, largest difference of \
                  a correlation, mean squared Mahalanobis distance (one a var expected), and the largest distance of its \
                  distribution from chi-square."
            .into(),
        header: header.map(str::to_owned).to_vec(),
        rows: comparisons.iter().map(row).collect(),
    }
}

fn each_var(names: &[String], comparisons: &[Comparison]) -> Table {
    let cells = |c: &Comparison, i: usize| [format!("{:+.3}", c.vars[i].shift), format!("{:.3}", c.vars[i].ratio)];
    let row = |(i, name): (usize, &String)| {
        core::iter::once(name.clone()).chain(comparisons.iter().flat_map(|c| cells(c, i))).collect()
    };
    let columns = comparisons.iter().flat_map(|c| [format!("{}: shift [sigma]", c.name), "sigma ratio".to_owned()]);
    Table {
        caption: "Each var: mean less that of NUTS in its standard deviations, and ratio of the standard deviations."
            .into(),
        header: core::iter::once("var".to_owned()).chain(columns).collect(),
        rows: names.iter().enumerate().map(row).collect(),
    }
}
