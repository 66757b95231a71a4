//! Progress bar on standard error, of one style for all programs; silent if standard error is no terminal.

use std::io::{IsTerminal, stderr};

use indicatif::{ProgressBar, ProgressStyle};

use crate::output::{Verbosity, verbosity};

/// A bar over `total` steps with the name `unit`, for example `frames`; its message, if any, is behind it.
pub fn bar(total: usize, unit: &str) -> ProgressBar {
    with_template(
        total,
        &format!("{{bar:30}} {{pos}}/{{len}} {unit}  {{eta}} left  {{msg}}"),
    )
}

/// A bar over 1000 steps for each of `count` parts, which displays per cent.
pub fn percent_bar(count: usize) -> ProgressBar {
    with_template(
        1000 * count,
        "{bar:30} {percent} %  {elapsed}, {eta} left  {msg}",
    )
}

/// A counter of steps with the name `unit`, for an unknown total.
pub fn spinner(unit: &str) -> ProgressBar {
    styled(
        ProgressBar::new_spinner(),
        &format!("{{spinner}} {{pos}} {unit}  {{msg}}"),
    )
}

fn with_template(total: usize, template: &str) -> ProgressBar {
    styled(ProgressBar::new(total as u64), template)
}

fn styled(bar: ProgressBar, template: &str) -> ProgressBar {
    if !stderr().is_terminal() || verbosity() == Verbosity::Quiet {
        return ProgressBar::hidden();
    }
    match ProgressStyle::with_template(template) {
        Ok(style) => bar.with_style(style),
        Err(_) => bar,
    }
}
