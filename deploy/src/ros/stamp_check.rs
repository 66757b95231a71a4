//! Check of a LiDAR's stamps: those of 0, ahead of this machine's clock, and going back.

use super::time_series::seconds;

/// Largest lead of a stamp over this machine's clock, nanoseconds: 0.1 s.
const MAX_LEAD_NANOS: u64 = 100_000_000;

/// Stamps of one LiDAR.
#[derive(Debug, Default)]
pub(super) struct StampCheck {
    /// Stamp of the last sweep that was not left out, nanoseconds.
    pub(super) last_nanos: Option<u64>,
}

/// Reason why a sweep is left out: it has no time of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum NoTime {
    /// Drivers that set no stamp leave it 0.
    #[error("header.stamp is 0: the driver sets no time")]
    Zero,
    /// A message twice, or a driver whose stamps stand still.
    #[error("header.stamp is {0} ns as in the message before")]
    Repeated(u64),
}

/// A stamp that is used although it is odd.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub(super) enum OddStamp {
    /// The clocks of the sensor and of this machine differ.
    #[error(
        "header.stamp is {0:.1} s ahead of this machine's clock: robots of one fleet need one clock (PTP or NTP)"
    )]
    Ahead(f64),
    /// A bag has begun again, or a clock was set back.
    #[error("header.stamp goes back by {0:.1} s: poses start anew")]
    Back(f64),
}

impl StampCheck {
    /// Takes the stamp of a sweep that arrives at `now_nanos` of this machine's clock; what is odd about it.
    pub(super) fn take(&mut self, nanos: u64, now_nanos: u64) -> Result<Option<OddStamp>, NoTime> {
        if nanos == 0 {
            return Err(NoTime::Zero);
        }
        if self.last_nanos == Some(nanos) {
            return Err(NoTime::Repeated(nanos));
        }
        let previous = self.last_nanos.replace(nanos);
        Ok(match previous {
            Some(previous) if nanos < previous => Some(OddStamp::Back(seconds(previous - nanos))),
            _ if nanos > now_nanos.saturating_add(MAX_LEAD_NANOS) => {
                Some(OddStamp::Ahead(seconds(nanos - now_nanos)))
            }
            _ => None,
        })
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use ros2::RosType;

    use super::*;
    use crate::ros::refusal_log::RefusalLog;

    const S: u64 = 1_000_000_000;

    #[test]
    fn a_sweep_without_a_time_is_left_out_and_an_odd_time_is_named() {
        let mut check = StampCheck::default();
        assert_eq!(check.take(0, 9 * S), Err(NoTime::Zero));
        assert_eq!(check.last_nanos, None);
        assert_eq!(check.take(8 * S, 9 * S), Ok(None));
        assert_eq!(check.take(8 * S, 9 * S), Err(NoTime::Repeated(8 * S)));
        assert_eq!(check.take(9 * S + S / 20, 9 * S), Ok(None));
        assert_eq!(check.take(12 * S, 9 * S), Ok(Some(OddStamp::Ahead(3.0))));
        assert_eq!(check.take(7 * S, 9 * S), Ok(Some(OddStamp::Back(5.0))));
        assert_eq!(check.last_nanos, Some(7 * S));
    }

    #[test]
    fn a_warning_is_given_once_for_each_kind() {
        let mut log = RefusalLog::of("/points".parse().unwrap(), RosType::PointCloud2);
        let now = Instant::now();
        let kinds = [
            OddStamp::Ahead(1.0),
            OddStamp::Back(1.0),
            OddStamp::Ahead(2.0),
        ];
        assert_eq!(
            kinds.map(|odd| log.is_due(&odd.to_string(), now)),
            [true, true, false]
        );
    }
}
