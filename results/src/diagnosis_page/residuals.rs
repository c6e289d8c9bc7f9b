//! Residuals of the readings, setting by setting.

use diagnosis::{Data, Diagnosis, FitError, Fitted};
use nalgebra::{DMatrix, DVector};
use report::{Axes, Figure, Map, Section};
use twin::Plane;

use super::partial::Partial;

/// One reading less its prediction.
#[derive(Debug, Clone, Copy)]
pub struct Residual {
    /// Pool of frames in which it was read.
    pub pool: usize,
    /// Monitor that was read.
    pub monitor: usize,
    /// Corrector that was powered, and the sign of its kick.
    pub kick: Option<(usize, f64)>,
    /// True if corrector and monitor are of one plane.
    pub in_plane: bool,
    /// Time, from -1 to 1.
    pub time: f64,
    /// Noise of the mean over the pool [um].
    pub noise: f64,
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

impl Residual {
    /// Whitened numbers of some data as residuals, those of the tunes left out.
    pub fn all(data: &Data, whitened: &DVector<f64>) -> Vec<Self> {
        let settings = &data.settings;
        let horizontal: Vec<bool> = data.ring.correctors.iter().map(|c| c.plane == Plane::X).collect();
        let planes: Vec<bool> = data.ring.monitors_read().map(|m| m.plane == Plane::X).collect();
        let of = |(((pool, monitor), noise), &value): (((usize, usize), f64), &f64)| {
            if monitor >= planes.len() {
                return None;
            }
            let kick = settings.kick(pool);
            let in_plane = kick.is_some_and(|(c, _)| horizontal[c] == planes[monitor]);
            Some(Self { pool, monitor, kick, in_plane, time: data.drives.time[pool], noise: noise * 1e6, value })
        };
        data.places().into_iter().zip(data.noise_of_means()).zip(whitened.iter()).filter_map(of).collect()
    }
}

impl Residuals {
    /// Of a fit.
    pub fn of(name: &'static str, data: &Data, fitted: &Fitted) -> Self {
        Self { name, all: Residual::all(fitted.data(data), &fitted.residual) }
    }
}

/// How the residuals of a corrector's frames are summed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Parity {
    /// With the sign of the kick.
    Odd,
    /// As they are.
    Even,
    /// With the sign of the kick and the time.
    Drift,
}

impl Parity {
    const ALL: [Self; 3] = [Self::Odd, Self::Even, Self::Drift];

    fn weight(self, one: &Residual, sign: f64) -> f64 {
        match self {
            Self::Odd => sign / one.noise,
            Self::Even => one.noise.recip(),
            Self::Drift => sign * one.time / one.noise,
        }
    }

    fn words(self) -> &'static str {
        match self {
            Self::Odd => "with the sign of the kick",
            Self::Even => "without regard to the sign of the kick, since the effect is even in it",
            Self::Drift => {
                "with the sign of the kick times the time from the middle of the campaign, since the effect changes in time"
            }
        }
    }

    /// Rows monitors, columns correctors: the sum in its standard deviations.
    fn sum(self, all: &[Residual], monitors: &[usize], correctors: &[usize]) -> DMatrix<f64> {
        let mut sum = DMatrix::zeros(monitors.len(), correctors.len());
        let mut squares = sum.clone();
        for one in all {
            let Some((corrector, sign)) = one.kick else { continue };
            let row = monitors.iter().position(|&b| b == one.monitor);
            let column = correctors.iter().position(|&c| c == corrector);
            if let (Some(row), Some(column)) = (row, column) {
                let weight = self.weight(one, sign);
                sum[(row, column)] += weight * one.value;
                squares[(row, column)] += weight * weight;
            }
        }
        sum.zip_map(&squares, |sum, squares: f64| if squares > 0.0 { sum / squares.sqrt() } else { f64::NAN })
    }
}

/// Least and largest limit of the colour scale [standard deviations].
const LEAST: f64 = 4.0;
const MOST: f64 = 12.0;

/// Maps without the effects, of what they do, and with them.
///
/// # Errors
/// [`FitError`].
pub fn section(diagnosis: &Diagnosis) -> Result<Section, FitError> {
    let found = &diagnosis.found;
    let bare = found.best.hypothesis.without_terms(|_| true).without_element();
    // a machine that keeps no beam without the effects has no map before
    let before = found.has_more().then(|| Partial::beyond(&found.data, &found.best, &bare)).and_then(Result::ok);
    let model = Partial::of(&found.data, &found.best, |_| false)?;
    let data = model.data;
    let (monitors, correctors) = (data.active_monitors(), data.driven_correctors());
    let pick = |names: Vec<String>, of: &[usize]| -> Vec<String> { of.iter().map(|&i| names[i].clone()).collect() };
    let rows = pick(data.ring.monitor_names(), &monitors);
    let columns = pick(data.ring.corrector_names(), &correctors);
    let power = |parity: Parity, of: &Partial| {
        let sums = parity.sum(&Residual::all(data, &of.predicted), &monitors, &correctors);
        sums.iter().filter(|value| !value.is_nan()).map(|value| value * value).sum::<f64>()
    };
    let parity = before.as_ref().map_or(Parity::Odd, |before| {
        let largest = |one: &Parity, other: &Parity| power(*one, before).total_cmp(&power(*other, before));
        Parity::ALL.into_iter().max_by(largest).unwrap_or(Parity::Odd)
    });
    let map = |name: &str, whitened: &DVector<f64>| Map {
        name: name.into(),
        values: parity.sum(&Residual::all(data, whitened), &monitors, &correctors),
    };
    let maps = match &before {
        Some(before) => vec![
            map("before: without the effects", &before.measured),
            map("what the effects should do", &before.predicted),
            map("after: with the effects", &model.left()),
        ],
        None => vec![map("the model", &model.left())],
    };
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
    let title = match (sizes.first(), sizes.last()) {
        (Some((_, before)), Some((_, after))) if sizes.len() > 1 => {
            format!(
                "The effects take the residuals of the responses from rms {before:.2} to {after:.2}; noise alone has 1"
            )
        }
        (Some((_, rms)), _) => format!("The residuals of the responses have rms {rms:.2}; noise alone has 1"),
        _ => "Residuals of the responses".into(),
    };
    let axes = Axes::new(&title, "corrector", "monitor").named(&columns);
    let figure = Figure::maps(&axes, "mean residual [its standard deviation]", limit, &rows, &maps);
    let compared = match before {
        Some(_) => {
            " Before and after are one fit: everything else is as fitted with the effects, which are taken out in the first map."
        }
        None => "",
    };
    Ok(Section {
        heading: "Residual maps".into(),
        text: vec![format!(
            "Measured less predicted readings in units of their error: those of the frames of a corrector summed {}, over the standard deviation of that sum, each \
             monitor's baseline subtracted. Noise alone has no pattern. A fault of a monitor is a row, one of a corrector a column; a fault of \
             the ring is a pattern over both, and where it couples the planes it fills the blocks that join x to V and y to H.{compared}",
            parity.words()
        )],
        figures: vec![(
            format!(
                "One square for each monitor and corrector; lines divide the planes; grey squares have no readings; where names do not fit, every second is written. Colours end at \
                 ±{limit:.0}. {}.",
                largest.join("; ")
            ),
            figure,
        )],
        ..Section::default()
    })
}
