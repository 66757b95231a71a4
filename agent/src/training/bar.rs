//! A progress bar where somebody watches, else a line now and then.

use std::cell::Cell;
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
}

impl Default for TrainingBar {
    fn default() -> Self {
        let is_watched = std::io::stderr().is_terminal();
        let bar = if is_watched { ProgressBar::new(TICKS) } else { ProgressBar::hidden() };
        if let Ok(style) = ProgressStyle::with_template("{wide_bar} {percent}% {elapsed} eta {eta} {msg}") {
            bar.set_style(style);
        }
        Self { bar, is_watched, last_line: Cell::new(None) }
    }
}

impl TrainingBar {
    /// Says how far it is: `share_done` 0..1 after `seconds`, and how it goes.
    pub fn report(&self, share_done: f64, seconds: f64, text: &str) {
        if self.is_watched {
            self.bar.set_position((share_done * TICKS as f64) as u64);
            self.bar.set_message(text.to_owned());
        } else if self.last_line.get().is_none_or(|last| last.elapsed() >= LINE_EVERY) {
            let remaining_s = seconds * (1.0 / share_done.max(1e-6) - 1.0);
            eprintln!("{text}, {:.1} % done, {remaining_s:.0} s to go", 100.0 * share_done);
            self.last_line.set(Some(Instant::now()));
        }
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
