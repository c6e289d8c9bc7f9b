//! `orbitcal response`: how the twin's orbit responds to every corrector.

use core::fmt;
use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::DMatrix;
use serde::Serialize;
use twin::{EffectError, Machine, MachineResponse, Rf, Ring};

use super::{CommandError, check_outputs, deliver, machine};
use crate::cli::Response;
use crate::output::{self, table};

#[derive(Serialize)]
struct ResponseResult {
    machine: String,
    effects: Vec<String>,
    bpm: Vec<String>,
    correctors: Vec<String>,
    response_x_m_per_rad: Vec<Vec<f64>>,
    response_y_m_per_rad: Vec<Vec<f64>>,
    qx: f64,
    qy: f64,
    gamma_tr: f64,
    dispersion_x: Vec<f64>,
    /// Horizontal correctors; they come first.
    #[serde(skip)]
    horizontal: usize,
}

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Response) -> Result<(), CommandError> {
    check_outputs([options.common.json.as_deref()])?;
    let mut ring = machine(options.common.machine.as_deref())?;
    if let Some(path) = &options.vars {
        ring = ring.with_vars(&vars(path, &ring)?);
    }
    let input = |error: EffectError| CommandError::Input(error.to_string());
    let effects = options.effects.iter().map(|effect| effect.resolve(&ring)).collect::<Result<Vec<_>, _>>();
    let effects = effects.map_err(input)?;
    let machine = Machine::new(ring.clone(), Rf::from(options.rf), &effects).map_err(input)?;
    let response = machine.response().map_err(|error| CommandError::Input(format!("{}: {error}", ring.name)))?;
    let effects = effects.iter().map(|effect| effect.text(&ring).to_string()).collect();
    deliver(&options.common, &ResponseResult::of(&ring, effects, &response))
}

/// Factor of every quadrupole: those in the file, 1 for the others.
pub(super) fn vars(path: &Path, ring: &Ring) -> Result<Vec<f64>, CommandError> {
    let wrong = |what: String| CommandError::Input(format!("{}: {what}", path.display()));
    let text = std::fs::read_to_string(path).map_err(|e| wrong(twin::unreadable(&e)))?;
    let file: BTreeMap<String, f64> = serde_json::from_str(&text).map_err(|e| wrong(e.to_string()))?;
    by_name(&file, ring).map_err(wrong)
}

/// Factor of every quadrupole: those that are named, 1 for the others.
///
/// # Errors
/// What is wrong with them.
pub fn by_name(vars: &BTreeMap<String, f64>, ring: &Ring) -> Result<Vec<f64>, String> {
    let names = ring.var_names();
    if let Some(unknown) = vars.keys().find(|name| !names.contains(name)) {
        return Err(format!("expected a quadrupole of {}, found {unknown:?}", ring.name));
    }
    if let Some((name, value)) = vars.iter().find(|(_, value)| !(0.5..=1.5).contains(*value)) {
        return Err(format!("var {name}: expected 0.5 to 1.5, found {value}"));
    }
    Ok(names.iter().map(|name| vars.get(name).copied().unwrap_or(1.0)).collect())
}

impl ResponseResult {
    fn of(ring: &Ring, effects: Vec<String>, response: &MachineResponse) -> Self {
        Self {
            machine: ring.name.clone(),
            effects,
            bpm: ring.labels(ring.monitors.iter().map(|m| m.element)),
            correctors: ring.labels(ring.correctors.iter().map(|c| c.element)),
            response_x_m_per_rad: rows(&response.x),
            response_y_m_per_rad: rows(&response.y),
            qx: response.tunes.x,
            qy: response.tunes.y,
            gamma_tr: response.gamma_transition,
            dispersion_x: response.dispersion.clone(),
            horizontal: ring.horizontal_correctors(),
        }
    }

    /// One line on a block of the response.
    fn summary(&self, rows: &[Vec<f64>], name: &str, to: &str, from: usize, until: usize) -> [String; 5] {
        let entries = || rows.iter().enumerate().flat_map(|(i, row)| (from..until).map(move |j| (row[j], i, j)));
        let rms = (entries().map(|(r, ..)| r * r).sum::<f64>() / (rows.len() * (until - from)).max(1) as f64).sqrt();
        let largest = entries().max_by(|a, b| a.0.abs().total_cmp(&b.0.abs()));
        let (value, place) = largest.map_or((0.0, String::new()), |(r, i, j)| {
            (r, if r == 0.0 { String::new() } else { format!("{}, {to}_{}", self.bpm[i], self.correctors[j]) })
        });
        [name.into(), to.into(), format!("{rms:.3}"), format!("{value:.3}"), place]
    }
}

impl fmt::Display for ResponseResult {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}", self.machine)?;
        self.effects.iter().try_for_each(|effect| writeln!(f, "with {effect}"))?;
        writeln!(f, "tunes {:.6} {:.6}, gamma_tr {:.4}\n", self.qx, self.qy, self.gamma_tr)?;
        let (blocks, names) = ([&self.response_x_m_per_rad, &self.response_y_m_per_rad], ["x", "y"]);
        let mut table = table(["response", "to", "rms m/rad", "largest m/rad", "at"]);
        for (rows, name) in blocks.into_iter().zip(names) {
            for (to, from, until) in [("H", 0, self.horizontal), ("V", self.horizontal, self.correctors.len())] {
                table.add_row(self.summary(rows, name, to, from, until));
            }
        }
        writeln!(f, "{table}")?;
        write!(f, "all {} x {} elements of both planes: --json FILE", self.bpm.len(), self.correctors.len())
    }
}

fn rows(matrix: &DMatrix<f64>) -> Vec<Vec<f64>> {
    matrix.row_iter().map(|row| row.iter().copied().collect()).collect()
}
