//! Residuals of the readings, setting by setting.

use nalgebra::DMatrix;
use twin::Plane;

use crate::data::Data;
use crate::fit::Fitted;
use crate::settings::Settings;
use report::{Axes, Figure, Map, Section};

/// One reading less its prediction.
#[derive(Debug, Clone, Copy)]
pub struct Residual {
    /// Monitor that was read.
    pub monitor: usize,
    /// Corrector that was powered, and the sign of its kick.
    pub kick: Option<(usize, f64)>,
    /// True if corrector and monitor are of one plane.
    pub in_plane: bool,
    /// Time, from -1 to 1.
    pub time: f64,
    /// In standard deviations of its noise, the monitor's baseline subtracted.
    pub value: f64,
}

/// All residuals of a fit.
pub struct Residuals {
    /// Name of the fit.
    pub name: &'static str,
    /// One for each reading that counts.
    pub all: Vec<Residual>,
}

impl Residuals {
    /// Of a fit.
    pub fn of(name: &'static str, data: &Data, fitted: &Fitted) -> Self {
        let settings = Settings::of(&data.drives);
        let horizontal: Vec<bool> = data.ring.correctors.iter().map(|c| c.plane == Plane::X).collect();
        let planes: Vec<bool> = data.ring.monitors_read().map(|m| m.plane == Plane::X).collect();
        let places = fitted.data(data).places();
        let of = |(place, &value): (Option<(usize, usize)>, &f64)| {
            let (frame, monitor) = place?;
            let kick = settings.kick(frame);
            let in_plane = kick.is_some_and(|(c, _)| horizontal[c] == planes[monitor]);
            Some(Residual { monitor, kick, in_plane, time: data.drives.time[frame], value })
        };
        Self { name, all: places.into_iter().zip(fitted.residual.iter()).filter_map(of).collect() }
    }

    /// Rows monitors, columns correctors: mean residual that changes sign with the kick, in its standard deviations.
    fn odd(&self, monitors: &[usize], correctors: &[usize]) -> DMatrix<f64> {
        let mut sum = DMatrix::zeros(monitors.len(), correctors.len());
        let mut count = sum.clone();
        for one in &self.all {
            let Some((corrector, sign)) = one.kick else { continue };
            let row = monitors.iter().position(|&b| b == one.monitor);
            let column = correctors.iter().position(|&c| c == corrector);
            if let (Some(row), Some(column)) = (row, column) {
                sum[(row, column)] += sign * one.value;
                count[(row, column)] += 1.0;
            }
        }
        sum.zip_map(&count, |sum, count: f64| if count > 0.0 { sum / count.sqrt() } else { f64::NAN })
    }
}

/// Least and largest limit of the colour scale [standard deviations].
const LEAST: f64 = 4.0;
const MOST: f64 = 12.0;

/// Maps before and after.
pub fn section(data: &Data, residuals: &[Residuals]) -> Section {
    let (monitors, correctors) = (data.active_monitors(), data.driven_correctors());
    let pick = |names: Vec<String>, of: &[usize]| -> Vec<String> { of.iter().map(|&i| names[i].clone()).collect() };
    let rows = pick(data.ring.monitor_names(), &monitors);
    let columns = pick(data.ring.corrector_names(), &correctors);
    let maps: Vec<Map> = residuals
        .iter()
        .map(|one| Map { name: title(one.name, residuals), values: one.odd(&monitors, &correctors) })
        .collect();
    let size = |map: &Map| {
        let known: Vec<f64> = map.values.iter().copied().filter(|value| !value.is_nan()).collect();
        let rms = (known.iter().map(|v| v * v).sum::<f64>() / known.len().max(1) as f64).sqrt();
        (known.iter().fold(0.0_f64, |largest, value| largest.max(value.abs())), rms)
    };
    let sizes: Vec<(f64, f64)> = maps.iter().map(size).collect();
    let limit = sizes.iter().map(|(largest, _)| *largest).fold(0.0, f64::max).ceil().clamp(LEAST, MOST);
    let largest: Vec<String> = maps
        .iter()
        .zip(&sizes)
        .map(|(map, (largest, rms))| format!("{}: rms {rms:.2}, largest {largest:.1}", map.name))
        .collect();
    let axes = Axes::new("Residuals of the responses", "corrector", "monitor").named(&columns);
    let figure = Figure::maps(&axes, "mean residual [its standard deviation]", limit, &rows, &maps);
    Section {
        heading: "Residual maps".into(),
        text: vec![
            "Residuals of the response to each corrector: measured less predicted readings, in units of their noise, each \
             monitor's baseline subtracted, summed over the frames of a corrector with the sign of the kick and divided by the square root of their \
             number. Noise alone has rms 1 and no pattern. A fault of a monitor is a row, one of a corrector a column; a fault of \
             the ring is a pattern over both, and where it couples the planes it fills the blocks that join x to V and y to H."
                .into(),
        ],
        figures: vec![(
            format!(
                "One square for each monitor and corrector; lines divide the planes; grey squares have no readings; where names do not fit, every second is written. Colours end at \
                 ±{limit:.0}. {}.",
                largest.join("; ")
            ),
            figure,
        )],
        ..Section::default()
    }
}

/// Name of a fit on the page.
pub fn title(name: &str, all: &[Residuals]) -> String {
    match (name, all.len()) {
        (_, 1) => "the model".into(),
        ("before", _) => "before: without any effect".into(),
        _ => "after: with the effects found".into(),
    }
}
