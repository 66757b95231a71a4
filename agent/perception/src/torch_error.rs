//! Errors of libtorch: their first line, without the stack of C++ calls.

use tch::TchError;

/// First line of the message of an error.
pub fn first_line(error: &TchError) -> String {
    let text = error.to_string();
    text.lines().next().unwrap_or_default().to_owned()
}
