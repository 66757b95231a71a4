//! Log of messages that are left out or odd, for each topic and kind of reason at most one line in ten seconds.

use std::collections::BTreeMap;
use std::fmt::Display;
use std::time::{Duration, Instant};

use ros2::{RosName, RosType};

/// Interval between two lines: a driver that is set up wrongly sends ten or a hundred such messages a second.
const PERIOD: Duration = Duration::from_secs(10);
/// Most kinds of reasons that are told apart: their texts come from outside.
const MOST_KINDS: usize = 32;

/// Log of one topic.
#[derive(Debug)]
pub(super) struct RefusalLog {
    topic: RosName,
    ros_type: RosType,
    /// Times of the last lines, by kind of reason.
    logged: BTreeMap<String, Instant>,
}

impl RefusalLog {
    pub(super) fn of(topic: RosName, ros_type: RosType) -> Self {
        Self {
            topic,
            ros_type,
            logged: BTreeMap::new(),
        }
    }

    /// Logs why a message is left out.
    pub(super) fn warn(&mut self, reason: &dyn Display) {
        if self.is_due(&reason.to_string(), Instant::now()) {
            let (topic, name) = (&self.topic, self.ros_type.name());
            tracing::warn!("{topic}: {name} left out: {reason}");
        }
    }

    /// True if no reason of this kind was logged in the period. Reasons that differ in numbers alone are of one kind.
    pub(super) fn is_due(&mut self, reason: &str, now: Instant) -> bool {
        let mut kind = reason.replace(|letter: char| letter.is_ascii_digit(), "");
        // Kinds beyond the limit share one place, so that texts from outside cannot fill the memory.
        if self.logged.len() >= MOST_KINDS && !self.logged.contains_key(&kind) {
            kind = String::new();
        }
        let last = self.logged.get(&kind);
        let is_due = last.is_none_or(|last| now.duration_since(*last) > PERIOD);
        if is_due {
            self.logged.insert(kind, now);
        }
        is_due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_kind_of_reason_has_its_own_period() {
        let mut log = RefusalLog::of("/points".parse().unwrap(), RosType::PointCloud2);
        let start = Instant::now();
        assert!(log.is_due("point_step is 4", start));
        assert!(!log.is_due("point_step is 8", start));
        assert!(log.is_due("no field x", start));
        assert!(log.is_due("point_step is 4", start + 2 * PERIOD));
        for name in 0..2 * MOST_KINDS {
            log.is_due(&format!("no field {}", "x".repeat(name)), start);
        }
        assert!(!log.is_due("one more", start), "{:?}", log.logged);
        assert!(log.logged.len() <= MOST_KINDS + 1);
    }
}
