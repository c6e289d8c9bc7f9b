//! A recording of frames, or a measured response matrix, for Python.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use host_bridge::command::check::CheckResult;
use measured::import::{
    Conventions, KickIs, Measurement, OrbitUnit, Order, PerInstrument, Signs, Table, agreement, assemble,
};
use measured::{Folder, MeasuredError};
use numpy::PyArray2;
use pyo3::prelude::*;
use serde_json::json;
use twin::{Plane, Rf};

use crate::array::matrix;
use crate::error::{input, other, raised};
use crate::ring::Ring;

/// What was measured.
pub enum Data {
    /// Frames of a campaign.
    Frames(Arc<inference::Recording>),
    /// A response matrix.
    Matrix(Arc<Folder>),
}

/// A recording; see `orbitcal.Recording`.
#[pyclass(frozen, module = "orbitcal._orbitcal")]
pub struct Recording {
    /// What was measured.
    pub data: Data,
}

impl Recording {
    /// Its frames.
    ///
    /// # Errors
    /// `InputError` of a measured matrix.
    pub fn expect_frames(&self) -> PyResult<&Arc<inference::Recording>> {
        match &self.data {
            Data::Frames(frames) => Ok(frames),
            Data::Matrix(_) => Err(input(format!("{} is a measured matrix and has no frames", self.name()))),
        }
    }
}

#[pymethods]
impl Recording {
    /// Read a folder of either sort; frames at the ring's energy, or at whichever they were taken.
    #[staticmethod]
    fn read(folder: PathBuf, ring: &Ring, any_energy: bool) -> PyResult<Self> {
        if Folder::is_one(&folder) {
            return Ok(Self { data: Data::Matrix(Arc::new(Folder::read(&folder).map_err(input)?)) });
        }
        let read = if any_energy { inference::Recording::read_at_its_energy } else { inference::Recording::read };
        let frames = read(&folder, &ring.ring).map_err(input)?;
        Ok(Self { data: Data::Frames(Arc::new(frames)) })
    }

    /// The texts of `header.toml` and `frames.csv`; `name` appears in errors.
    #[staticmethod]
    fn parse(name: &str, ring: &Ring, header: &str, frames: &str) -> PyResult<Self> {
        let frames = inference::Recording::parse(Path::new(name), &ring.ring, header, frames).map_err(input)?;
        Ok(Self { data: Data::Frames(Arc::new(frames)) })
    }

    /// A response matrix of a ring that was made of a lattice, as text of a table; words as of `orbitcal import`.
    #[staticmethod]
    #[pyo3(signature = (ring, name, table, order, orbit_unit, kick, kick_is, kick_sign, noise, dispersion, rf_step, rf_frequency))]
    #[allow(clippy::too_many_arguments)] // those of the command
    fn assemble(
        ring: &Ring,
        name: &str,
        table: &str,
        order: Option<&str>,
        orbit_unit: &str,
        kick: &str,
        kick_is: &str,
        kick_sign: &str,
        noise: &str,
        dispersion: Option<&str>,
        rf_step: Option<f64>,
        rf_frequency: Option<f64>,
    ) -> PyResult<Self> {
        let Some(imported) = ring.imported() else {
            return Err(input(format!(
                "{}: a matrix needs the ring of a lattice, found that of a machine file",
                ring.ring.name
            )));
        };
        let conventions = Conventions {
            unit: word("orbit_unit", orbit_unit, &UNITS)?,
            kick: per_instrument("kick", kick)?,
            kick_is: word("kick_is", kick_is, &KICKS)?,
            signs: word("kick_sign", kick_sign, &SIGNS)?,
            noise: per_instrument("noise", noise)?,
        };
        let table = Table::parse(name, table).map_err(input)?;
        let dispersion = dispersion.map(|text| Table::parse("dispersion", text)).transpose().map_err(input)?;
        let measured = Measurement {
            matrix: &table,
            dispersion: dispersion.as_ref().zip(rf_step),
            order: order.map(|order| word("order", order, &ORDERS)).transpose()?,
            conventions: &conventions,
        };
        let (lattice, instruments) = &*imported.of;
        let folder = assemble(lattice, instruments, rf_frequency, &measured).map_err(input)?;
        Ok(Self { data: Data::Matrix(Arc::new(Folder { name: name.into(), ..folder })) })
    }

    /// Its name.
    #[getter]
    pub fn name(&self) -> &str {
        match &self.data {
            Data::Frames(frames) => &frames.name,
            Data::Matrix(folder) => &folder.name,
        }
    }

    /// True of a response matrix.
    #[getter]
    fn is_matrix(&self) -> bool {
        matches!(self.data, Data::Matrix(_))
    }

    /// The texts of `header.toml` and `frames.csv`.
    fn texts(&self, ring: &Ring) -> PyResult<[String; 2]> {
        Ok(self.expect_frames()?.texts(&ring.ring))
    }

    /// Number of frames, 0 of a matrix.
    fn frames(&self) -> usize {
        match &self.data {
            Data::Frames(frames) => frames.rows.len(),
            Data::Matrix(_) => 0,
        }
    }

    /// A response matrix: names of monitors and correctors, the matrix [mm], kicks [mrad] and noise [mm].
    #[allow(clippy::type_complexity)] // five values, unpacked at once
    fn matrix<'py>(
        &self,
        py: Python<'py>,
    ) -> PyResult<(Vec<String>, Vec<String>, Bound<'py, PyArray2<f64>>, Vec<f64>, Vec<f64>)> {
        let Data::Matrix(folder) = &self.data else {
            return Err(input(format!("{} is a recording of frames, not a measured matrix", self.name())));
        };
        let monitors = (0..folder.monitors.len()).map(|row| folder.monitor(row)).collect();
        let correctors = (0..folder.correctors.len()).map(|column| folder.corrector(column)).collect();
        let kicks = folder.correctors.iter().map(|one| one.kick).collect();
        let noise = folder.monitors.iter().map(|one| one.sigma).collect();
        Ok((monitors, correctors, matrix(py, &folder.matrix)?, kicks, noise))
    }

    /// Write its folder, which is made.
    fn write(&self, folder: PathBuf, ring: &Ring) -> PyResult<()> {
        match &self.data {
            Data::Frames(frames) => frames.write(&folder, &ring.ring).map_err(other),
            Data::Matrix(measured) => measured::import::write(measured, &folder).map_err(input),
        }
    }

    /// What it holds, as JSON.
    fn check(&self, py: Python<'_>, ring: &Ring) -> PyResult<String> {
        py.detach(|| match &self.data {
            Data::Frames(frames) => {
                let result = CheckResult::of(&ring.ring, frames).map_err(raised)?;
                serde_json::to_string(&result).map_err(other)
            }
            Data::Matrix(folder) => of_matrix(folder).map_err(input),
        })
    }
}

/// A matrix beside that of its lattice.
fn of_matrix(folder: &Folder) -> Result<String, MeasuredError> {
    let planes = agreement(folder, Rf::FixedFrequency)?;
    let one = |one: &measured::import::Agreement| {
        let plane = if one.plane == Plane::X { "x" } else { "y" };
        json!({"plane": plane, "factor": one.factor, "correlation": one.correlation, "largest_difference_mm": one.largest})
    };
    let missing = folder.matrix.iter().filter(|value| value.is_nan()).count();
    Ok(json!({
        "recording": folder.name,
        "monitors": folder.monitors.len(),
        "correctors": folder.correctors.len(),
        "elements": folder.matrix.len() - missing,
        "dispersion": folder.dispersion.is_some(),
        "agreement": planes.iter().map(one).collect::<Vec<_>>(),
    })
    .to_string())
}

const UNITS: [(&str, OrbitUnit); 3] =
    [("mm", OrbitUnit::Millimetres), ("m", OrbitUnit::Metres), ("um", OrbitUnit::Micrometres)];
const KICKS: [(&str, KickIs); 2] = [("full", KickIs::Full), ("half", KickIs::Half)];
const SIGNS: [(&str, Signs); 4] = [
    ("x+y+", Signs([true, true])),
    ("x-y+", Signs([false, true])),
    ("x+y-", Signs([true, false])),
    ("x-y-", Signs([false, false])),
];
const ORDERS: [(&str, Order); 2] = [("planes", Order::Planes), ("pairs", Order::Pairs)];

/// What a word stands for.
fn word<T: Copy>(name: &str, found: &str, all: &[(&str, T)]) -> PyResult<T> {
    let known = all.iter().find(|(word, _)| *word == found).map(|(_, value)| *value);
    known.ok_or_else(|| {
        let words: Vec<&str> = all.iter().map(|(word, _)| *word).collect();
        input(format!("{name}: expected {}, found {found:?}", words.join(", ")))
    })
}

/// One number for all, one a plane, or lines of names and numbers.
fn per_instrument(name: &str, text: &str) -> PyResult<PerInstrument> {
    if text.contains('\n') {
        return Table::parse(name, text).map(PerInstrument::Named).map_err(input);
    }
    PerInstrument::parse(name, text).map_err(input)
}
