//! The result of `orbitcal response`: how the twin's orbit responds to every corrector.

use core::fmt;
use std::collections::BTreeMap;

use nalgebra::DMatrix;
use schemars::JsonSchema;
use serde::Serialize;
use twin::{MachineResponse, Ring};

use crate::output::table;

/// How the orbit responds. Field names are those of the command's JSON.
#[derive(Serialize, JsonSchema)]
pub struct ResponseResult {
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

/// Factor of every quadrupole: those that are named, 1 for the others.
///
/// # Errors
/// What is wrong with them.
pub fn factors(vars: &BTreeMap<String, f64>, ring: &Ring) -> Result<Vec<f64>, String> {
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
    /// Of a ring with these effects.
    pub fn of(ring: &Ring, effects: Vec<String>, response: &MachineResponse) -> Self {
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
