//! Progress bar on standard error, of one style for all programs; silent if standard error is no terminal.

use std::io::{IsTerminal, stderr};

use indicatif::{ProgressBar, ProgressStyle};

use support::output::{Verbosity, verbosity};

/// A bar over `total` steps with the name `unit`, for example `frames`; its message, if any, is behind it.
pub fn bar(total: usize, unit: &str) -> ProgressBar {
    let template = format!("{{bar:30}} {{pos}}/{{len}} {unit}  {{eta}} left  {{msg}}");
    styled(ProgressBar::new(total as u64), &template)
}

/// Shows the number done and that of all on a bar.
pub fn shown_on(bar: &ProgressBar) -> impl Fn(usize, usize) {
    move |done, all| {
        bar.set_length(all as u64);
        bar.set_position(done as u64);
    }
}

/// A bar over 1000 steps for each of `count` parts, which displays per cent.
pub fn percent_bar(count: usize) -> ProgressBar {
    let template = "{bar:30} {percent} %  {elapsed}, {eta} left  {msg}";
    styled(ProgressBar::new(1000 * count as u64), template)
}

/// A counter of steps with the name `unit`, for an unknown total.
pub fn spinner(unit: &str) -> ProgressBar {
    let template = format!("{{spinner}} {{pos}} {unit}  {{msg}}");
    styled(ProgressBar::new_spinner(), &template)
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
