//! Progress of a training: a bar on a terminal, else a line now and then.

use std::cell::Cell;
use std::time::{Duration, Instant};

use indicatif::ProgressBar;
use perception::train::{Length, TrainingEvent};
use support::output;
use terminal::progress;

/// Shortest time between two plain lines.
const LINE_EVERY: Duration = Duration::from_secs(10);
/// Time of encoding after which its total duration is estimated.
const ESTIMATE_AFTER: Duration = Duration::from_secs(3);
/// Parts of the bar, of 1000 steps each.
const PARTS: usize = 10;

/// Shows the progress of a training on standard error.
#[derive(Debug)]
pub struct TrainingBar {
    bar: ProgressBar,
    last_line: Cell<Option<Instant>>,
    encoding: Cell<Option<EncodingProgress>>,
    /// Length of the training.
    length: Length,
    /// True if the length includes the encoding.
    includes_encoding: bool,
}

/// Progress of the encoding of one data set.
#[derive(Debug, Clone, Copy)]
struct EncodingProgress {
    began: Instant,
    /// Number of sweeps encoded at its start: feature maps that an earlier run has stored count at once.
    first: usize,
    latest: usize,
    /// True if the estimate has been printed.
    is_estimated: bool,
}

impl TrainingBar {
    /// Bar for a training of this length, which is part of the estimate if sweeps have to be encoded first.
    pub fn of(length: Length) -> Self {
        Self {
            bar: progress::percent_bar(PARTS),
            last_line: Cell::new(None),
            encoding: Cell::new(None),
            length,
            includes_encoding: false,
        }
    }

    /// The same for a training whose time counts from the start of the encoding.
    pub fn including_encoding(length: Length) -> Self {
        Self {
            includes_encoding: true,
            ..Self::of(length)
        }
    }

    /// Shows the progress of a training.
    pub fn show_progress(&self, progress: &TrainingEvent) {
        match progress {
            TrainingEvent::Encoding(done, all) => self.encoded(*done, *all),
            TrainingEvent::Read(data) => {
                if let Some(text) = data.left_out() {
                    self.print_line(&text);
                }
            }
            TrainingEvent::Note(text) | TrainingEvent::Validated(text) => self.print_line(text),
            TrainingEvent::Stepped(report) => {
                self.report(report.share_done, report.seconds, &report.text);
            }
        }
    }

    /// Shows the progress: `share_done` 0..1 after `seconds`, and a text.
    pub fn report(&self, share_done: f64, seconds: f64, text: &str) {
        let remaining_s = match self.length {
            // The clock ends it, whatever part of the time the encoding took.
            Length::Time(limit) => Some((limit.as_secs_f64() - seconds).max(0.0)),
            _ => remaining_s(share_done, 1.0 - share_done, seconds),
        };
        self.show(share_done, remaining_s, text);
    }

    /// Shows that `done` of `all` sweeps of a data set are encoded; a smaller number than before belongs to the next
    /// one.
    pub fn encoded(&self, done: usize, all: usize) {
        let fresh = EncodingProgress {
            began: Instant::now(),
            first: done,
            latest: done,
            is_estimated: false,
        };
        let known = self.encoding.get().filter(|known| known.latest <= done);
        let mut encoding = known.unwrap_or(fresh);
        encoding.latest = done;
        let left = all.saturating_sub(done) as f64;
        let passed = encoding.began.elapsed();
        // Maps that an earlier run stored took no time now and would make the estimate too short.
        let remaining_s = remaining_s((done - encoding.first) as f64, left, passed.as_secs_f64());
        let is_due = !encoding.is_estimated && passed >= ESTIMATE_AFTER;
        if let Some(remaining_s) = remaining_s.filter(|_| is_due) {
            let seconds = passed.as_secs_f64() + remaining_s;
            self.print_line(&estimate(all, seconds, self.length, self.includes_encoding));
            encoding.is_estimated = true;
        }
        self.encoding.set(Some(encoding));
        let text = format!("{done} of {all} sweeps encoded");
        self.show(done as f64 / all.max(1) as f64, remaining_s, &text);
    }

    fn show(&self, share_done: f64, remaining_s: Option<f64>, text: &str) {
        if !self.bar.is_hidden() {
            let position = share_done * 1000.0 * PARTS as f64;
            self.bar.set_position(position as u64);
            self.bar.set_message(text.to_owned());
            return;
        }
        let last = self.last_line.get();
        if last.is_none_or(|last| last.elapsed() >= LINE_EVERY) {
            let remaining = remaining_s.map(|seconds| format!(", {seconds:.0} s remaining"));
            let (share, remaining) = (100.0 * share_done, remaining.unwrap_or_default());
            output::note(format_args!("{text}, {share:.1} % done{remaining}"));
            self.last_line.set(Some(Instant::now()));
        }
    }

    /// Prints a line that stays.
    pub fn print_line(&self, text: &str) {
        match self.bar.is_hidden() {
            true => output::note(text),
            false => self.bar.println(text),
        }
    }

    /// Removes the bar.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

/// Estimate of the duration of the encoding of all sweeps, and the training after it.
fn estimate(sweeps: usize, seconds: f64, length: Length, includes_encoding: bool) -> String {
    let then = match length {
        Length::Time(time) => {
            let (time_s, all) = (time.as_secs_f64(), minutes(time.as_secs_f64()));
            if !includes_encoding {
                format!(", then {all} of training")
            } else if time_s <= seconds {
                format!(", all of the {all} in all: the training needs more time")
            } else {
                let left = minutes(time_s - seconds);
                format!(" of the {all} in all, which leaves {left} for the training")
            }
        }
        Length::Steps(steps) => format!(", then {steps} steps of training"),
        Length::Epochs(epochs) => format!(", then {epochs} passes of training"),
    };
    format!("encoding {sweeps} sweeps takes {}{then}", minutes(seconds))
}

/// A duration in readable units.
fn minutes(seconds: f64) -> String {
    match seconds < 90.0 {
        true => format!("{seconds:.0} s"),
        false => format!("{:.0} min", seconds / 60.0),
    }
}

/// Estimated time for `left` when `done` took `seconds`; `None` before anything is done.
fn remaining_s(done: f64, left: f64, seconds: f64) -> Option<f64> {
    (done > 0.0).then(|| seconds * left / done)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_remaining_time_is_proportional() {
        assert_eq!(remaining_s(0.25, 0.75, 20.0), Some(60.0));
        assert_eq!(remaining_s(1.0, 0.0, 20.0), Some(0.0));
        assert_eq!(remaining_s(0.0, 1.0, 20.0), None);
    }

    #[test]
    fn the_durations_of_encoding_and_training_are_estimated() {
        let [short, long] = [180, 1200].map(|time_s| Length::Time(Duration::from_secs(time_s)));
        for (length, includes_encoding, then) in [
            (long, false, ", then 20 min of training"),
            (Length::Steps(50), false, ", then 50 steps of training"),
            (
                long,
                true,
                " of the 20 min in all, which leaves 11 min for the training",
            ),
            (
                short,
                true,
                ", all of the 3 min in all: the training needs more time",
            ),
        ] {
            assert_eq!(
                estimate(600, 540.0, length, includes_encoding),
                format!("encoding 600 sweeps takes 9 min{then}")
            );
        }
        assert_eq!(
            estimate(20, 42.4, Length::Epochs(3.0), false),
            "encoding 20 sweeps takes 42 s, then 3 passes of training"
        );
    }

    #[test]
    fn each_data_set_is_timed_from_its_own_beginning() {
        let bar = TrainingBar::of(Length::Steps(1));
        // An earlier run stored sixty feature maps; then the next data set.
        let first = [60, 150, 200, 50, 100].map(|done| {
            bar.encoded(done, 200);
            bar.encoding.get().map(|encoding| encoding.first)
        });
        assert_eq!(first, [60, 60, 60, 50, 50].map(Some));
    }
}
