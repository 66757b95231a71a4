//! Quality of service of ROS 2 topics: in liveliness tokens and in bags.

use std::fmt;

/// Depth that rmw_zenoh leaves out of a token.
const DEFAULT_DEPTH: u32 = 42;

/// Quality of service of a publisher or subscription; its history is always keep-last.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Qos {
    /// True: reliable; false: best effort.
    pub is_reliable: bool,
    /// True: transient local (latched): late subscribers get the last messages. False: volatile.
    pub is_latched: bool,
    /// Messages that are kept.
    pub depth: u32,
}

impl Qos {
    /// ROS's default profile: reliable, ten messages.
    pub const DEFAULT: Self = Self::new(true, false, 10);
    /// ROS's profile for sensor data: best effort, five messages.
    pub const SENSOR_DATA: Self = Self::new(false, false, 5);
    /// ROS's profile for `/clock`: best effort, one message.
    pub const CLOCK: Self = Self::new(false, false, 1);
    /// tf2's profile for `/tf`.
    pub const TF: Self = Self::new(true, false, 100);
    /// tf2's profile for `/tf_static`.
    pub const TF_STATIC: Self = Self::new(true, true, 1);

    const fn new(is_reliable: bool, is_latched: bool, depth: u32) -> Self {
        Self {
            is_reliable,
            is_latched,
            depth,
        }
    }

    /// As `offered_qos_profiles` of a channel, in the numbers that rosbag2 of every distribution reads.
    pub fn offered_profiles(self) -> String {
        let [reliability, durability] = self.policies();
        // i64::MAX nanoseconds in seconds and nanoseconds: no limit.
        let forever = "    sec: 9223372036\n    nsec: 854775807\n";
        format!(
            "- history: 1\n  depth: {depth}\n  reliability: {reliability}\n  durability: {durability}\n  deadline:\n{forever}  \
             lifespan:\n{forever}  liveliness: 1\n  liveliness_lease_duration:\n{forever}  \
             avoid_ros_namespace_conventions: false\n",
            depth = self.depth
        )
    }

    /// Reliability and durability in the numbers of `rmw/types.h`.
    fn policies(self) -> [u32; 2] {
        [self.is_reliable, self.is_latched].map(|is_set| if is_set { 1 } else { 2 })
    }
}

/// As in a liveliness token: `reliability:durability:history,depth:deadline:lifespan:liveliness`, values that are
/// rmw_zenoh's defaults left out.
impl fmt::Display for Qos {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [reliability, durability] = self.policies();
        let [reliability, durability, depth] = [
            (reliability, 1),
            (durability, 2),
            (self.depth, DEFAULT_DEPTH),
        ]
        .map(|(value, default)| match value == default {
            true => String::new(),
            false => value.to_string(),
        });
        write!(f, "{reliability}:{durability}:,{depth}:,:,:,,")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tokens_leave_out_what_is_the_default() {
        let texts =
            [Qos::DEFAULT, Qos::SENSOR_DATA, Qos::CLOCK, Qos::TF_STATIC].map(|qos| qos.to_string());
        assert_eq!(
            texts,
            [
                "::,10:,:,:,,",
                "2::,5:,:,:,,",
                "2::,1:,:,:,,",
                ":1:,1:,:,:,,"
            ]
        );
        assert_eq!(
            Qos {
                depth: 42,
                ..Qos::DEFAULT
            }
            .to_string(),
            "::,:,:,:,,"
        );
    }

    #[test]
    fn bags_get_numbers() {
        let text = Qos::TF_STATIC.offered_profiles();
        assert!(text.starts_with(
            "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n  deadline:\n    sec: "
        ));
        assert!(
            text.ends_with("\n  avoid_ros_namespace_conventions: false\n"),
            "{text}"
        );
        assert!(
            text.lines()
                .all(|line| line.starts_with("- ") || line.starts_with("  ")),
            "{text}"
        );
    }
}
