//! Simulated campaigns whose truth is known, and one case of the validation of the diagnosis; each follows from its seed.

use std::collections::BTreeMap;
use std::sync::Arc;

use diagnosis::DataError;
use inference::simulate::{self as simulated, Hardware, Instruments, Truth};
use inference::{BaseModel, BatchFit, TuneUse};
use pyo3::prelude::*;
use results::{CommandError, campaign, factors};
use validation::{Cases, Class};

use crate::error::{input, other, raised};
use crate::recording::Recording;
use crate::ring::Ring;
use crate::task;

/// A campaign with settings, read-backs and gaps of a recording, and the vars that it was made with, in the ring's order. Without vars they are
/// drawn from the ring's prior, rings with stable motion. Exact: every frame an exact orbit of misaligned magnets, monitors with offsets, noise and jumps, tunes;
/// else the machine of the estimator's model.
#[pyfunction]
pub fn simulate(
    py: Python<'_>,
    ring: &Ring,
    template: &Recording,
    seed: u64,
    vars: Option<BTreeMap<String, f64>>,
    effects: Vec<String>,
    exact: bool,
) -> PyResult<(Recording, Vec<f64>)> {
    let template = template.frames_of(&ring.ring)?;
    let effects = ring.effects(&effects)?;
    if !effects.is_empty() && !exact {
        return Err(input("effects need exact=True: the linear machine has none"));
    }
    let ring = &ring.ring;
    py.detach(|| {
        // streams of their own for vars and noise
        let mut seeds = simulated::seeds(seed);
        let mut next = || seeds.next().expect("seeds do not end");
        let (of_vars, of_noise) = (next(), next());
        let vars = match vars {
            Some(vars) => factors(&vars, ring).map_err(input)?,
            None => simulated::vars(ring, false, of_vars).map_err(other)?,
        };
        let made = if exact {
            let truth = Truth { vars: &vars, effects: &effects, beyond: &[] };
            let hardware = Hardware::shipped(ring, template);
            simulated::campaign(template, ring, &truth, &hardware, of_noise).map_err(other)
        } else {
            let instruments = Instruments::healthy(ring, template).map_err(other)?;
            simulated::like(template, ring, &vars, &instruments, of_noise).map_err(other)
        };
        Ok((Recording::of_frames(made?, ring), vars))
    })
}

/// Mean and standard deviation of the normal of each `ln var` before it is truncated to the prior's range, by the batch fit [N].
#[pyfunction]
pub fn marginals(py: Python<'_>, ring: &Ring, recording: &Recording) -> PyResult<(Vec<f32>, Vec<f32>)> {
    let frames = recording.frames_of(&ring.ring)?;
    py.detach(|| {
        let campaign = campaign(&ring.ring, frames).map_err(raised)?;
        let fit = BatchFit::best(&campaign, TuneUse::Readings, BaseModel::EXACT, |_| ()).map_err(other)?;
        Ok((fit.marginals.iter().map(|one| one.mean).collect(), fit.marginals.iter().map(|one| one.sigma).collect()))
    })
}

/// Blind campaigns through the diagnosis, as of `orbitcal validate`.
#[pyclass(frozen, module = "orbitcal._orbitcal")]
#[derive(Clone)]
pub struct Validation {
    ring: twin::Ring,
    template: inference::Recording,
    cases: Arc<Cases>,
}

#[pymethods]
impl Validation {
    /// With settings, read-backs and gaps of a recording.
    #[new]
    fn new(py: Python<'_>, ring: &Ring, template: &Recording) -> PyResult<Self> {
        let template = template.frames_of(&ring.ring)?;
        let (ring, template) = (ring.ring.clone(), (**template).clone());
        py.detach(|| {
            let campaign = inference::Campaign::of(&ring, &template).map_err(other)?;
            let cases = Arc::new(Cases::of(&campaign).map_err(refused)?);
            Ok(Self { ring, template, cases })
        })
    }

    /// Simulate, diagnose and score case `index` of a class, that of `orbitcal validate`; JSON, or none where its machine keeps no beam.
    fn run(&self, py: Python<'_>, kind: &str, index: usize, seed: u64) -> PyResult<Option<String>> {
        let class = match kind {
            "empty" => Class::Empty,
            "single" => Class::Single,
            "pair" => Class::Pair,
            "unknown" => Class::Unknown,
            _ => return Err(input(format!("class: expected empty, single, pair or unknown, found {kind:?}"))),
        };
        let this = self.clone();
        task::run(py, None, move |_| {
            let case = this.cases.draw(class, class.number(index), seed);
            let outcome = validation::run(&this.ring, &this.template, &case)?;
            let text =
                |outcome| serde_json::to_string(&outcome).map_err(|error| CommandError::Other(error.to_string()));
            outcome.map(text).transpose()
        })
    }
}

fn refused(error: DataError) -> PyErr {
    raised(CommandError::from(error))
}
