//! The no_std core in this process, frame by frame.

use std::path::Path;
use std::sync::Arc;

use inference::recording::Row;
use inference::stream::{self, Feedback};
use numpy::PyArray1;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use results::{EstimateRecord, Names};

use crate::error::input;
use crate::estimate::Estimate;
use crate::recording::{Data, Recording};
use crate::ring::Ring;

/// Metres a micrometre.
const MICRO: f32 = 1e-6;

/// A core; see `orbitcal.Estimator`.
#[pyclass(module = "orbitcal._orbitcal")]
pub struct Core {
    core: stream::Core,
    ring: twin::Ring,
    names: Arc<Names>,
    /// What the frames are taken with: the header of a recording.
    like: inference::Recording,
    header: String,
}

#[pymethods]
impl Core {
    /// At its prior, for frames that are taken as those of a recording are; the walk as of `orbitcal replay`.
    #[new]
    fn new(
        ring: &Ring,
        like: &Recording,
        model: &str,
        follow: bool,
        process_noise: f32,
        baseline_walk: f32,
    ) -> PyResult<Self> {
        let like = like.frames_of(&ring.ring)?;
        let (ring, like) = (ring.ring.clone(), (**like).clone());
        let walk =
            if follow { stream::FOLLOW } else { stream::walk_per_cycle(&like, process_noise, baseline_walk * MICRO) };
        let powered = like.powered(&ring);
        let tables = training::green::tables(&powered).map_err(input)?;
        let setup = stream::setup(&powered, &like, walk).map_err(input)?;
        let core = match model {
            "green" => stream::Core::with_tables(tables, setup),
            "resnet" => stream::Core::with_network(&powered, tables, setup),
            _ => return Err(input(format!("model: expected green or resnet, found {model:?}"))),
        };
        let core = core.map_err(input)?;
        let ([header, _], names) = (like.texts(&ring), Names::of(&ring));
        Ok(Self { core, names, header, like, ring })
    }

    /// The next frame as wire bytes.
    fn of_bytes(&mut self, py: Python<'_>, mut frame: Vec<u8>) -> PyResult<Estimate> {
        py.detach(|| self.ingest(&mut frame))
    }

    /// The next frame: one of a recording.
    fn of_recording(&mut self, py: Python<'_>, recording: &Recording, frame: usize) -> PyResult<Estimate> {
        let frames = recording.frames_of(&self.ring)?;
        let row = row_of(frames, frame)?;
        py.detach(|| self.row(row))
    }

    /// The next frame: the only row of the text of a `frames.csv`.
    fn of_text(&mut self, py: Python<'_>, frames: &str) -> PyResult<Estimate> {
        let name = Path::new(&self.like.name);
        let mut parsed = inference::Recording::parse(name, &self.ring, &self.header, frames).map_err(input)?;
        py.detach(|| self.row(&parsed.rows.swap_remove(0)))
    }

    /// Wire bytes of a frame of a recording.
    #[staticmethod]
    fn wire(recording: &Recording, frame: usize) -> PyResult<Vec<u8>> {
        let Data::Frames(frames) = &recording.data else {
            return Err(input(format!("{} is a measured matrix and has no frames", recording.name())));
        };
        stream::wire(frames, row_of(frames, frame)?).map_err(input)
    }

    /// How well the model describes the frames so far: chi-square and its degrees of freedom.
    fn fit_quality(&mut self) -> [f32; 2] {
        let quality = self.core.fit_quality();
        [quality.chi_square, quality.degrees_of_freedom]
    }

    /// What the posterior expects of the readings of the last frame [B] [m].
    fn fitted<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        PyArray1::from_vec(py, self.core.fitted())
    }

    /// Steer from the next frame on; numbers and units are those of docs/feedback.md.
    #[allow(clippy::too_many_arguments)] // those of the feedback
    fn steer(
        &mut self,
        orbit: Vec<f32>,
        limit: Vec<f32>,
        walk: f32,
        step_kick: f32,
        total_kick: f32,
        rate: f32,
        probe: f32,
        close: f32,
        patience_us: u64,
    ) -> PyResult<()> {
        let counts = [self.names.monitors.len(), self.ring.correctors.len()];
        if [orbit.len(), limit.len()] != counts {
            let [monitors, correctors] = counts;
            let found = [orbit.len(), limit.len()];
            return Err(input(format!(
                "expected a wanted reading for each of {monitors} monitors and a limit for each of {correctors} correctors, found {found:?}"
            )));
        }
        let feedback = Feedback { orbit, limit, walk, step_kick, total_kick, rate, probe, close, patience_us };
        self.core.steer(Some(&feedback));
        Ok(())
    }

    /// Set points after the last frame [A] [C], why they stayed as they were, and what each corrector is to the feedback.
    fn correction<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyDict>>> {
        let Some(correction) = self.core.correction() else { return Ok(None) };
        let result = PyDict::new(py);
        result.set_item("setpoint", PyArray1::from_vec(py, correction.setpoint))?;
        let estimator::Steered { hold, left_out, limited } = correction.steered;
        result.set_item("hold", hold.map(|why| why.to_string()))?;
        result.set_item("left_out", left_out)?;
        result.set_item("limited", limited)?;
        result.set_item("role", correction.role.iter().map(|role| *role as u32).collect::<Vec<_>>())?;
        Ok(Some(result))
    }
}

fn row_of(frames: &inference::Recording, frame: usize) -> PyResult<&Row> {
    let count = frames.rows.len();
    frames
        .rows
        .get(frame)
        .ok_or_else(|| input(format!("{}: expected a frame below {count}, found {frame}", frames.name)))
}

impl Core {
    fn row(&mut self, row: &Row) -> PyResult<Estimate> {
        let mut bytes = stream::wire(&self.like, row).map_err(input)?;
        self.ingest(&mut bytes)
    }

    fn ingest(&mut self, bytes: &mut [u8]) -> PyResult<Estimate> {
        self.core.prepare();
        let estimate = self.core.ingest(bytes).map_err(input)?;
        let mismatch = self.core.fit_quality().is_mismatch();
        let covariance = self.core.spread().covariance();
        Ok(Estimate::of(EstimateRecord::of(&self.names, estimate, &covariance, Some(mismatch)), None))
    }
}
