//! Python objects of values that serialise: lists, dictionaries, numbers and texts.

use pyo3::types::{PyDict, PyDictMethods, PyList};
use pyo3::{Bound, IntoPyObject, PyAny, PyResult, Python};
use serde::Serialize;
use serde_json::Value;

use crate::error::error;

/// The value as Python's `json` would read its JSON.
pub(crate) fn to_python<'py>(
    py: Python<'py>,
    value: &impl Serialize,
) -> PyResult<Bound<'py, PyAny>> {
    of_value(py, &serde_json::to_value(value).map_err(error)?)
}

/// The name that a variant has in JSON.
pub(crate) fn name(variant: &impl Serialize) -> PyResult<String> {
    let value = serde_json::to_value(variant).map_err(error)?;
    Ok(value
        .as_str()
        .map_or_else(|| value.to_string(), str::to_owned))
}

fn of_value<'py>(py: Python<'py>, value: &Value) -> PyResult<Bound<'py, PyAny>> {
    Ok(match value {
        Value::Null => py.None().into_bound(py),
        Value::Bool(flag) => flag.into_pyobject(py)?.to_owned().into_any(),
        Value::Number(number) => match (number.as_u64(), number.as_i64()) {
            (Some(number), _) => number.into_pyobject(py)?.into_any(),
            (None, Some(number)) => number.into_pyobject(py)?.into_any(),
            (None, None) => number.as_f64().into_pyobject(py)?.into_any(),
        },
        Value::String(text) => text.into_pyobject(py)?.into_any(),
        Value::Array(values) => {
            let values = values.iter().map(|value| of_value(py, value));
            let values: Vec<_> = values.collect::<PyResult<_>>()?;
            PyList::new(py, values)?.into_any()
        }
        Value::Object(fields) => {
            let dict = PyDict::new(py);
            for (name, value) in fields {
                dict.set_item(name, of_value(py, value)?)?;
            }
            dict.into_any()
        }
    })
}
