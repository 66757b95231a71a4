//! A progress bar where somebody watches, else a line now and then.

use std::cell::Cell;
use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use sim_replay::output;

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
    encoding: Cell<Option<Encoding>>,
}

/// How the sweeps of one data set are being encoded.
#[derive(Debug, Clone, Copy)]
struct Encoding {
    began: Instant,
    /// So many were encoded when it began: maps that an earlier run has kept are there at once.
    first: usize,
    latest: usize,
}

impl Default for TrainingBar {
    fn default() -> Self {
        let is_watched = std::io::stderr().is_terminal();
        let bar = if is_watched { ProgressBar::new(TICKS) } else { ProgressBar::hidden() };
        if let Ok(style) = ProgressStyle::with_template("{wide_bar} {percent}% {elapsed} eta {eta} {msg}") {
            bar.set_style(style);
        }
        Self { bar, is_watched, last_line: Cell::new(None), encoding: Cell::new(None) }
    }
}

impl TrainingBar {
    /// Says how far it is: `share_done` 0..1 after `seconds`, and how it goes.
    pub fn report(&self, share_done: f64, seconds: f64, text: &str) {
        self.show(share_done, remaining_s(share_done, 1.0 - share_done, seconds), text);
    }

    /// Says that `done` of `all` sweeps of a data set are encoded; fewer than before are of the next one.
    pub fn encoded(&self, done: usize, all: usize) {
        let fresh = Encoding { began: Instant::now(), first: done, latest: done };
        let Encoding { began, first, .. } = self.encoding.get().filter(|known| known.latest <= done).unwrap_or(fresh);
        self.encoding.set(Some(Encoding { began, first, latest: done }));
        let left = all.saturating_sub(done) as f64;
        let remaining_s = remaining_s((done - first) as f64, left, began.elapsed().as_secs_f64());
        self.show(done as f64 / all.max(1) as f64, remaining_s, &format!("{done} of {all} sweeps encoded"));
    }

    fn show(&self, share_done: f64, remaining_s: Option<f64>, text: &str) {
        if self.is_watched {
            self.bar.set_position((share_done * TICKS as f64) as u64);
            self.bar.set_message(text.to_owned());
        } else if self.last_line.get().is_none_or(|last| last.elapsed() >= LINE_EVERY) {
            let to_go = remaining_s.map(|seconds| format!(", {seconds:.0} s to go")).unwrap_or_default();
            output::note(format_args!("{text}, {:.1} % done{to_go}", 100.0 * share_done));
            self.last_line.set(Some(Instant::now()));
        }
    }

    /// A line that stays.
    pub fn say(&self, text: &str) {
        if self.is_watched { self.bar.println(text) } else { output::note(text) }
    }

    /// Takes the bar away.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

/// How long what is `left` will take when `done` took `seconds`; not known before anything is done.
fn remaining_s(done: f64, left: f64, seconds: f64) -> Option<f64> {
    (done > 0.0).then(|| seconds * left / done)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_takes_as_long_as_what_was_done() {
        assert_eq!(remaining_s(0.25, 0.75, 20.0), Some(60.0));
        assert_eq!(remaining_s(1.0, 0.0, 20.0), Some(0.0));
        assert_eq!(remaining_s(0.0, 1.0, 20.0), None);
    }

    #[test]
    fn each_data_set_is_timed_from_its_own_beginning() {
        let bar = TrainingBar::default();
        let first = |done| {
            bar.encoded(done, 200);
            bar.encoding.get().map(|encoding| encoding.first)
        };
        // Sixty maps were kept by an earlier run; then the next data set.
        assert_eq!([first(60), first(150), first(200), first(50), first(100)], [60, 60, 60, 50, 50].map(Some));
    }
}
