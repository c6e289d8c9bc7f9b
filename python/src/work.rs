//! What takes seconds: fit, sample, diagnose, compare.

use std::sync::Arc;

use diagnosis::Diagnosis;
use inference::Draws;
use inference::nuts::NutsSettings;
use measured::Settings;
use numpy::{PyArray1, PyArrayMethods};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use results::{
    CommandError, Comparison, Design, DiagnosedMatrix, DiagnosisResult, FitModel, FittedMatrix, compare_matrices,
    compare_recordings, comparison_page, diagnosis_page, fit_by_draws, fit_by_steps, fit_page,
};

use crate::error::input;
use crate::recording::{Data, Recording};
use crate::result::Outcome;
use crate::ring::{Ring, rf_of};
use crate::task;

/// How a measured matrix is fitted.
fn settings(ring: &Ring, rf: Option<&str>) -> PyResult<Settings> {
    if let Some([low, high]) = ring.range() {
        return Err(input(format!("a matrix is fitted without a range of the vars, found {low} to {high}")));
    }
    let mut settings = Settings { rf: rf.map_or(Ok(twin::Rf::FixedFrequency), rf_of)?, ..Settings::default() };
    settings.widths.strength = ring.width().unwrap_or(settings.widths.strength);
    Ok(settings)
}

fn expect_no_rf(rf: Option<&str>) -> PyResult<()> {
    match rf {
        None => Ok(()),
        Some(_) => Err(input("rf is for a measured matrix; a recording's header says what the RF held")),
    }
}

fn design(is_exact: bool) -> Design {
    if is_exact { Design::Exact } else { Design::Uncertain }
}

/// The batch fit; `hear` gets each step's name and number.
#[pyfunction]
pub fn fit(
    py: Python<'_>,
    ring: &Ring,
    recording: &Recording,
    rf: Option<&str>,
    exact_design: bool,
    hear: Option<Bound<'_, PyAny>>,
) -> PyResult<Outcome> {
    recording.expect(&ring.ring)?;
    match &recording.data {
        Data::Frames(frames) => {
            expect_no_rf(rf)?;
            let (ring, frames) = (ring.ring.clone(), Arc::clone(frames));
            task::run(py, hear, move |progress| {
                let result =
                    fit_by_steps(&ring, &frames, design(exact_design), |step| progress.step("Gauss-Newton", step))?;
                let shown = result.clone();
                Outcome::of(&result, move || fit_page(&ring, &frames, &shown))
            })
        }
        Data::Matrix(folder) => {
            let (settings, folder) = (settings(ring, rf)?, Arc::clone(folder));
            task::run(py, hear, move |progress| {
                let fitted = Arc::new(FittedMatrix::of(&folder, settings, &mut |what| progress.say(what))?);
                let shown = Arc::clone(&fitted);
                Outcome::of(&fitted.result, move || shown.page())
            })
        }
    }
}

/// NUTS; the draws come beside the result, as arrays by name.
#[pyfunction]
#[allow(clippy::too_many_arguments)] // those of the command
pub fn sample<'py>(
    py: Python<'py>,
    ring: &Ring,
    recording: &Recording,
    model: &str,
    chains: usize,
    warm_up: usize,
    draws: usize,
    seed: u64,
    exact_design: bool,
    hear: Option<Bound<'py, PyAny>>,
) -> PyResult<(Outcome, Bound<'py, PyDict>)> {
    let frames = recording.frames_of(&ring.ring)?;
    let model = match model {
        "twin" => FitModel::Twin,
        "green" => FitModel::Green,
        "resnet" => FitModel::Resnet,
        "linear" => FitModel::Linear,
        _ => return Err(input(format!("model: expected twin, green, resnet or linear, found {model:?}"))),
    };
    for (name, value, least) in [("chains", chains, 1), ("warm_up", warm_up, 50), ("draws", draws, 4)] {
        if value < least {
            return Err(input(format!("{name}: expected {least} or more, found {value}")));
        }
    }
    let (ring, frames) = (ring.ring.clone(), Arc::clone(frames));
    let settings = NutsSettings { chains, warm_up, draws, seed };
    let (outcome, drawn) = task::run(py, hear, move |progress| {
        let (result, drawn) =
            fit_by_draws(&ring, &frames, (model, design(exact_design)), settings, |done| progress.tell("draws", done))?;
        let shown = result.clone();
        Ok((Outcome::of(&result, move || fit_page(&ring, &frames, &shown))?, drawn))
    })?;
    Ok((outcome, arrays(py, &drawn)?))
}

/// Draws [chain][draw][N] of the vars, and how each came about [chain][draw].
fn arrays<'py>(py: Python<'py>, draws: &Draws) -> PyResult<Bound<'py, PyDict>> {
    let shape = [draws.chains.len(), draws.chains.first().map_or(0, |chain| chain.draws.len())];
    let result = PyDict::new(py);
    let values: Vec<f64> = draws.chains.iter().flat_map(|chain| chain.draws.concat()).collect();
    result.set_item("vars", PyArray1::from_vec(py, values).reshape([shape[0], shape[1], draws.names.len()])?)?;
    let stats = || draws.chains.iter().flat_map(|chain| &chain.stats);
    // the names of ArviZ
    let reals: [(&str, Vec<f64>); 4] = [
        ("lp", stats().map(|one| one.lp).collect()),
        ("acceptance_rate", stats().map(|one| one.acceptance).collect()),
        ("step_size", stats().map(|one| one.step_size).collect()),
        ("energy", stats().map(|one| one.energy).collect()),
    ];
    for (name, values) in reals {
        result.set_item(name, PyArray1::from_vec(py, values).reshape(shape)?)?;
    }
    for (name, values) in [
        ("tree_depth", stats().map(|one| one.depth).collect::<Vec<u64>>()),
        ("n_steps", stats().map(|one| one.leapfrogs).collect()),
    ] {
        result.set_item(name, PyArray1::from_vec(py, values).reshape(shape)?)?;
    }
    let diverging: Vec<bool> = stats().map(|one| one.divergent).collect();
    result.set_item("diverging", PyArray1::from_vec(py, diverging).reshape(shape)?)?;
    Ok(result)
}

/// What is missing in the model of one recording, or of several of one machine; `hear` gets each step's name.
#[pyfunction]
pub fn diagnose(
    py: Python<'_>,
    ring: &Ring,
    recordings: Vec<PyRef<'_, Recording>>,
    rf: Option<&str>,
    hear: Option<Bound<'_, PyAny>>,
) -> PyResult<Outcome> {
    recordings.iter().try_for_each(|one| one.expect(&ring.ring))?;
    if let [one] = recordings.as_slice()
        && let Data::Matrix(folder) = &one.data
    {
        let (settings, folder) = (settings(ring, rf)?, Arc::clone(folder));
        return task::run(py, hear, move |progress| {
            let diagnosed = DiagnosedMatrix::of(&folder, None, settings, &mut |what| progress.say(what))?;
            let diagnosed = Arc::new(diagnosed);
            let shown = Arc::clone(&diagnosed);
            Outcome::of(&diagnosed.result, move || shown.page())
        });
    }
    expect_no_rf(rf)?;
    let frames = |one: &PyRef<'_, Recording>| match &one.data {
        Data::Frames(frames) => Ok((**frames).clone()),
        Data::Matrix(_) => Err(input("one measured matrix at a time; compare(a, b) compares two")),
    };
    let all: Vec<inference::Recording> = recordings.iter().map(frames).collect::<PyResult<_>>()?;
    if all.is_empty() {
        return Err(input("expected a recording, found none"));
    }
    let ring = ring.ring.clone();
    task::run(py, hear, move |progress| {
        let (first, others) = all.split_first().expect("there is one");
        let diagnosis = Diagnosis::jointly(&ring, first, others, |what| progress.say(what))?;
        let result = DiagnosisResult::of(&ring, first, &diagnosis)?;
        let first = first.clone();
        Outcome::of(&result, move || diagnosis_page(&diagnosis, &first))
    })
}

/// What changed from one recording to another, or from one measured matrix.
#[pyfunction]
pub fn compare(
    py: Python<'_>,
    ring: &Ring,
    before: &Recording,
    after: &Recording,
    hear: Option<Bound<'_, PyAny>>,
) -> PyResult<Outcome> {
    let names = [before.name().to_owned(), after.name().to_owned()];
    let are_of_the_ring = || [before, after].into_iter().try_for_each(|one| one.expect(&ring.ring));
    match (&before.data, &after.data) {
        (Data::Frames(before), Data::Frames(after)) => {
            are_of_the_ring()?;
            let (ring, before, after) = (ring.ring.clone(), Arc::clone(before), Arc::clone(after));
            task::run(py, hear, move |progress| {
                let step = |step| progress.step("Gauss-Newton", step);
                with_page(compare_recordings(&ring, [&before, &after], step)?, names)
            })
        }
        (Data::Matrix(before), Data::Matrix(after)) => {
            are_of_the_ring()?;
            let (settings, before, after) = (settings(ring, None)?, Arc::clone(before), Arc::clone(after));
            task::run(py, hear, move |progress| {
                let mut say = |what: &str| progress.say(what);
                with_page(compare_matrices([&before, &after], &settings, &mut say)?, names)
            })
        }
        _ => {
            let [a, b] = names;
            Err(input(format!("of {a} and {b} one is a measured matrix, one a recording of frames")))
        }
    }
}

fn with_page(compared: Comparison, names: [String; 2]) -> Result<Outcome, CommandError> {
    let page = comparison_page(&compared, [&names[0], &names[1]]);
    Outcome::of(&compared, move || Ok(page.clone()))
}
