//! A recording of frames, or a measured response matrix, for Python.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use lattices::import::{
    Conventions, KickIs, Measurement, OrbitUnit, Order, PerInstrument, Signs, Table, agreement, assemble, table_names,
};
use measured::lattice::machine;
use measured::{Folder, MeasuredError, Settings};
use numpy::PyArray2;
use pyo3::prelude::*;
use results::CheckResult;
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

/// Relative difference of circumferences that is rounding of a file.
const SAME: f64 = 1e-6;

/// A recording; see `orbitcal.Recording`.
#[pyclass(frozen, module = "orbitcal._orbitcal")]
pub struct Recording {
    /// What was measured.
    pub data: Data,
    /// The machine on which, of frames; a matrix has a lattice of its own.
    machine: Option<Machine>,
}

/// What tells rings apart whose strengths and priors may be others.
#[derive(Debug, Clone, PartialEq)]
struct Machine {
    name: String,
    circumference: f64,
    monitors: Vec<String>,
    correctors: Vec<String>,
}

impl Machine {
    fn of(ring: &twin::Ring) -> Self {
        let (name, circumference) = (ring.name.clone(), ring.circumference);
        Self { name, circumference, monitors: ring.monitor_names(), correctors: ring.corrector_names() }
    }

    fn text(&self) -> String {
        let Self { name, circumference, monitors, correctors } = self;
        format!("{name} ({circumference} m, {} monitors, {} correctors)", monitors.len(), correctors.len())
    }
}

impl Recording {
    /// Frames of a ring.
    pub fn of_frames(frames: inference::Recording, ring: &twin::Ring) -> Self {
        Self { data: Data::Frames(Arc::new(frames)), machine: Some(Machine::of(ring)) }
    }

    fn of_matrix(folder: Folder) -> Self {
        Self { data: Data::Matrix(Arc::new(folder)), machine: None }
    }

    /// Its frames, for a ring.
    ///
    /// # Errors
    /// `InputError` of a measured matrix, and of a recording of another ring.
    pub fn frames_of(&self, ring: &twin::Ring) -> PyResult<&Arc<inference::Recording>> {
        let Data::Frames(frames) = &self.data else {
            return Err(input(format!("{} is a measured matrix and has no frames", self.name())));
        };
        self.expect(ring)?;
        Ok(frames)
    }

    /// That it is of a ring.
    ///
    /// # Errors
    /// `InputError`.
    pub fn expect(&self, ring: &twin::Ring) -> PyResult<()> {
        let found = Machine::of(ring);
        let expected = match &self.data {
            Data::Matrix(folder) => {
                let circumference = folder.meta.circumference;
                let is_same = (circumference / ring.circumference - 1.0).abs() < SAME;
                (!is_same).then(|| format!("{circumference} m"))
            }
            Data::Frames(_) => self.machine.as_ref().filter(|own| **own != found).map(Machine::text),
        };
        match expected {
            None => Ok(()),
            Some(own) => Err(input(format!("{}: expected its ring, {own}, found {}", self.name(), found.text()))),
        }
    }
}

#[pymethods]
impl Recording {
    /// Read a folder of either sort; frames at the ring's energy, or at whichever they were taken.
    #[staticmethod]
    fn read(folder: PathBuf, ring: &Ring, any_energy: bool) -> PyResult<Self> {
        if Folder::is_one(&folder) {
            return Ok(Self::of_matrix(Folder::read(&folder).map_err(input)?));
        }
        let read = if any_energy { inference::Recording::read_at_its_energy } else { inference::Recording::read };
        Ok(Self::of_frames(read(&folder, &ring.ring).map_err(input)?, &ring.ring))
    }

    /// The lattice that the header in a folder names, if it does.
    #[staticmethod]
    fn lattice(folder: PathBuf) -> Option<String> {
        inference::Recording::lattice(&folder)
    }

    /// The texts of `header.toml` and `frames.csv`; `name` appears in errors.
    #[staticmethod]
    fn parse(name: &str, ring: &Ring, header: &str, frames: &str) -> PyResult<Self> {
        let frames = inference::Recording::parse(Path::new(name), &ring.ring, header, frames).map_err(input)?;
        Ok(Self::of_frames(frames, &ring.ring))
    }

    /// The same at whichever energy they were taken.
    #[staticmethod]
    fn again(name: &str, ring: &Ring, header: &str, frames: &str) -> PyResult<Self> {
        let frames = inference::Recording::parse_at_its_energy(Path::new(name), &ring.ring, header, frames);
        Ok(Self::of_frames(frames.map_err(input)?, &ring.ring))
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
        if dispersion.is_some() != rf_step.is_some() {
            return Err(input("expected dispersion and rf_step together, found one of them"));
        }
        let (lattice, instruments) = &*imported.of;
        let [monitors, correctors] = table_names(lattice, instruments);
        // tables may have the names of the ring
        let monitors: Vec<_> = ring.ring.monitor_names().into_iter().zip(monitors).collect();
        let correctors: Vec<_> = ring.ring.corrector_names().into_iter().zip(correctors).collect();
        let read =
            |name, text| Ok::<_, PyErr>(Table::parse(name, text).map_err(input)?.renamed(&monitors, &correctors));
        let (table, dispersion) = (read(name, table)?, dispersion.map(|text| read("dispersion", text)).transpose()?);
        let measured = Measurement {
            matrix: &table,
            dispersion: dispersion.as_ref().zip(rf_step),
            order: order.map(|order| word("order", order, &ORDERS)).transpose()?,
            conventions: &conventions,
        };
        let mut folder = assemble(lattice, instruments, rf_frequency, &measured).map_err(input)?;
        folder.name = name.into();
        ring.strengthen(&mut folder);
        Ok(Self::of_matrix(folder))
    }

    /// The ring of a matrix that was read, on its own lattice.
    fn ring_of_matrix(&self) -> PyResult<Ring> {
        match &self.data {
            Data::Matrix(folder) => Ring::machine(machine(folder, &[], &[]).to_string(), folder.name.clone()),
            Data::Frames(_) => Err(input(format!("{} is a recording of frames, not a measured matrix", self.name()))),
        }
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
        Ok(self.frames_of(&ring.ring)?.texts(&ring.ring))
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
            Data::Matrix(measured) => lattices::import::write(measured, &folder, &Settings::default()).map_err(input),
        }
    }

    /// What it holds, as JSON.
    fn check(&self, py: Python<'_>, ring: &Ring) -> PyResult<String> {
        self.expect(&ring.ring)?;
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
    let one = |one: &lattices::import::Agreement| {
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
