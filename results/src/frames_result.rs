//! The result of `orbitcal frames`: as JSON and in words.

use core::fmt;
use std::path::Path;

use inference::recording::Recording;
use measured::{Calibrated, Fit, Folder, RawOrbits, calibrated};
use schemars::JsonSchema;
use serde::Serialize;
use twin::{Plane, median};

use crate::output::fill;

/// What was written. Field names are those of the command's JSON.
#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct Written {
    pub folder: String,
    pub frames: usize,
    pub monitors: usize,
    pub correctors: usize,
    pub params: usize,
    pub x: PlaneNoise,
    pub y: PlaneNoise,
    /// What the core's model leaves out of the response of the fitted ring, rms, at the mean kick.
    pub missing_um: f64,
    /// Strengths by the fit of all orbits at once, to compare those of `replay` with.
    pub vars: Vec<Strength>,
}

/// A param of the recording.
#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct Strength {
    pub name: String,
    pub mean: f64,
    pub sigma: f64,
}

/// Medians over the monitors of a plane.
#[derive(Debug, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct PlaneNoise {
    /// Of one orbit, with what the model misses.
    pub sigma_um: f64,
    /// What the orbit drifts from one pair of frames to the next; none where no monitor read two of them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub drift_um: Option<f64>,
}

impl Written {
    /// Of a recording.
    pub fn of(out: &Path, recording: &Recording, calibrated: &Calibrated, raw: &RawOrbits, missing: f64) -> Self {
        let noise = |plane: Plane| {
            let of_plane = calibrated.monitors.iter().filter(|one| one.plane == plane);
            let rows: Vec<usize> = of_plane.clone().map(|one| one.row).collect();
            PlaneNoise {
                sigma_um: 1e3 * median(of_plane.map(|one| one.sigma)).unwrap_or(0.0),
                drift_um: raw.drift(&rows).map(|drift| 1e3 * drift),
            }
        };
        Self {
            folder: out.display().to_string(),
            frames: recording.rows.len(),
            monitors: calibrated.monitors.len(),
            correctors: calibrated.correctors.len(),
            params: 0,
            x: noise(Plane::X),
            y: noise(Plane::Y),
            missing_um: 1e6 * missing,
            vars: Vec::new(),
        }
    }

    /// With the strengths of the fit that has calibrated the instruments. Those of dipoles are none of the recording's params.
    #[must_use]
    pub fn with_vars(self, folder: &Folder, fitted: &Fit) -> Self {
        let is_estimated = |group: &[usize]| group.iter().all(|&row| folder.lattice[row].bend == 0.0);
        let vars = fitted.groups[0].iter().enumerate().filter(|(_, group)| is_estimated(group));
        let vars: Vec<Strength> = vars
            .map(|(at, group)| Strength {
                name: calibrated::param(folder, group),
                mean: fitted.values[at],
                sigma: fitted.sigma(at),
            })
            .collect();
        Self { params: vars.len(), vars, ..self }
    }
}

impl fmt::Display for Written {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { folder, frames, monitors, correctors, params, x, y, missing_um, .. } = self;
        let drift = |plane: &PlaneNoise| plane.drift_um.map_or("an unknown length".into(), |um| format!("{um:.1} um"));
        let text = format!(
            "{frames} frames of {monitors} readings and {correctors} correctors, {params} params. One reading: {:.1} um in x, {:.1} um in y \
             with what the model misses. The orbit drifts by {} and {} from one pair of frames to the next. The core's model is off the \
             fitted ring by {missing_um:.2} um rms.",
            x.sigma_um,
            y.sigma_um,
            drift(x),
            drift(y)
        );
        writeln!(f, "{}\n", fill(&text))?;
        // a pair is two frames; where one plane drifts more its monitors are noisier too
        let drifts = [x.drift_um, y.drift_um].into_iter().flatten();
        let walk = drifts.reduce(f64::min).unwrap_or(0.0) / 2f64.sqrt();
        write!(
            f,
            "orbitcal replay {folder} --machine {folder}/machine.json --model-file {folder}/model --baseline-walk {walk:.1}"
        )
    }
}
