//! Log of messages that are left out, at most one line in ten seconds for each topic.

use std::fmt::Display;
use std::time::{Duration, Instant};

use ros2::{RosName, RosType};

/// Interval between two lines: a driver that is set up wrongly sends ten or a hundred such messages a second.
const PERIOD: Duration = Duration::from_secs(10);

/// Log of one topic.
#[derive(Debug)]
pub(super) struct RefusalLog {
    topic: RosName,
    ros_type: RosType,
    logged: Option<Instant>,
}

impl RefusalLog {
    pub(super) fn of(topic: RosName, ros_type: RosType) -> Self {
        Self {
            topic,
            ros_type,
            logged: None,
        }
    }

    /// Logs why a message is left out.
    pub(super) fn warn(&mut self, reason: &dyn Display) {
        if self.logged.is_none_or(|logged| logged.elapsed() > PERIOD) {
            self.logged = Some(Instant::now());
            tracing::warn!(
                "{}: {} left out: {reason}",
                self.topic,
                self.ros_type.name()
            );
        }
    }
}
