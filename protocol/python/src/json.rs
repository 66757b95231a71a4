//! Python objects of values that serialise: lists, dictionaries, numbers and texts.

use pyo3::types::PyAnyMethods;
use pyo3::{Py, PyAny, PyResult, Python};
use serde::Serialize;

use crate::error::error;

/// The value as Python's `json` reads its JSON.
pub(crate) fn to_python(py: Python<'_>, value: &impl Serialize) -> PyResult<Py<PyAny>> {
    // Not `serde_json::to_string`: it writes numbers of single precision with fewer digits.
    let json = serde_json::to_value(value).map_err(error)?.to_string();
    let read = py.import("json")?.call_method1("loads", (json,))?;
    Ok(read.unbind())
}

/// The name that a variant has in JSON.
pub(crate) fn name(variant: &impl Serialize) -> PyResult<String> {
    let value = serde_json::to_value(variant).map_err(error)?;
    serde_json::from_value(value).map_err(error)
}
