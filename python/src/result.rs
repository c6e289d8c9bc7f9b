//! The result of work: JSON, and its page when asked for.

use core::fmt;

use pyo3::prelude::*;
use report::Page;
use results::{CommandError, output};
use serde::Serialize;

use crate::error::{other, raised};

type Pages = Box<dyn Fn() -> Result<Page, CommandError> + Send + Sync>;

/// JSON as the program writes it, the text that it prints, and its report.
#[pyclass(frozen, module = "orbitcal._orbitcal")]
pub struct Outcome {
    /// The JSON.
    #[pyo3(get)]
    json: String,
    /// The table for a terminal.
    #[pyo3(get)]
    text: String,
    page: Pages,
}

impl Outcome {
    /// Of a result and what makes its page.
    pub fn of<R: Serialize + fmt::Display>(
        result: &R,
        page: impl Fn() -> Result<Page, CommandError> + Send + Sync + 'static,
    ) -> Result<Self, CommandError> {
        let json = serde_json::to_string(result).map_err(|error| CommandError::Other(error.to_string()))?;
        Ok(Self { json, text: result.to_string(), page: Box::new(page) })
    }
}

#[pymethods]
impl Outcome {
    /// Write the report, one HTML file.
    fn report(&self, py: Python<'_>, path: std::path::PathBuf) -> PyResult<()> {
        py.detach(|| {
            let page = (self.page)().map_err(raised)?;
            output::bytes(&path, page.render().as_bytes()).map_err(other)
        })
    }
}
