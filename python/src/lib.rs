//! orbitcal for Python: rings, recordings, fits, diagnoses and live estimates as numpy arrays and JSON.
//!
//! This layer takes and gives what Python has without further libraries; the modules of the package `orbitcal` make xarray, pandas,
//! ArviZ and figures of it. Errors are the program's, with the same words ([`error`]); what takes long runs on a thread of its
//! own, so that Ctrl-C and other threads of Python work ([`task`]).

mod array;
mod error;
mod estimate;
mod recording;
mod response;
mod result;
mod ring;
mod simulate;
mod source;
mod stream;
#[cfg(feature = "shared-memory")]
mod subscriber;
mod task;
mod work;

use pyo3::prelude::*;

/// What the Python modules build on.
#[pymodule]
mod _orbitcal {
    use pyo3::prelude::*;

    #[pymodule_export]
    use crate::error::{InputError, OrbitcalError};
    #[pymodule_export]
    use crate::estimate::Estimate;
    #[pymodule_export]
    use crate::recording::Recording;
    #[pymodule_export]
    use crate::result::Outcome;
    #[pymodule_export]
    use crate::ring::Ring;
    #[pymodule_export]
    use crate::simulate::{Validation, marginals, simulate};
    #[pymodule_export]
    use crate::stream::Core;
    #[cfg(feature = "shared-memory")]
    #[pymodule_export]
    use crate::subscriber::Subscriber;
    #[pymodule_export]
    use crate::work::{compare, diagnose, fit, sample};

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}
