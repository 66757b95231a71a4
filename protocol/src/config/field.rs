//! Checks of single fields of a configuration, with errors that name field, value and rule.

use std::fmt::{Debug, Display};

/// A field whose value is out of bounds or contradicts another.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{field} is {found}: {rule}")]
pub struct FieldError {
    /// Name of the field with its sections, `bus.connect_timeout_s`.
    pub field: String,
    /// Value found.
    pub found: String,
    /// Values allowed.
    pub rule: String,
}

impl FieldError {
    /// An error about one field.
    pub fn new(field: impl Into<String>, found: impl Display, rule: impl Into<String>) -> Self {
        Self {
            field: field.into(),
            found: found.to_string(),
            rule: rule.into(),
        }
    }
}

/// Refuses a value that breaks a rule.
///
/// # Errors
/// [`FieldError`] with the value and the rule.
pub fn require(
    holds: bool,
    field: &str,
    value: impl Debug,
    rule: impl Into<String>,
) -> Result<(), FieldError> {
    if holds {
        return Ok(());
    }
    Err(FieldError::new(field, format_args!("{value:?}"), rule))
}

/// Refuses a value outside of `low` to `high`, both included; NaN too.
///
/// # Errors
/// [`FieldError`] with the value and both bounds.
pub fn within<T: PartialOrd + Display>(
    field: &str,
    value: T,
    low: T,
    high: T,
) -> Result<(), FieldError> {
    if value >= low && value <= high {
        return Ok(());
    }
    let rule = format!("must be {low} to {high}");
    Err(FieldError::new(field, value, rule))
}

/// Refuses a number that is not above 0 and at most a million: rates and waiting times.
///
/// # Errors
/// [`FieldError`] with the value.
pub fn above_zero(field: &str, value: f64) -> Result<(), FieldError> {
    let rule = "must be a number above 0 and at most 1000000";
    require(value > 0.0 && value <= 1e6, field, value, rule)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bounds_belong_to_what_is_allowed_and_nan_does_not() {
        assert!(within("rate", 0.0, 0.0, 1.0).is_ok() && within("rate", 1.0, 0.0, 1.0).is_ok());
        let error = within("rate", f64::NAN, 0.0, 1.0).unwrap_err().to_string();
        assert_eq!(error, "rate is NaN: must be 0 to 1");
        let error = require(false, "size", [1, 2], "must be square").unwrap_err();
        assert_eq!(error.to_string(), "size is [1, 2]: must be square");
        assert!(above_zero("rate", 0.0).is_err() && above_zero("rate", 1e6).is_ok());
    }
}
