//! Checks of single numbers of a message, with errors that name field, value and bounds.

use crate::{Result, WireError};

/// Refuses a number outside of `min..=max`, and NaN.
pub(crate) fn check_within(what: &'static str, value: f64, min: f64, max: f64) -> Result<()> {
    // NaN is within nothing.
    if (min..=max).contains(&value) {
        return Ok(());
    }
    Err(WireError::Value {
        what,
        index: 0,
        value,
        min,
        max,
    })
}

/// Refuses the first number that is not valid; `min` and `max` are for the message only.
pub(crate) fn check_each(
    what: &'static str,
    values: &[f32],
    [min, max]: [f32; 2],
    is_valid: impl Fn(f32) -> bool,
) -> Result<()> {
    let Some(index) = values.iter().position(|value| !is_valid(*value)) else {
        return Ok(());
    };
    Err(WireError::Value {
        what,
        index,
        value: values.get(index).copied().unwrap_or(f32::NAN).into(),
        min: min.into(),
        max: max.into(),
    })
}

/// Refuses more than the limit.
pub(crate) fn check_limit(what: &'static str, found: u64, max: u64) -> Result<()> {
    if found <= max {
        return Ok(());
    }
    Err(WireError::Limit { what, max, found })
}

/// Refuses a size that is not the expected one.
pub(crate) fn check_size(what: &'static str, found: u64, expected: u64) -> Result<()> {
    if found == expected {
        return Ok(());
    }
    Err(WireError::shape(what, expected, found))
}
