//! Clocks of a run's vehicles that differ from the ego's.

use std::collections::BTreeMap;
use std::fmt;

use bus::{is_same_clock, longest_transit_s};
use protocol::CavId;
use serde::{Deserialize, Serialize};

use crate::score::NeighbourRecord;

/// Offsets of a vehicle's clocks from the ego's.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct OtherClock {
    /// Offset of its system clock, less the shortest transit time, seconds; `None` where it is the ego's.
    pub system_s: Option<f64>,
    /// Offset of its capture times, which the ego corrected, seconds; `None` where they agreed.
    pub capture_s: Option<f64>,
}

/// Neighbours with another clock than the ego, as the ego judges: over a link a transit may be long.
pub(super) fn others(
    neighbours: &BTreeMap<CavId, NeighbourRecord>,
    over_link: bool,
) -> BTreeMap<CavId, OtherClock> {
    let longest_s = longest_transit_s(over_link);
    let others = neighbours.iter().filter_map(|(cav, record)| {
        let clock = OtherClock {
            system_s: record
                .clock_offset_s
                .filter(|offset_s| !is_same_clock(*offset_s, longest_s)),
            capture_s: record.capture_offset_s,
        };
        (clock != OtherClock::default()).then(|| (cav.clone(), clock))
    });
    others.collect()
}

impl fmt::Display for OtherClock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        // A long transit makes a clock seem behind, never ahead.
        let system = self.system_s.map(|offset_s| match offset_s > 0.0 {
            true => format!("clock {offset_s:.3} s ahead, durations from it not measurable"),
            false => format!("clock {:.3} s behind, or as long a transit", -offset_s),
        });
        let capture = self.capture_s.map(|offset_s| {
            let side = if offset_s > 0.0 { "ahead" } else { "behind" };
            format!("capture times {:.3} s {side}, corrected", offset_s.abs())
        });
        let parts: Vec<String> = system.into_iter().chain(capture).collect();
        f.write_str(&parts.join("; "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clocks_that_differ_are_named_with_their_offsets() {
        let neighbours = [
            ("1", Some(-0.002), None),
            ("2", Some(3.0), Some(0.3)),
            ("3", None, Some(-0.1)),
            ("4", Some(-0.351), None),
        ];
        let neighbours = neighbours.map(|(cav, clock_offset_s, capture_offset_s)| {
            let record = NeighbourRecord {
                clock_offset_s,
                capture_offset_s,
                ..NeighbourRecord::default()
            };
            (CavId::new(cav).unwrap(), record)
        });
        let neighbours = neighbours.into();
        let [direct, over_link] = [false, true].map(|over_link| {
            let others = others(&neighbours, over_link);
            let lines = others.iter().map(|(cav, clock)| format!("{cav}: {clock}"));
            lines.collect::<Vec<_>>()
        });
        let beyond_link = [
            "2: clock 3.000 s ahead, durations from it not measurable; capture times 0.300 s ahead, corrected",
            "3: capture times 0.100 s behind, corrected",
        ];
        assert_eq!(over_link, beyond_link);
        assert_eq!(direct[..2], beyond_link);
        let behind = "4: clock 0.351 s behind, or as long a transit";
        assert_eq!(direct[2..], [behind]);
    }
}
