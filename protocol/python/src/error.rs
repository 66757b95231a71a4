//! Exception of the package: every error that outside data or settings cause.

use std::fmt::Display;

use pyo3::exceptions::PyValueError;
use pyo3::{PyErr, create_exception};

create_exception!(
    v2vloc,
    Error,
    PyValueError,
    "Bad input: the message names the file, key or argument, and both values where two do not agree."
);

/// The exception with the message of a program's error.
pub(crate) fn error(cause: impl Display) -> PyErr {
    Error::new_err(cause.to_string())
}
