//! Tunes measured against those of the model without and with an effect.

use core::ops::RangeInclusive;

use diagnosis::{Data, Finding, FitError, Fitted, capitalised};
use inference::TUNE_CALIBRATION;
use report::{Axes, Figure, Series};

use super::partial::{Partial, ends};

/// Stretches of time.
const STRETCHES: usize = 8;

/// What a model says of a tune: a label, and its values at the start and at the end of the campaign.
struct Predicted(String, RangeInclusive<f64>);

/// One figure for each plane in which tunes count, for a finding.
///
/// # Errors
/// [`FitError`].
pub fn figures(finding: &Finding, partial: &Partial) -> Result<Vec<(String, Figure)>, FitError> {
    let (machine, drives) = partial.fitted.machine(partial.data, 0)?;
    let with = ends(&machine, &drives)?;
    let of_plane = |plane: usize| {
        let models = [
            Predicted("model without the effect".into(), partial.tunes[plane].clone()),
            Predicted("model with it".into(), with[plane].clone()),
        ];
        figure(partial.data, partial.fitted, plane, &models, &capitalised(&finding.phrase))
    };
    [0, 1].into_iter().filter_map(|plane| of_plane(plane).transpose()).collect()
}

/// The same of the model alone.
///
/// # Errors
/// [`FitError`].
pub fn of_model(data: &Data, fitted: &Fitted, what: &str) -> Result<Vec<(String, Figure)>, FitError> {
    let (machine, drives) = fitted.machine(data, 0)?;
    let ends = ends(&machine, &drives)?;
    let of_plane = |plane: usize| figure(data, fitted, plane, &[Predicted("model".into(), ends[plane].clone())], what);
    [0, 1].into_iter().filter_map(|plane| of_plane(plane).transpose()).collect()
}

fn figure(
    data: &Data,
    fitted: &Fitted,
    plane: usize,
    models: &[Predicted],
    what: &str,
) -> Result<Option<(String, Figure)>, FitError> {
    let Some(noise) = data.tune_noise(plane) else { return Ok(None) };
    let (symbol, of_orbit) = (["Qx", "Qy"][plane], data.tune_shift_of_orbit[plane]);
    let [x, mean, sigma] = measured(data, fitted, plane, noise)?;
    let bars = mean.iter().zip(&sigma).map(|(tune, sigma)| (tune - sigma, tune + sigma)).collect();
    let mut series = vec![Series::points("measured ± 1 σ", x, mean).within(bars)];
    for Predicted(label, range) in models {
        series.push(Series::line(label, vec![-1.0, 1.0], vec![range.start() + of_orbit, range.end() + of_orbit]));
    }
    let title = format!("{what}: {symbol} measured and predicted");
    let axes = Axes::new(&title, "time, −1 at the start to 1 at the end [1]", &format!("{symbol} [1]"));
    let caption = format!(
        "Readings of the tune meter at the mean supply currents, means over {STRETCHES} stretches of the campaign with the noise of the mean; \
         everything but the effect is as fitted in both models."
    );
    Ok(Some((caption, Figure::lines(&axes, &series))))
}

/// Time, mean tune and its standard deviation in each stretch that has readings.
fn measured(data: &Data, fitted: &Fitted, plane: usize, noise: f64) -> Result<[Vec<f64>; 3], FitError> {
    let mut sums = vec![(0.0, 0.0, 0.0); STRETCHES];
    for Reading { time, tune, readings } in readings(data, fitted, plane)? {
        let at = ((0.5 * (time + 1.0) * STRETCHES as f64) as usize).min(STRETCHES - 1);
        let (count, times, tunes) = &mut sums[at];
        *count += readings;
        *times += readings * time;
        *tunes += readings * tune;
    }
    let (mut x, mut mean, mut sigma) = (Vec::new(), Vec::new(), Vec::new());
    for (count, times, tunes) in sums.into_iter().filter(|(count, ..)| *count > 0.0) {
        x.push(times / count);
        mean.push(tunes / count);
        sigma.push(noise / count.sqrt());
    }
    Ok([x, mean, sigma])
}

/// The mean tune of a pool.
struct Reading {
    time: f64,
    tune: f64,
    readings: f64,
}

/// Measured tunes with their integer part.
fn readings(data: &Data, fitted: &Fitted, plane: usize) -> Result<Vec<Reading>, FitError> {
    let predicted = fitted.predicted(data, 0)?;
    let (column, miss) = (data.monitors() + plane, data.miss(&predicted));
    let of = |(pool, readings): (usize, f64)| Reading {
        time: data.drives.time[pool],
        tune: predicted[(pool, column)] + miss[(pool, column)] + data.tune_shift_of_orbit[plane],
        readings,
    };
    Ok(data.tune_pools(plane).into_iter().map(of).collect())
}

/// Mean measured tune, and its standard deviation with that of the meter's calibration; none without a meter.
///
/// # Errors
/// [`FitError`].
pub fn mean(data: &Data, fitted: &Fitted, plane: usize) -> Result<Option<(f64, f64)>, FitError> {
    let readings = readings(data, fitted, plane)?;
    let count: f64 = readings.iter().map(|one| one.readings).sum();
    let Some(noise) = data.tune_noise(plane).filter(|_| count > 0.0) else { return Ok(None) };
    let mean = readings.iter().map(|one| one.readings * one.tune).sum::<f64>() / count;
    Ok(Some((mean, (noise / count.sqrt()).hypot(TUNE_CALIBRATION))))
}
