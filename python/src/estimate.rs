//! One estimate, from a core in this process or from a daemon.

use numpy::{PyArray1, PyArray2, PyArrayMethods};
use pyo3::prelude::*;
use results::{EstimateRecord, state_word};

/// An estimate; see `orbitcal.Estimate`.
#[pyclass(frozen, module = "orbitcal._orbitcal")]
pub struct Estimate {
    record: EstimateRecord,
    publisher: Option<String>,
}

impl Estimate {
    /// From a core in this process, or as somebody published it.
    pub fn of(record: EstimateRecord, publisher: Option<String>) -> Self {
        Self { record, publisher }
    }
}

#[pymethods]
impl Estimate {
    #[getter]
    fn machine(&self) -> &str {
        &self.record.names.machine
    }

    #[getter]
    fn publisher(&self) -> Option<&str> {
        self.publisher.as_deref()
    }

    #[getter]
    fn vars(&self) -> Vec<String> {
        self.record.names.vars.clone()
    }

    #[getter]
    fn monitors(&self) -> Vec<String> {
        self.record.names.monitors.clone()
    }

    #[getter]
    fn sequence(&self) -> u32 {
        self.record.sequence
    }

    #[getter]
    fn time_us(&self) -> u64 {
        self.record.time_us
    }

    #[getter]
    fn frames(&self) -> u32 {
        self.record.frames
    }

    #[getter]
    fn rejected_frames(&self) -> u32 {
        self.record.rejected_frames
    }

    #[getter]
    fn linearised(&self) -> bool {
        self.record.linearised
    }

    #[getter]
    fn mismatch(&self) -> Option<bool> {
        self.record.mismatch
    }

    #[getter]
    fn nis(&self) -> f32 {
        self.record.nis
    }

    #[getter]
    fn log_evidence(&self) -> f32 {
        self.record.log_evidence
    }

    #[getter]
    fn tune_innovation(&self) -> [Option<f32>; 2] {
        self.record.tune_innovation
    }

    #[getter]
    fn usable(&self) -> bool {
        self.record.is_usable()
    }

    #[getter]
    fn remarks(&self) -> Vec<&'static str> {
        self.record.words().collect()
    }

    /// Mean of each var [N] [1].
    #[getter]
    fn mean<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        PyArray1::from_slice(py, &self.record.mean)
    }

    /// Standard deviation of each var [N] [1].
    #[getter]
    fn sigma<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        PyArray1::from_slice(py, &self.record.sigma)
    }

    /// Maximum a posteriori of each `ln var` [N] [1].
    #[getter]
    fn map_params<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        PyArray1::from_slice(py, &self.record.map_params)
    }

    /// Centre of the normal of each `ln var` before it is truncated to the prior's range [N] [1].
    #[getter]
    fn centre<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        PyArray1::from_slice(py, &self.record.centre)
    }

    /// Its standard deviation [N] [1].
    #[getter]
    fn params_sigma<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        PyArray1::from_slice(py, &self.record.params_sigma)
    }

    /// Whether each var sits at a bound of the prior's range [N].
    #[getter]
    fn clipped<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<bool>> {
        PyArray1::from_slice(py, &self.record.clipped)
    }

    /// Noise of one reading of each monitor [B] [m].
    #[getter]
    fn monitor_sigma<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f32>> {
        PyArray1::from_slice(py, &self.record.monitor_sigma)
    }

    /// Readings of each monitor that were not used so far [B].
    #[getter]
    fn monitor_rejected<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u32>> {
        PyArray1::from_slice(py, &self.record.monitor_rejected)
    }

    /// Covariance of the vars [N][N] [1].
    #[getter]
    fn covariance<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let n = self.record.mean.len();
        let values = (0..n * n).map(|at| self.record.covariance_of(at / n, at % n)).collect();
        PyArray1::from_vec(py, values).reshape([n, n])
    }

    /// What became of each monitor's reading [B]: 0 did not report, 1 used, 2 rejected.
    #[getter]
    fn reading<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u32>> {
        PyArray1::from_vec(py, self.record.reading.iter().map(|one| *one as u32).collect())
    }

    fn __repr__(&self) -> String {
        let record = &self.record;
        let farthest = record.farthest().map_or_else(String::new, |i| {
            format!(": farthest from 1 is {} {:.4} ± {:.4}", record.names.vars[i], record.mean[i], record.sigma[i])
        });
        format!("<orbitcal.Estimate of frame {}, {} vars{farthest}>", record.sequence, record.mean.len())
    }

    /// State of each monitor [B].
    #[getter]
    fn monitor_state(&self) -> Vec<&'static str> {
        self.record.monitor_state.iter().map(|state| state_word(*state)).collect()
    }
}
