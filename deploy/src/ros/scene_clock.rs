//! Clock of a scene: the time for `/clock`, from the capture times of messages.

use std::collections::BTreeMap;

use protocol::{CavId, Stream};

/// The latest capture time. Sensors of a vehicle send in the order of time: an earlier one shows that the scene has begun
/// again, and the clock follows. Results come later than sensor data and never set the clock back.
#[derive(Debug, Default)]
pub(super) struct SceneClock {
    now_nanos: Option<u64>,
    sensors: BTreeMap<CavId, u64>,
}

impl SceneClock {
    /// The new time, if a message of `stream` changes it.
    pub(super) fn advance(
        &mut self,
        cav: &CavId,
        stream: Stream,
        capture_nanos: u64,
    ) -> Option<u64> {
        let previous = match stream {
            Stream::Imu => self.sensors.insert(cav.clone(), capture_nanos),
            _ => None,
        };
        if previous.is_some_and(|previous| capture_nanos < previous) {
            // The other vehicles' times are of the round before, and would set the clock back once more.
            self.sensors.retain(|_, nanos| *nanos <= capture_nanos);
            return Some(*self.now_nanos.insert(capture_nanos));
        }
        let is_later = self.now_nanos.is_none_or(|now| capture_nanos > now);
        is_later.then(|| *self.now_nanos.insert(capture_nanos))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_clock_follows_the_sensors_forward_and_back_to_the_beginning() {
        let (mut clock, [a, b]) = (
            SceneClock::default(),
            ["1", "2"].map(|id| CavId::new(id).unwrap()),
        );
        assert_eq!(clock.advance(&a, Stream::Imu, 100), Some(100));
        assert_eq!(
            clock.advance(&b, Stream::Imu, 100),
            None,
            "it is that time already"
        );
        assert_eq!(clock.advance(&a, Stream::Imu, 200), Some(200));
        assert_eq!(
            clock.advance(&b, Stream::Pose, 100),
            None,
            "a result of an earlier time"
        );
        assert_eq!(clock.advance(&b, Stream::Imu, 200), None);
        assert_eq!(
            clock.advance(&a, Stream::Imu, 50),
            Some(50),
            "the scene has begun again"
        );
        assert_eq!(clock.advance(&b, Stream::Imu, 50), None);
        assert_eq!(clock.advance(&b, Stream::Imu, 150), Some(150));
        assert_eq!(
            clock.advance(&a, Stream::Detections, 300),
            Some(300),
            "without sensors results set it"
        );
    }
}
