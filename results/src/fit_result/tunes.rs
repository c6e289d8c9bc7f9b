//! Tunes in a result: the model's, and beside them the measured ones.

use core::fmt;

use inference::TUNE_CALIBRATION;
use inference::{FittedTune, Meter, Recording};
use schemars::JsonSchema;
use serde::Serialize;
use twin::{Hold, Optics, Ring};

use crate::record::EstimateRecord;

/// Standard deviations between a measured tune and the model's that noise does not explain.
const DISAGREE: f64 = 4.0;
/// Uncertainty of a measured tune, in calibration errors of a meter, above which it is its readings that are at fault.
const SCATTERS: f64 = 30.0;

/// Tunes of the twin at the means, at the recording's mean supply currents.
#[derive(Debug, Clone, Copy, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct Tunes {
    pub x: f64,
    pub y: f64,
    /// Standard deviations, of a fit.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub sigma: Option<TunesSigma>,
}

/// Standard deviations of both tunes.
#[derive(Debug, Clone, Copy, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct TunesSigma {
    pub x: f64,
    pub y: f64,
}

impl Tunes {
    /// Tunes of a fit and, where it has optics, their standard deviations.
    pub fn of_fit([x, y]: [f64; 2], sigma: Option<twin::Tunes>) -> Self {
        Self { x, y, sigma: sigma.map(|sigma| TunesSigma { x: sigma.x, y: sigma.y }) }
    }
}

impl From<twin::Tunes> for Tunes {
    fn from(tunes: twin::Tunes) -> Self {
        Self { x: tunes.x, y: tunes.y, sigma: None }
    }
}

impl fmt::Display for Tunes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.sigma {
            Some(sigma) => write!(f, "{:.4} ± {:.4}, {:.4} ± {:.4}", self.x, sigma.x, self.y, sigma.y),
            None => write!(f, "{:.4} {:.4}", self.x, self.y),
        }
    }
}

/// Tunes as the meter measured them, with the model's integer parts; none without enough readings of it.
#[derive(Debug, Clone, Copy, Default, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct TunesMeasured {
    #[serde(skip_serializing_if = "Option::is_none")]
    pub x: Option<TuneMeasured>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub y: Option<TuneMeasured>,
}

/// Mean of what the meter says of one tune, and its standard deviation, the meter's calibration included.
#[derive(Debug, Clone, Copy, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct TuneMeasured {
    pub mean: f64,
    pub sigma: f64,
}

impl TunesMeasured {
    /// What the meter says of a recording, with the integer parts of the model's.
    pub fn of_recording(recording: &Recording, model: Option<[f64; 2]>) -> Self {
        let one = |plane: usize| {
            let meter = Meter::from_recording(recording, plane)?;
            Some(TuneMeasured { mean: meter.near(model.map_or(0.0, |tunes| tunes[plane])), sigma: meter.sigma })
        };
        Self { x: one(0), y: one(1) }
    }

    /// What is wrong with the model's, if anything is.
    pub(super) fn remark(&self, model: &Tunes) -> Option<String> {
        let largest = [self.x, self.y].into_iter().flatten().map(|tune| tune.sigma).fold(0.0, f64::max);
        if largest > SCATTERS * TUNE_CALIBRATION {
            return Some(format!("the readings of the tune meter scatter: their mean is known to {largest:.4} only"));
        }
        let away = |plane: &str, measured: Option<TuneMeasured>, model: f64| {
            let pull = measured.map(|tune| (tune.mean - model) / tune.sigma)?;
            (pull.abs() > DISAGREE).then(|| format!("tune {plane} by {pull:+.1} standard deviations"))
        };
        let both = [away("x", self.x, model.x), away("y", self.y, model.y)];
        let both: Vec<String> = both.into_iter().flatten().collect();
        (!both.is_empty()).then(|| {
            format!("measured tunes differ from the model's, {}: a wrong kick constant does that", both.join(" and "))
        })
    }
}

impl fmt::Display for TunesMeasured {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let word = |tune: Option<TuneMeasured>| {
            tune.map_or_else(|| "-".into(), |tune| format!("{:.4} ± {:.4}", tune.mean, tune.sigma))
        };
        match (self.x, self.y) {
            (None, None) => f.write_str("not measured"),
            (x, y) => write!(f, "measured {}, {}", word(x), word(y)),
        }
    }
}

pub(super) fn measured(tune: &FittedTune) -> Option<TuneMeasured> {
    tune.measured.map(|(mean, sigma)| TuneMeasured { mean, sigma })
}

/// Tunes of the twin at a core's means and at these supplies, `ln` of their factors; none if that ring is unstable.
pub(super) fn tunes(ring: &Ring, last: &EstimateRecord, supplies: &[f64]) -> Option<Tunes> {
    let params: Vec<f64> = last.mean.iter().map(|mean| f64::from(*mean).ln()).collect();
    let ring = ring.with_strengths(&ring.strengths(&params, supplies));
    let tunes = Optics::of(&ring, Hold::Momentum { delta: 0.0 }).ok()?.tunes().ok()?;
    Some(tunes.into())
}
