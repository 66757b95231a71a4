//! Errors of libtorch: their first line, without the stack of C++ calls.

use tch::TchError;

/// First line of the message of an error.
pub fn first_line(error: &TchError) -> String {
    error
        .to_string()
        .lines()
        .next()
        .unwrap_or_default()
        .to_owned()
}
