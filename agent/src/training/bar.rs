//! A progress bar where somebody watches, else a line now and then.

use std::cell::{Cell, OnceCell};
use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

/// Plain lines come no more often than this.
const LINE_EVERY: Duration = Duration::from_secs(10);
/// Resolution of the bar.
const TICKS: u64 = 10_000;

/// Shows on standard error how a training goes.
#[derive(Debug)]
pub struct TrainingBar {
    bar: ProgressBar,
    is_watched: bool,
    last_line: Cell<Option<Instant>>,
    /// When the first sweeps were encoded, and how many.
    encoding: OnceCell<(Instant, usize)>,
}

impl Default for TrainingBar {
    fn default() -> Self {
        let is_watched = std::io::stderr().is_terminal();
        let bar = if is_watched { ProgressBar::new(TICKS) } else { ProgressBar::hidden() };
        if let Ok(style) = ProgressStyle::with_template("{wide_bar} {percent}% {elapsed} eta {eta} {msg}") {
            bar.set_style(style);
        }
        Self { bar, is_watched, last_line: Cell::new(None), encoding: OnceCell::new() }
    }
}

impl TrainingBar {
    /// Says how far it is: `share_done` 0..1 after `seconds`, and how it goes.
    pub fn report(&self, share_done: f64, seconds: f64, text: &str) {
        if self.is_watched {
            self.bar.set_position((share_done * TICKS as f64) as u64);
            self.bar.set_message(text.to_owned());
        } else if self.last_line.get().is_none_or(|last| last.elapsed() >= LINE_EVERY) {
            eprintln!("{text}{}", outlook(share_done, seconds));
            self.last_line.set(Some(Instant::now()));
        }
    }

    /// Says that `done` of `all` sweeps are encoded.
    pub fn encoded(&self, done: usize, all: usize) {
        let (began, before) = self.encoding.get_or_init(|| (Instant::now(), done));
        // Maps that an earlier run has kept were there at once.
        let share = done.saturating_sub(*before) as f64 / all.saturating_sub(*before).max(1) as f64;
        self.report(share, began.elapsed().as_secs_f64(), &format!("{done} of {all} sweeps encoded"));
    }

    /// A line that stays.
    pub fn say(&self, text: &str) {
        if self.is_watched { self.bar.println(text) } else { eprintln!("{text}") }
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

/// How far it is after `seconds`, and for how long it will go on; nothing before anything is done.
fn outlook(share_done: f64, seconds: f64) -> String {
    if share_done <= 0.0 {
        return String::new();
    }
    let remaining_s = seconds * (1.0 / share_done - 1.0);
    format!(", {:.1} % done, {remaining_s:.0} s to go", 100.0 * share_done)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_takes_as_long_as_what_was_done() {
        assert_eq!(outlook(0.25, 20.0), ", 25.0 % done, 60 s to go");
        assert_eq!(outlook(1.0, 20.0), ", 100.0 % done, 0 s to go");
        assert_eq!(outlook(0.0, 20.0), "");
    }
}
