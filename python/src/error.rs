//! Errors of the program as exceptions with the same words.

use core::fmt::Display;

use pyo3::create_exception;
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use results::CommandError;

create_exception!(
    orbitcal,
    InputError,
    PyValueError,
    "An input is wrong: where, what was expected and what was found."
);
create_exception!(orbitcal, OrbitcalError, PyRuntimeError, "Anything else that went wrong.");

/// What was given is wrong.
pub fn input(error: impl Display) -> PyErr {
    InputError::new_err(error.to_string())
}

/// Something else is wrong.
pub fn other(error: impl Display) -> PyErr {
    OrbitcalError::new_err(error.to_string())
}

/// What a command refuses, or what went wrong in it.
pub fn raised(error: CommandError) -> PyErr {
    match error {
        CommandError::Input(message) => input(message),
        CommandError::Other(message) => other(message),
    }
}
