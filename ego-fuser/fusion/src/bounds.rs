//! Range checks of fusion settings.

use std::ops::RangeInclusive;

use perception::model_config::ConfigError;

/// Checks a number of a fusion's settings.
///
/// # Errors
/// [`ConfigError`] names `field` and `value` when that is not in `allowed`.
pub(super) fn within(
    field: &'static str,
    value: i64,
    allowed: RangeInclusive<i64>,
) -> Result<(), ConfigError> {
    if allowed.contains(&value) {
        return Ok(());
    }
    Err(ConfigError::Value {
        field,
        value: value.to_string(),
        must: "positive and of a size that a network can have",
    })
}
