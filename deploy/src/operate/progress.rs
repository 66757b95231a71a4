//! Progress display of a run: a live line on a terminal, plain lines elsewhere.

use std::time::{Duration, Instant};

use indicatif::ProgressBar;
use support::output;
use terminal::progress;
use terminal::text_table::number;

use crate::score::Progress;

/// Interval between two plain lines.
const LINE_PERIOD: Duration = Duration::from_secs(2);

/// Display of a run on standard error.
pub struct Display {
    bar: ProgressBar,
    last_line: Instant,
    shown_frames: u64,
}

impl Display {
    /// A display for `ticks` ticks, or for a run without end.
    pub fn new(ticks: Option<usize>) -> Self {
        let bar = match ticks {
            Some(ticks) => progress::bar(ticks, "frames"),
            None => progress::spinner("frames"),
        };
        Self {
            bar,
            last_line: Instant::now(),
            shown_frames: 0,
        }
    }

    /// Updates the live line, or prints a plain line if one is due.
    pub fn update(&mut self, progress: &Progress) {
        let (frames, ticks) = (progress.frames, progress.ticks);
        if !self.bar.is_hidden() {
            self.bar.set_position(frames);
            self.bar.set_message(summary(progress));
        } else if self.last_line.elapsed() >= LINE_PERIOD && frames != self.shown_frames {
            self.last_line = Instant::now();
            self.shown_frames = frames;
            let summary = summary(progress);
            output::note(format_args!("answered {frames}/{ticks}  {summary}"));
        }
    }

    /// Prints an event above the live line.
    pub fn print_line(&self, text: &str) {
        self.bar.suspend(|| output::note(text));
    }

    /// Removes the live line.
    pub fn finish(self) {
        self.bar.finish_and_clear();
    }
}

/// Rate, latency, neighbours, bytes, drops.
fn summary(progress: &Progress) -> String {
    format!(
        "{} Hz  latency {} ms  {} fused  {}  {} dropped",
        number(progress.rate_hz(), 1),
        number(progress.latency_ms, 0),
        progress.fused,
        bytes(progress.wire_bytes as f64),
        progress.dropped
    )
}

/// A number of bytes as text, with a unit.
pub fn bytes(count: f64) -> String {
    const UNITS: [&str; 4] = ["B", "kB", "MB", "GB"];
    let (mut value, mut unit) = (count, 0);
    while value >= 1000.0 && unit + 1 < UNITS.len() {
        value /= 1000.0;
        unit += 1;
    }
    let digits = usize::from(unit > 0);
    format!("{value:.digits$} {}", UNITS[unit])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_for_people() {
        assert_eq!(bytes(999.0), "999 B");
        assert_eq!(bytes(1_572_864.0), "1.6 MB");
        assert_eq!(bytes(5e12), "5000.0 GB");
    }

    #[test]
    fn the_line_has_rate_latency_bytes_and_drops() {
        let now = Instant::now();
        let progress = Progress {
            frames: 11,
            span: Some((now, now + Duration::from_secs(1))),
            latency_ms: Some(84.4),
            fused: 1,
            wire_bytes: 25_000,
            dropped: 2,
            ..Progress::default()
        };
        assert_eq!(
            summary(&progress),
            "10.0 Hz  latency 84 ms  1 fused  25.0 kB  2 dropped"
        );
        assert_eq!(
            summary(&Progress::default()),
            "- Hz  latency - ms  0 fused  0 B  0 dropped"
        );
    }
}
